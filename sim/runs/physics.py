"""MuJoCo in the engine: the end of runs with unstable physics, and the display of recorded robots.

MuJoCo resets an unstable world to its start and continues. The rest of the run would not follow
from the robot's actions. So such a run ends and cannot be judged.
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
"""Entries of `mjData.warning` after which MuJoCo resets the world or ignores a command."""

_FIRST, _LAST = min(_BAD), max(_BAD)


def report_instability(world: Actor, data: mujoco.MjData) -> bool:
    """Report unstable physics, which ends the run. Return whether the world must stop publishing.

    Args:
        world: The actor that steps the world.
        data: State of the world.
    """
    counts = data.warning.number
    if not counts[_FIRST:_LAST + 1].any():
        return False
    bad = ", ".join(what for place, what in _BAD.items() if counts[place])
    world.report_diagnostic(UNSTABLE, f"MuJoCo found a bad {bad} and reset the world", world.name)
    return True


class RobotModel:
    """A MuJoCo robot that messages move, for `rampart replay --viewer` and `--video`.

    An application names a derived class as `model`. Its argument is the application of the run.

    Args:
        model: The robot and its surroundings. `stand` needs a free first joint; a fixed arm sets
            `data.qpos` in `take` instead.
        data: State; None for a new one.

    Attributes:
        model: As given.
        data: State.
        camera: Camera that follows the first body.
        options: Drawing options.
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
        """Move the robot according to a message.

        Args:
            topic: Topic of the message.
            body: The message.
        """

    def stand(self, position_m: Sequence[float], attitude: Sequence[float]) -> None:
        """Set the pose of a robot whose first joint is free; ignore one that is not finite.

        Args:
            position_m: x, y, z of the first body.
            attitude: Quaternion w, x, y, z.
        """
        pose = (*position_m, *attitude)
        if all(map(math.isfinite, pose)):
            self.data.qpos[:7] = pose
