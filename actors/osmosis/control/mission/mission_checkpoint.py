"""The Mission Manager's checkpoint: what makes no sense in one, and how an older one catches up.

The state is kept before the goal that follows from it is published. So the newest checkpoint is
never behind what planner and control were told. If it is damaged, the one before it is, by a step;
to follow that would send the robot back to a goal that it has reached. But nobody gives steps
except the Mission Manager, so a step that the others are at is one that it once gave.
"""

from __future__ import annotations

import math

import msgspec

from rampart.actors.osmosis.control.mission.mission_state import ACTIVE, MissionState
from rampart.actors.osmosis.messages import MissionPhase
from rampart.actors.runtime.checkpoint import StateFormat


def catch_up(state: MissionState, step: int, now: float) -> MissionState:
    """Return the state at the step that planner or control are at, if that is a later goal.

    The first of the steps made up for gets the time until now, the others none: when they ended is
    not known any more.
    """
    missing = step - state.step
    if state.phase not in ACTIVE or missing <= 0 or step >= len(state.goals):
        return state
    times = (max(now - state.step_started_s, 0.0), *(0.0,) * (missing - 1))
    return msgspec.structs.replace(
        state, step=step, step_started_s=now, step_times_s=(*state.step_times_s, *times))


def _objection(state: MissionState) -> str:
    names = [light.light for light in state.lights]
    numbers = [v for goal in state.goals for v in (goal.x_m, goal.y_m)]
    wrong = {
        f"step {state.step} of {len(state.goals)} goals":
            not 0 <= state.step <= len(state.goals),
        f"{state.phase.value} after the last goal":
            state.phase in ACTIVE and state.step == len(state.goals),
        f"{len(state.step_times_s)} step times at step {state.step}":
            len(state.step_times_s) != state.step,
        f"{state.phase.value} without a mission":
            state.phase is not MissionPhase.IDLE and not state.mission_id,
        "a light is in it twice": len(set(names)) < len(names),
        "a number is not finite":
            not all(map(math.isfinite, (*numbers, state.step_started_s))),
    }
    return "; ".join(text for text, holds in wrong.items() if holds)


MISSION_STATE = StateFormat(MissionState, version=1, objection=_objection)
