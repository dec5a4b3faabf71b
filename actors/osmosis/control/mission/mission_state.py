"""Core of the Mission Manager: one mission as a state machine, goal by goal.

    idle → running ⇄ paused;  running → succeeded
           running, paused → returning home ⇄ paused;  returning home → cancelled
           running, paused, returning home → failed, cancelled
    idle, succeeded, failed, cancelled → running (the next mission)

A mission is paused while somebody has asked for that, or while a recovery holds the robot, or
both: so its phase tells whether the robot may be expected to move. Orders that make no sense in a
phase are refused with a reason; the table is for mistakes in this program.

The state is one frozen struct that msgspec can serialise, so that a checkpoint is its encoding;
every function takes a state and returns the next one.
"""

from __future__ import annotations

import msgspec

from rampart.actors.bus.bounds import clip
from rampart.actors.osmosis import messages as m

P = m.MissionPhase

TRANSITIONS: dict[m.MissionPhase, frozenset[m.MissionPhase]] = {
    P.IDLE: frozenset({P.RUNNING, P.FAILED}),
    P.RUNNING: frozenset({P.PAUSED, P.RETURNING, P.SUCCEEDED, P.FAILED, P.CANCELLED}),
    P.PAUSED: frozenset({P.RUNNING, P.RETURNING, P.FAILED, P.CANCELLED}),
    P.RETURNING: frozenset({P.PAUSED, P.FAILED, P.CANCELLED}),
    P.SUCCEEDED: frozenset({P.RUNNING, P.FAILED}),
    P.FAILED: frozenset({P.RUNNING, P.FAILED}),
    P.CANCELLED: frozenset({P.RUNNING, P.FAILED}),
}
"""Phase → phases that may follow. A new mission may fail at once: it has no goals."""

ACTIVE = frozenset({P.RUNNING, P.PAUSED, P.RETURNING})
"""Phases in which a mission is under way."""

DRIVING = frozenset({P.RUNNING, P.RETURNING})
"""Phases in which the robot has a goal."""

ACCEPTED_KEPT = 256
"""A mission that is sent again is not accepted again as long as it is among the last so many."""

ANSWERS_KEPT = 32
"""An order that is repeated gets its old answer as long as it is among the last so many."""

_NO_GOAL = m.Goal(0.0, 0.0, m.Mode.TAXI)


class IllegalTransitionError(ValueError):
    """A phase was to follow another that it cannot follow; the message names both."""

    def __init__(self, mission_id: str, old: m.MissionPhase, new: m.MissionPhase) -> None:
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
        reason: why it failed, was cancelled or paused, or goes another way than the shortest.
        accepted: ids of the last missions that were accepted.
        plan: how often another plan was asked for in this mission.
        paused: on whose order it is paused and why; empty without such an order.
        held: which recovery holds the robot and why; empty if none does.
        home: where the mission began, once a first route has told.
        homing: on whose order the robot drives home and why; empty if it does not.
        skipped: indices of goals left out, and on whose order and why.
        unmeasured: lights that were passed without a measurement.
        answers: to the latest orders.
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
    """Return the state in a new phase.

    Raises:
        IllegalTransitionError: the phase cannot follow the present one.
    """
    if phase not in TRANSITIONS[state.phase]:
        raise IllegalTransitionError(state.mission_id, state.phase, phase)
    return msgspec.structs.replace(state, phase=phase, reason=reason)


def accept(state: MissionState, request: m.MissionRequest, now: float) -> MissionState:
    """Take a mission; one that is under way is replaced. An id accepted before changes nothing."""
    if request.mission_id in state.accepted:
        return state
    started = enter(
        msgspec.structs.replace(state, phase=P.CANCELLED) if state.phase in ACTIVE else state,
        P.RUNNING if request.goals else P.FAILED,
        "" if request.goals else "the mission has no goals",
    )
    return _settle(msgspec.structs.replace(
        started,
        mission_id=request.mission_id,
        name=request.name,
        goals=request.goals,
        step=0,
        step_started_s=now,
        step_times_s=(),
        lights=(),
        accepted=(*state.accepted, request.mission_id)[-ACCEPTED_KEPT:],
        plan=0,
        paused="",
        home=None,
        homing="",
        skipped=(),
        unmeasured=(),
    ))


