"""Core of the Mission Manager: a mission as a state machine. Pure.

    idle → running ⇄ paused;  running → succeeded
           running, paused → returning home ⇄ paused;  returning home → cancelled
           running, paused, returning home → failed, cancelled
    idle, succeeded, failed, cancelled → running (the next mission)

A mission is paused by an order, by a recovery that holds the robot, or both, so the phase shows
whether the robot may move. Orders that are not possible in a phase are refused with a reason.

The end of a hold continues what was under way before it, and starts nothing: a mission that is
ordered during a hold waits for an order to resume, and an order to resume is refused.

The state is one frozen struct that msgspec can serialise, so a checkpoint is its encoding. Each
function takes a state and returns the next one.

The state is saved before the goal that follows from it is published, so the newest checkpoint is
never behind planner and control. If it is damaged, the previous one is behind by a step and would
send the robot back to a reached goal. Only the Mission Manager assigns steps, so the step of the
others is one that it once published (`catch_up`).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec
from msgspec.structs import replace

from rampart.actors.bus.bounds import clip
from rampart.actors.osmosis import messages as m
from rampart.actors.runtime.checkpoint import StateFormat

A = m.MissionAction
P = m.MissionPhase

ACTIVE = frozenset({P.RUNNING, P.PAUSED, P.RETURNING})
"""Phases in which a mission is under way."""

DRIVING = frozenset({P.RUNNING, P.RETURNING})
"""Phases in which the robot has a goal."""

ACCEPTED_KEPT = 256
"""Number of last missions that are not accepted again."""

ANSWERS_KEPT = 32
"""Number of last orders that get the same answer if they are repeated."""

_NO_GOAL = m.Goal(0.0, 0.0, m.Mode.TAXI)


class MissionState(msgspec.Struct, frozen=True):
    """State of the Mission Manager, and its checkpoint.

    Attributes:
        mission_id: the mission under way, or the last one.
        name: its display name.
        phase: its phase.
        goals: in `map`.
        step: index of the current goal; the number of goals once all are reached.
        step_started_s: simulated time at which the current step began.
        step_times_s: duration of each finished step in simulated seconds.
        lights: the first measurement of each light, in order of arrival.
        reason: why it failed, was cancelled or paused, or has a detour.
        accepted: ids of the last accepted missions.
        plan: number of plans ordered in this mission.
        paused: sender and reason of the order to pause; empty without one.
        held: recovery that holds the robot and why; empty without one.
        home: start of the mission, known from the first route.
        homing: sender and reason of the order to drive home; empty without one.
        skipped: indices of skipped goals, each with sender and reason of the order.
        unmeasured: lights passed without a measurement.
        answers: answers to the last orders.
    """

    mission_id: str = ""
    name: str = ""
    phase: m.MissionPhase = m.MissionPhase.IDLE
    goals: tuple[m.Goal, ...] = ()
    step: int = 0
    step_started_s: float = 0.0
    step_times_s: tuple[float, ...] = ()
    lights: tuple[m.LightMeasurement, ...] = ()
    reason: str = ""
    accepted: tuple[str, ...] = ()
    plan: int = 0
    paused: str = ""
    held: str = ""
    home: m.Goal | None = None
    homing: str = ""
    skipped: tuple[tuple[int, str], ...] = ()
    unmeasured: tuple[str, ...] = ()
    answers: tuple[m.MissionOrderAnswer, ...] = ()


def enter(state: MissionState, phase: m.MissionPhase, reason: str = "") -> MissionState:
    """Return the state in a new phase."""
    return replace(state, phase=phase, reason=reason)


def first_id(run_id: str) -> str:
    """Return the id of a run's first mission."""
    return f"{run_id}/first"


def accept(state: MissionState, request: m.MissionRequest, now: float, *, first: bool = False
           ) -> MissionState:
    """Accept a mission, which replaces one under way; a known id changes nothing.

    One that comes while a recovery holds the robot waits for an order to resume, unless it is the
    `first` of the run, which was ordered before.
    """
    if request.mission_id in state.accepted:
        return state
    return _settle(MissionState(
        request.mission_id, request.name, P.RUNNING if request.goals else P.FAILED, request.goals,
        step_started_s=now, reason="" if request.goals else "the mission has no goals",
        accepted=(*state.accepted, request.mission_id)[-ACCEPTED_KEPT:],
        held=state.held, answers=state.answers,
        paused="" if first or not state.held else "ordered during a stop: resume it"))


