"""Core of the Mission Manager: one mission as a state machine, goal by goal.

    idle → running ⇄ paused
             running, paused → failed, cancelled;  running → succeeded
             idle, succeeded, failed, cancelled → running (the next mission)

The state is one frozen struct that msgspec can serialise, so that a checkpoint is its encoding;
every function takes a state and returns the next one.
"""

from __future__ import annotations

import msgspec

from actors.messages import (
    ControlPhase,
    ControlStatus,
    Goal,
    GoalOrder,
    LightMeasurement,
    MissionPhase,
    MissionRequest,
    MissionStatus,
    Mode,
    Route,
)

P = MissionPhase

TRANSITIONS: dict[MissionPhase, frozenset[MissionPhase]] = {
    P.IDLE: frozenset({P.RUNNING, P.FAILED}),
    P.RUNNING: frozenset({P.PAUSED, P.SUCCEEDED, P.FAILED, P.CANCELLED}),
    P.PAUSED: frozenset({P.RUNNING, P.FAILED, P.CANCELLED}),
    P.SUCCEEDED: frozenset({P.RUNNING, P.FAILED}),
    P.FAILED: frozenset({P.RUNNING, P.FAILED}),
    P.CANCELLED: frozenset({P.RUNNING, P.FAILED}),
}
"""Phase → phases that may follow. A new mission may fail at once: it has no goals."""

ACTIVE = frozenset({P.RUNNING, P.PAUSED})
"""Phases in which a mission is under way."""

_NO_GOAL = Goal(0.0, 0.0, Mode.TAXI)


class IllegalTransitionError(ValueError):
    """A phase was to follow another that it cannot follow; the message names both."""

    def __init__(self, mission_id: str, old: MissionPhase, new: MissionPhase) -> None:
        allowed = ", ".join(sorted(phase.value for phase in TRANSITIONS[old]))
        super().__init__(
            f"mission {mission_id!r}: phase: {old.value} → {new.value} is no transition,"
            f" after {old.value} may come: {allowed}"
        )
        self.old = old
        self.new = new


class MissionState(msgspec.Struct, frozen=True):
    """Everything the Mission Manager must not forget.

    Attributes:
        mission_id: the mission under way, or the last one.
        name: its name for people.
        phase: where in its life it is.
        goals: in `map`.
        step: index of the current goal; the number of goals once all are reached.
        step_started_s: simulated time at which the current step began.
        step_times_s: duration of each finished step in simulated seconds.
        lights: the first measurement of each light, in order of arrival.
        reason: why it failed, was cancelled or paused.
        accepted: ids of all missions ever accepted.
    """

    mission_id: str = ""
    name: str = ""
    phase: MissionPhase = MissionPhase.IDLE
    goals: tuple[Goal, ...] = ()
    step: int = 0
    step_started_s: float = 0.0
    step_times_s: tuple[float, ...] = ()
    lights: tuple[LightMeasurement, ...] = ()
    reason: str = ""
    accepted: tuple[str, ...] = ()


def enter(state: MissionState, phase: MissionPhase, reason: str = "") -> MissionState:
    """Return the state in a new phase.

    Raises:
        IllegalTransitionError: the phase cannot follow the present one.
    """
    if phase not in TRANSITIONS[state.phase]:
        raise IllegalTransitionError(state.mission_id, state.phase, phase)
    return msgspec.structs.replace(state, phase=phase, reason=reason)


def accept(state: MissionState, request: MissionRequest, now: float) -> MissionState:
    """Take a mission; one that is under way is replaced. An id accepted before changes nothing."""
    if request.mission_id in state.accepted:
        return state
    started = enter(
        msgspec.structs.replace(state, phase=P.CANCELLED) if state.phase in ACTIVE else state,
        P.RUNNING if request.goals else P.FAILED,
        "" if request.goals else "the mission has no goals",
    )
    return msgspec.structs.replace(
        started,
        mission_id=request.mission_id,
        name=request.name,
        goals=request.goals,
        step=0,
        step_started_s=now,
        step_times_s=(),
        lights=(),
        accepted=(*state.accepted, request.mission_id),
    )


def progress(state: MissionState, report: ControlStatus, now: float) -> MissionState:
    """Step on if Osmosis Control has arrived at the current goal of this mission."""
    current = (report.mission_id, report.step) == (state.mission_id, state.step)
    if state.phase is not P.RUNNING or not current or report.phase is not ControlPhase.ARRIVED:
        return state
    reached = msgspec.structs.replace(
        state,
        step=state.step + 1,
        step_started_s=now,
        step_times_s=(*state.step_times_s, now - state.step_started_s),
    )
    return enter(reached, P.SUCCEEDED) if reached.step == len(reached.goals) else reached


def routed(state: MissionState, route: Route) -> MissionState:
    """Fail the mission if the Graph Planner found no way to its current goal."""
    current = (route.mission_id, route.step) == (state.mission_id, state.step)
    if state.phase is not P.RUNNING or not current or not route.active or route.waypoints:
        return state
    return enter(state, P.FAILED, f"goal {state.step + 1}: {route.reason}")


def measured(state: MissionState, light: LightMeasurement) -> MissionState:
    """Keep the first measurement of each light.

    Also just after success: the last light's message may come after that of the last arrival.
    """
    known = any(other.light == light.light for other in state.lights)
    if known or state.phase not in ACTIVE | {P.SUCCEEDED}:
        return state
    return msgspec.structs.replace(state, lights=(*state.lights, light))


def pause(state: MissionState, reason: str) -> MissionState:
    """Hold a running mission; the robot gets no goal until `resume`."""
    return enter(state, P.PAUSED, reason)


def resume(state: MissionState) -> MissionState:
    """Go on with a paused mission, with the goal it was paused at."""
    if state.phase is not P.PAUSED:
        raise IllegalTransitionError(state.mission_id, state.phase, P.RUNNING)
    return enter(state, P.RUNNING)


def cancel(state: MissionState, reason: str) -> MissionState:
    """Give a mission up on request."""
    return enter(state, P.CANCELLED, reason)


def goal_order(state: MissionState) -> GoalOrder:
    """Return the current goal for the Graph Planner; inactive unless running."""
    if state.phase is not P.RUNNING:
        return GoalOrder(state.mission_id, state.step, _NO_GOAL, False)
    return GoalOrder(state.mission_id, state.step, state.goals[state.step], True)


def status(state: MissionState) -> MissionStatus:
    """Return what the operator sees."""
    return MissionStatus(
        mission_id=state.mission_id,
        name=state.name,
        phase=state.phase,
        step=state.step,
        goals=state.goals,
        step_times_s=state.step_times_s,
        lights=state.lights,
        reason=state.reason,
    )