def progress(state: MissionState, report: m.ControlStatus, now: float) -> MissionState:
    """Step on if Osmosis Control has arrived at the current goal of this mission."""
    current = (report.mission_id, report.step) == (state.mission_id, _step_driven(state))
    if state.phase not in DRIVING or not current or report.phase is not m.ControlPhase.ARRIVED:
        return state
    if state.phase is P.RETURNING:
        return enter(state, P.CANCELLED, f"returned home, {state.homing}")
    fresh = tuple(name for name in report.unmeasured if name not in state.unmeasured)
    return _next_goal(msgspec.structs.replace(state, unmeasured=(*state.unmeasured, *fresh)), now)


def routed(state: MissionState, route: m.Route) -> MissionState:
    """Take note of the way to the current goal; fail the mission if there is none."""
    current = (route.mission_id, route.step) == (state.mission_id, _step_driven(state))
    if state.phase not in DRIVING or not current or not route.active:
        return state
    if not route.waypoints:
        what = "home" if state.phase is P.RETURNING else f"goal {state.step + 1}"
        return enter(state, P.FAILED, f"{what}: {route.reason}")
    if state.phase is P.RETURNING:
        return state
    if state.home is None and state.step == 0:
        # The first waypoint of the first way is where the robot was, or the nearest place to it
        # on the graph: somewhere that a way leads back to.
        state = msgspec.structs.replace(state, home=m.Goal(*route.waypoints[0], m.Mode.TAXI))
    if route.reason != state.reason:
        state = msgspec.structs.replace(state, reason=route.reason)
    return state


def measured(state: MissionState, light: m.LightMeasurement) -> MissionState:
    """Keep the first measurement of each light.

    Also just after success: the last light's message may come after that of the last arrival.
    """
    known = any(other.light == light.light for other in state.lights)
    if known or state.phase not in ACTIVE | {P.SUCCEEDED}:
        return state
    return msgspec.structs.replace(state, lights=(*state.lights, light))


def pause(state: MissionState, reason: str) -> MissionState:
    """Hold a running mission; the robot gets no goal until `resume`."""
    return msgspec.structs.replace(enter(state, P.PAUSED, reason), paused=reason or "paused")


def resume(state: MissionState) -> MissionState:
    """Go on with a paused mission, with the goal it was paused at."""
    if state.phase is not P.PAUSED:
        raise IllegalTransitionError(state.mission_id, state.phase, P.RUNNING)
    return _settle(msgspec.structs.replace(state, paused=""))


def cancel(state: MissionState, reason: str) -> MissionState:
    """Give a mission up on request."""
    return enter(state, P.CANCELLED, reason)


def hold(state: MissionState, reason: str) -> MissionState:
    """Take note of a recovery that holds the robot, or with an empty reason that none does."""
    if reason == state.held:
        return state
    return _settle(msgspec.structs.replace(state, held=reason))


def obey(
    state: MissionState, order: m.MissionOrder, now: float
) -> tuple[MissionState, m.MissionOrderAnswer]:
    """Obey an order, or refuse it with a reason; one that was answered before changes nothing."""
    for answer in state.answers:
        if answer.order == order.order:
            return state, answer
    outcome = _OBEDIENCE[order.action](state, clip(f"{order.by}: {order.reason}"), now)
    after = state if isinstance(outcome, str) else outcome
    answer = m.MissionOrderAnswer(order.order, not isinstance(outcome, str),
                                clip(outcome) if isinstance(outcome, str) else "", after.plan)
    kept = (*state.answers, answer)[-ANSWERS_KEPT:]
    return msgspec.structs.replace(after, answers=kept), answer


def _order_pause(state: MissionState, why: str, _now: float) -> MissionState | str:
    if state.phase not in ACTIVE:
        return _not_under_way(state)
    if state.paused:
        return f"it is paused already, {state.paused}"
    return _settle(msgspec.structs.replace(state, paused=why))


def _order_resume(state: MissionState, _why: str, _now: float) -> MissionState | str:
    if state.phase is not P.PAUSED:
        return f"it is not paused but {state.phase.value}"
    if not state.paused:
        return f"{state.held}; it goes on by itself when the robot is released"
    return resume(state)