def progress(state: MissionState, report: m.ControlStatus, now: float) -> MissionState:
    """Advance if Osmosis Control has arrived at the current goal of this mission."""
    current = state.phase in DRIVING and report.which == _driven(state)
    if not current or report.phase is not m.ControlPhase.ARRIVED:
        return state
    if state.phase is P.RETURNING:
        return enter(state, P.CANCELLED, f"returned home, {state.homing}")
    fresh = tuple(name for name in report.unmeasured if name not in state.unmeasured)
    return _next_goal(replace(state, unmeasured=(*state.unmeasured, *fresh)), now)


def routed(state: MissionState, route: m.Route) -> MissionState:
    """Take the route to the current goal; fail the mission if there is none."""
    if state.phase not in DRIVING or route.which != _driven(state) or not route.active:
        return state
    if not route.waypoints:
        what = "home" if state.phase is P.RETURNING else f"goal {state.step + 1}"
        return enter(state, P.FAILED, f"{what}: {route.reason}")
    if state.phase is P.RETURNING:
        return state
    if state.home is None and state.step == len(state.skipped):
        # The first waypoint of the first route is the robot's position or the nearest place on
        # the graph, so a route leads back there. Goals skipped before did not move the robot.
        state = replace(state, home=m.Goal(*route.waypoints[0], m.Mode.TAXI))
    if route.reason != state.reason:
        state = replace(state, reason=route.reason)
    return state


def measured(state: MissionState, light: m.LightMeasurement) -> MissionState:
    """Keep the first measurement of each light.

    Also just after success: the last measurement may arrive after the last arrival.
    """
    known = {other.light for other in state.lights}
    if light.light in known or state.phase not in ACTIVE | {P.SUCCEEDED}:
        return state
    return replace(state, lights=(*state.lights, light))


def hold(state: MissionState, reason: str) -> MissionState:
    """Set why a recovery holds the robot; empty if none does."""
    if reason == state.held:
        return state
    return _settle(replace(state, held=reason))


def obey(
    state: MissionState, order: m.MissionOrder, now: float
) -> tuple[MissionState, m.MissionOrderAnswer]:
    """Execute an order or refuse it with a reason; a repeated order gets the same answer."""
    for answer in state.answers:
        if answer.order == order.order:
            return state, answer
    refusal = _refusal(state, order.action)
    after = state if refusal else _EFFECTS[order.action](
        state, clip(f"{order.by}: {order.reason}"), now)
    answer = m.MissionOrderAnswer(order.order, not refusal, clip(refusal), after.plan)
    return replace(after, answers=(*state.answers, answer)[-ANSWERS_KEPT:]), answer


_EFFECTS: dict[m.MissionAction, Callable[[MissionState, str, float], MissionState]] = {
    A.PAUSE: lambda state, why, _now: _settle(replace(state, paused=why)),
    A.RESUME: lambda state, _why, _now: _settle(replace(state, paused="")),
    A.REPLAN: lambda state, _why, _now: replace(state, plan=state.plan + 1),
    A.SKIP: lambda state, why, now: _next_goal(
        replace(state, skipped=(*state.skipped, (state.step, why))), now),
    A.CANCEL: lambda state, why, _now: enter(state, P.CANCELLED, why),
    A.HOME: lambda state, why, _now: _settle(replace(state, homing=why, paused="")),
}
"""Effect of each order. Home also ends a pause."""


def _refusal(state: MissionState, action: m.MissionAction) -> str:
    """Return why an order is refused now, or ""."""
    paused = state.phase is P.PAUSED
    if action is A.RESUME and not paused:
        return f"the mission is not paused but {state.phase.value}"
    if state.phase not in ACTIVE:
        last = f", the last one is {state.phase.value}" if state.mission_id else ""
        return f"no mission is under way{last}"
    unknown_home = "" if state.home else "the start of the mission is unknown"
    later = f"{state.held}; resume it when the robot is released"
    return {
        A.PAUSE: state.paused and f"the mission is already paused, {state.paused}",
        A.RESUME: state.held and (later if state.paused else
                                  f"{state.held}; it continues when the robot is released"),
        A.REPLAN: "the mission is paused; it is replanned when it continues" if paused else "",
        A.SKIP: state.homing and "there is no goal to skip on the way home",
        A.CANCEL: "",
        A.HOME: f"the robot is already on its way home, {state.homing}" if state.homing
        else unknown_home or (later if state.held and state.paused else ""),
    }[action]


