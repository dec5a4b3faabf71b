"""A world in MuJoCo whose numbers have blown up. MuJoCo then resets it to its start and goes on.

What follows is no consequence of what the robot did. So such a run ends, and cannot be judged.
"""

from __future__ import annotations

import mujoco

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