def _order_replan(state: MissionState, _why: str, _now: float) -> MissionState | str:
    if state.phase is P.PAUSED:
        return "it is paused, and will be planned anew when it goes on"
    if state.phase not in DRIVING:
        return _not_under_way(state)
    return msgspec.structs.replace(state, plan=state.plan + 1)


def _order_skip(state: MissionState, why: str, now: float) -> MissionState | str:
    if state.phase not in ACTIVE:
        return _not_under_way(state)
    if state.homing:
        return "on the way home there is no goal to skip"
    skipped = (*state.skipped, (state.step, why))
    return _next_goal(msgspec.structs.replace(state, skipped=skipped), now)


def _order_cancel(state: MissionState, why: str, _now: float) -> MissionState | str:
    return cancel(state, why) if state.phase in ACTIVE else _not_under_way(state)


def _order_home(state: MissionState, why: str, _now: float) -> MissionState | str:
    if state.phase not in ACTIVE:
        return _not_under_way(state)
    if state.homing:
        return f"it is on the way home already, {state.homing}"
    if state.home is None:
        return "where the mission began is not known"
    return _settle(msgspec.structs.replace(state, homing=why, paused=""))


_OBEDIENCE = {
    m.MissionAction.PAUSE: _order_pause,
    m.MissionAction.RESUME: _order_resume,
    m.MissionAction.REPLAN: _order_replan,
    m.MissionAction.SKIP: _order_skip,
    m.MissionAction.CANCEL: _order_cancel,
    m.MissionAction.HOME: _order_home,
}
"""What each order does: the next state, or why it is refused. Home also ends a pause."""


def _not_under_way(state: MissionState) -> str:
    return f"no mission is under way, the last one is {state.phase.value}" if state.mission_id \
        else "no mission is under way"


def _settle(state: MissionState) -> MissionState:
    """Bring the phase of a mission under way in line with what holds it."""
    if state.phase not in ACTIVE:
        return state
    reason = "; ".join(filter(None, (state.held, state.paused)))
    phase = P.PAUSED if reason else P.RETURNING if state.homing else P.RUNNING
    if phase is state.phase:
        return msgspec.structs.replace(state, reason=reason) if reason != state.reason else state
    return enter(state, phase, reason or state.homing)


def _next_goal(state: MissionState, now: float) -> MissionState:
    """Go on with the next goal, or end the mission after the last one."""
    state = msgspec.structs.replace(
        state,
        step=state.step + 1,
        step_started_s=now,
        step_times_s=(*state.step_times_s, now - state.step_started_s),
        reason=state.reason if state.phase is P.PAUSED else "",
    )
    if state.step < len(state.goals):
        return state
    if not state.skipped:
        return enter(state, P.SUCCEEDED)
    left_out = ", ".join(f"goal {index + 1} ({why})" for index, why in state.skipped)
    reached = len(state.goals) - len(state.skipped)
    return enter(state, P.FAILED, f"{reached} of {len(state.goals)} goals reached, skipped: "
                                  f"{left_out}")


def _step_driven(state: MissionState) -> int:
    """Return the number by which planner and control know what the robot drives to."""
    return len(state.goals) if state.homing else state.step


def goal_order(state: MissionState) -> m.GoalOrder:
    """Return the current goal for the Graph Planner; inactive unless the robot is to drive."""
    step = _step_driven(state)
    if state.phase not in DRIVING:
        return m.GoalOrder(state.mission_id, step, _NO_GOAL, False, state.plan)
    goal = state.home if state.homing and state.home else state.goals[state.step]
    return m.GoalOrder(state.mission_id, step, goal, True, state.plan)


def status(state: MissionState) -> m.MissionStatus:
    """Return what the operator sees."""
    return m.MissionStatus(
        mission_id=state.mission_id,
        name=state.name,
        phase=state.phase,
        step=state.step,
        goals=state.goals,
        step_times_s=state.step_times_s,
        lights=state.lights,
        reason=clip(state.reason),
        skipped=tuple(index for index, _ in state.skipped),
        unmeasured=tuple(
            name for name in state.unmeasured
            if not any(light.light == name for light in state.lights)),
        orders=tuple(action for action, try_out in _OBEDIENCE.items()
                     if not isinstance(try_out(state, "", 0.0), str)),
    )