def _settle(state: MissionState) -> MissionState:
    """Set the phase of a mission under way by its pauses."""
    if state.phase not in ACTIVE:
        return state
    reason = "; ".join(filter(None, (state.held, state.paused)))
    phase = P.PAUSED if reason else P.RETURNING if state.homing else P.RUNNING
    if phase is state.phase:
        return replace(state, reason=reason) if reason != state.reason else state
    return enter(state, phase, reason or state.homing)


def _next_goal(state: MissionState, now: float) -> MissionState:
    """Continue with the next goal, or end the mission after the last one."""
    state = replace(
        state, step=state.step + 1, step_started_s=now,
        step_times_s=(*state.step_times_s, now - state.step_started_s),
        reason=state.reason if state.phase is P.PAUSED else "")
    if state.step < len(state.goals):
        return state
    if not state.skipped:
        return enter(state, P.SUCCEEDED)
    left_out = ", ".join(f"goal {index + 1} ({why})" for index, why in state.skipped)
    reached = len(state.goals) - len(state.skipped)
    return enter(
        state, P.FAILED, f"{reached} of {len(state.goals)} goals reached, skipped: {left_out}")


def _driven(state: MissionState) -> tuple[str, int]:
    """Return mission and step of the present goal, for planner and control."""
    return state.mission_id, len(state.goals) if state.homing else state.step


def goal_order(state: MissionState) -> m.GoalOrder:
    """Return the current goal for the Graph Planner; inactive unless the robot drives."""
    if state.phase not in DRIVING:
        return m.GoalOrder(*_driven(state), _NO_GOAL, False, state.plan)
    goal = state.home if state.homing and state.home else state.goals[state.step]
    return m.GoalOrder(*_driven(state), goal, True, state.plan)


def status(state: MissionState) -> m.MissionStatus:
    """Return the status message."""
    measured_lights = {light.light for light in state.lights}
    return m.MissionStatus(
        state.mission_id, state.name, state.phase, state.step, state.goals, state.step_times_s,
        state.lights, clip(state.reason),
        skipped=tuple(index for index, _ in state.skipped),
        unmeasured=tuple(name for name in state.unmeasured if name not in measured_lights),
        orders=tuple(action for action in A if not _refusal(state, action)))

# -- checkpoint -----------------------------------------------------------------------------------


def catch_up(state: MissionState, step: int, now: float) -> MissionState:
    """Return the state at the step of planner or control, if that is later.

    The first missing step gets the time until now and the others 0, since their ends are unknown.
    """
    missing = step - state.step
    if state.phase not in ACTIVE or missing <= 0 or step >= len(state.goals):
        return state
    times = (max(now - state.step_started_s, 0.0), *(0.0,) * (missing - 1))
    return replace(
        state, step=step, step_started_s=now, step_times_s=(*state.step_times_s, *times))


def _objection(state: MissionState) -> str:
    names = [light.light for light in state.lights]
    numbers = [state.step_started_s, *(v for goal in state.goals for v in (goal.x_m, goal.y_m))]
    goals, times, phase = len(state.goals), len(state.step_times_s), state.phase
    wrong = {
        f"step {state.step} of {goals} goals": not 0 <= state.step <= goals,
        f"{phase.value} after the last goal": phase in ACTIVE and state.step == goals,
        f"{times} step times at step {state.step}": times != state.step,
        f"{phase.value} without a mission": phase is not P.IDLE and not state.mission_id,
        "a light occurs twice": len(set(names)) < len(names),
        "a number is not finite": not all(map(math.isfinite, numbers)),
    }
    return "; ".join(text for text, holds in wrong.items() if holds)


MISSION_STATE = StateFormat(MissionState, version=1, objection=_objection)
