"""What the engine does with MuJoCo: it ends a run whose world blew up, and shows recorded robots.

MuJoCo resets a world whose numbers have blown up to its start and goes on. The rest of the run is
no consequence of what the robot did. So such a run ends, and cannot be judged.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import mujoco

from rampart.actors.bus.topic import Topic
from rampart.actors.runtime.actor import Actor
from rampart.sim.runs.judge import UNSTABLE

_BAD = {int(mujoco.mjtWarning.mjWARN_BADQPOS): "position",
        int(mujoco.mjtWarning.mjWARN_BADQVEL): "velocity",
        int(mujoco.mjtWarning.mjWARN_BADQACC): "acceleration",
        int(mujoco.mjtWarning.mjWARN_BADCTRL): "control"}
"""Places in `mjData.warning` after which MuJoCo resets the world, or ignores what was asked."""

_FIRST, _LAST = min(_BAD), max(_BAD)


def report_instability(world: Actor, data: mujoco.MjData) -> bool:
    """End the run if its world has blown up, and return whether it has: it publishes no more.

    Args:
        world: the actor that steps it.
        data: its state.
    """
    counts = data.warning.number
    if not counts[_FIRST:_LAST + 1].any():
        return False
    bad = ", ".join(what for place, what in _BAD.items() if counts[place])
    world.report_diagnostic(UNSTABLE, f"MuJoCo found a bad {bad} and reset the world", world.name)
    return True


class RobotModel:
    """A robot in MuJoCo that is moved by messages: `rampart replay --viewer` and `--video` show it.

    An application names a derived class as `model`. It is made with the application of the run.

    Args:
        model: the robot, and what is around it; its first joint is free.
        data: its state; None for a new one.

    Attributes:
        model: as given.
        data: its state.
        camera: films it; it follows the first body.
        options: what is drawn.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData | None = None) -> None:
        self.model = model
        self.data = data or mujoco.MjData(model)
        self.camera = mujoco.MjvCamera()
        self.camera.type, self.camera.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, 1
        self.camera.distance = 3.0
        self.options = mujoco.MjvOption()
        if not model.nlight:
            model.vis.headlight.ambient[:] = 0.4
            model.vis.headlight.diffuse[:] = 0.6

    def take(self, topic: Topic[Any], body: Any) -> None:
        """Move the robot as a message says.

        Args:
            topic: of the message.
            body: of the message.
        """

    def stand(self, position_m: Sequence[float], attitude: Sequence[float]) -> None:
        """Put the robot somewhere; a pose with a number that is not finite is ignored.

        Args:
            position_m: x, y, z of the first body.
            attitude: quaternion w, x, y, z.
        """
        pose = (*position_m, *attitude)
        if all(map(math.isfinite, pose)):
            self.data.qpos[:7] = pose
