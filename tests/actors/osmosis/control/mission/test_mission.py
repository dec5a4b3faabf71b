
import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.control.mission import mission_state as ms
from rampart.actors.osmosis.control.mission.mission_state import MissionState
from rampart.actors.osmosis.messages import ControlPhase, ControlStatus, MissionPhase, Mode

GOALS = (m.Goal(1.0, 0.0, Mode.TAXI), m.Goal(9.0, 0.0, Mode.LIGHT_VERIFICATION))
REQUEST = m.MissionRequest("id-1", "A", GOALS)


def arrived(step, mission_id="id-1", phase=ControlPhase.ARRIVED):
    return ControlStatus(mission_id, step, phase, 0, 0.0)


def light(name, ratio=1.0):
    return m.LightMeasurement(name, 200.0 * ratio, ratio, m.LightVerdict.OK)


def running():
    return ms.accept(MissionState(), REQUEST, 10.0)


def test_a_mission_from_request_to_success():
    state = MissionState()
    assert not ms.goal_order(state).active
    state = ms.accept(state, REQUEST, 10.0)
    assert ms.goal_order(state) == m.GoalOrder("id-1", 0, GOALS[0], True)
    state = ms.progress(state, arrived(0), 14.0)
    assert ms.progress(state, arrived(0), 15.0) is state, "a repeated arrival"
    assert ms.goal_order(state) == m.GoalOrder("id-1", 1, GOALS[1], True)
    state = ms.measured(state, light("A01"))
    state = ms.progress(state, arrived(1), 20.0)
    state = ms.measured(state, light("A02"))
    assert ms.measured(state, light("A01", 0.1)) is state, "it keeps its first measurement"
    status = ms.status(state)
    assert status.phase is MissionPhase.SUCCEEDED
    assert status.step == 2
    assert status.step_times_s == (4.0, 6.0)
    assert [found.light for found in status.lights] == ["A01", "A02"], "also one that came late"
    assert not ms.goal_order(state).active


@pytest.mark.parametrize("report", [
    arrived(1), arrived(0, "another"), arrived(0, phase=ControlPhase.FOLLOWING),
    arrived(0, phase=ControlPhase.WAITING), arrived(0, phase=ControlPhase.IDLE)])
def test_only_the_arrival_at_the_current_goal_steps_on(report):
    state = running()
    assert ms.progress(state, report, 11.0) is state


def test_the_same_id_is_one_mission_and_a_new_one_replaces_the_one_under_way():
    state = ms.measured(ms.progress(running(), arrived(0), 11.0), light("A01"))
    assert ms.accept(state, REQUEST, 11.0) is state
    over = ms.enter(state, MissionPhase.CANCELLED, "enough")
    assert ms.accept(over, REQUEST, 12.0) is over
    state = ms.accept(state, m.MissionRequest("id-2", "B", GOALS), 12.0)
    assert (state.mission_id, state.step, state.lights) == ("id-2", 0, ())
    assert state.phase is MissionPhase.RUNNING
    assert ms.accept(state, REQUEST, 13.0) is state, "the replaced one does not come back"
    empty = ms.accept(state, m.MissionRequest("id-3", "empty", ()), 0.0)
    assert (empty.phase, empty.reason) == (MissionPhase.FAILED, "the mission has no goals")


def test_no_route_fails_the_mission_with_the_planners_reason():
    state = running()
    none = m.Route("id-1", 0, Mode.TAXI, True, (), "no way")
    assert ms.routed(state, msgspec.structs.replace(none, step=1)) is state
    assert ms.routed(state, msgspec.structs.replace(none, active=False)) is state
    found = msgspec.structs.replace(none, waypoints=((0.0, 0.0),), reason="way round")
    assert ms.routed(state, found).phase is MissionPhase.RUNNING
    home = situations()["returning"]
    assert ms.routed(home, msgspec.structs.replace(found, step=2)) == home
    for before, route, reason in ((state, none, "goal 1: no way"), (
            home, msgspec.structs.replace(none, step=2), "home: no way")):
        failed = ms.routed(before, route)
        assert (failed.phase, failed.reason) == (MissionPhase.FAILED, reason)


# ---- orders -------------------------------------------------------------------------------------

A = m.MissionAction
ROUTE = m.Route("id-1", 0, Mode.TAXI, True, ((0.5, 0.0), (1.0, 0.0)), "")


def order(action, number=1, by="operator"):
    return m.MissionOrder(f"order-{number}", action, "a reason", by)


def obeyed(state, action, number=1, now=15.0):
    after, answer = ms.obey(state, order(action, number), now)
    assert answer.accepted, answer.reason
    return after


def situations():
    """The mission in each situation in which an order may find it."""
    begun = ms.routed(running(), ROUTE)
    paused = obeyed(begun, A.PAUSE, 98)
    return {
        "none": MissionState(),
        "running": begun,
        "running, nowhere known": running(),
        "paused": paused,
        "held": ms.hold(begun, "held by RM2"),
        "held and paused": ms.hold(paused, "held by RM2"),
        "returning": obeyed(begun, A.HOME, 99),
        "cancelled": ms.enter(begun, MissionPhase.CANCELLED, "enough"),
    }


R, Z, H, F, C = (MissionPhase.RUNNING, MissionPhase.PAUSED, MissionPhase.RETURNING,
                 MissionPhase.FAILED, MissionPhase.CANCELLED)
OBEDIENCE = [
    # situation, and the phase after pause, resume, replan, skip, cancel, home
    ("none",                    (None, None, None, None, None, None)),
    ("running",                 (Z,    None, R,    R,    C,    H)),
    ("running, nowhere known",  (Z,    None, R,    R,    C,    None)),
    ("paused",                  (None, R,    None, Z,    C,    H)),
    ("held",                    (Z,    None, None, Z,    C,    Z)),
    ("held and paused",         (None, None, None, Z,    C,    None)),
    ("returning",               (Z,    None, H,    None, C,    None)),
    ("cancelled",               (None, None, None, None, None, None)),
]


@pytest.mark.parametrize(("situation", "action", "expected"), [
    (situation, action, expected) for situation, row in OBEDIENCE
    for action, expected in zip(A, row, strict=True)])
def test_an_order_is_obeyed_or_refused_with_a_reason(situation, action, expected):
    state = situations()[situation]
    after, answer = ms.obey(state, order(action), 15.0)
    assert answer.accepted == (expected is not None)
    assert bool(answer.reason) == (expected is None)
    assert after.phase is (expected or state.phase)
    if expected is None:
        assert ms.status(after) == ms.status(state), "a refused order changes nothing"


def test_the_same_order_again_is_the_same_order_also_when_it_would_be_refused_now():
    once, first = ms.obey(situations()["running"], order(A.SKIP), 15.0)
    assert ms.obey(once, order(A.SKIP), 16.0) == (once, first)
    later = ms.accept(once, m.MissionRequest("id-2", "B", GOALS), 17.0)
    assert ms.obey(later, order(A.SKIP), 18.0) == (later, first)
    over, refused = ms.obey(MissionState(), order(A.PAUSE), 1.0)
    assert ms.obey(over, order(A.PAUSE), 2.0) == (over, refused)


def test_while_a_recovery_holds_the_robot_the_mission_is_paused_with_its_reason():
    held = ms.hold(running(), "held by RM2: DM2: command not updated")
    assert ms.status(held).phase is MissionPhase.PAUSED
    assert ms.status(held).reason == "held by RM2: DM2: command not updated"
    assert not ms.goal_order(held).active
    free = ms.hold(held, "")
    assert (ms.status(free).phase, ms.status(free).reason) == (MissionPhase.RUNNING, "")
    assert ms.goal_order(free) == ms.goal_order(running())
    paused = obeyed(held, A.PAUSE)
    assert ms.status(paused).reason.endswith("command not updated; operator: a reason")
    free = ms.hold(paused, "")
    assert free.phase is MissionPhase.PAUSED, "a pause that was asked for outlasts the recovery"
    assert obeyed(free, A.RESUME, 2).phase is MissionPhase.RUNNING


def test_no_mission_that_is_ordered_during_a_stop_starts_at_its_end():
    idle = ms.hold(MissionState(), "held by RM1")
    request = m.MissionRequest("id-2", "second", running().goals)
    ordered = ms.accept(idle, request, 3.0)
    assert ms.status(ordered).reason == "held by RM1; ordered during a stop: resume it"
    free = ms.hold(ordered, "")
    assert (free.phase, ms.goal_order(free).active) == (MissionPhase.PAUSED, False)
    assert obeyed(free, A.RESUME).phase is MissionPhase.RUNNING
    launched = ms.accept(idle, request, 3.0, first=True)  # by the command that began the run
    assert ms.hold(launched, "").phase is MissionPhase.RUNNING


def test_a_skipped_goal_is_told_to_the_end():
    state = ms.progress(obeyed(running(), A.SKIP), arrived(1), 20.0)
    status = ms.status(state)
    assert status.phase is MissionPhase.FAILED
    assert status.reason == "1 of 2 goals reached, skipped: goal 1 (operator: a reason)"
    assert status.skipped == (0,)
    assert len(status.step_times_s) == 2


def test_home_is_where_the_mission_began_and_the_mission_ends_there_as_cancelled():
    state = obeyed(ms.progress(situations()["running"], arrived(0), 14.0), A.HOME)
    assert ms.goal_order(state) == m.GoalOrder(
        "id-1", 2, m.Goal(0.5, 0.0, Mode.TAXI), True, 0)
    assert ms.progress(state, arrived(1), 20.0) is state, "the goal it was driving to"
    over = ms.progress(state, arrived(2), 20.0)
    assert over.phase is MissionPhase.CANCELLED
    assert over.reason == "returned home, operator: a reason"


def test_a_goal_that_is_skipped_before_the_first_way_does_not_take_the_way_home():
    state = obeyed(running(), A.SKIP)
    assert A.HOME not in ms.status(state).orders
    state = ms.routed(state, m.Route("id-1", 1, Mode.TAXI, True, ((0.5, 0.0), (9.0, 0.0)), ""))
    assert A.HOME in ms.status(state).orders
    home, _ = ms.obey(state, m.MissionOrder("order-2", A.HOME, "a reason", "operator"), 15.0)
    assert ms.goal_order(home).goal == m.Goal(0.5, 0.0, Mode.TAXI)


def test_a_way_from_a_goal_that_was_reached_does_not_say_where_home_is():
    state = ms.catch_up(running(), 1, 14.0)
    state = ms.routed(state, m.Route("id-1", 1, Mode.TAXI, True, ((5.0, 0.0), (9.0, 0.0)), ""))
    assert A.HOME not in ms.status(state).orders


def test_a_light_that_was_passed_unmeasured_is_named_until_it_is_measured():
    state = ms.measured(running(), light("A01"))
    report = msgspec.structs.replace(arrived(0), unmeasured=("A01", "A02", "A03"))
    state = ms.progress(state, report, 12.0)
    assert ms.status(state).unmeasured == ("A02", "A03")
    assert ms.status(ms.measured(state, light("A02"))).unmeasured == ("A03",)


@given(st.lists(st.one_of(
    st.builds(lambda a, n: ("order", order(a, n)), st.sampled_from(A), st.integers(0, 40)),
    st.builds(lambda why: ("hold", why), st.sampled_from(["", "held by RM2", "held by RM5"])),
    st.builds(lambda i, n: ("accept", m.MissionRequest(f"id-{i}", "x", GOALS[:n])),
              st.integers(0, 2), st.integers(0, 2)),
    st.builds(lambda s, p: ("progress", arrived(s, "id-1", p)),
              st.integers(0, 2), st.sampled_from(ControlPhase)),
    st.builds(lambda s, w: ("route", msgspec.structs.replace(ROUTE, step=s, waypoints=w)),
              st.integers(0, 2), st.sampled_from([(), ROUTE.waypoints])),
    st.builds(lambda n: ("light", light(f"L{n}")), st.integers(0, 3))), max_size=40))
def test_no_order_ever_raises_and_the_phase_always_tells_whether_the_robot_has_a_goal(events):
    state = MissionState()
    for now, (kind, event) in enumerate(events):
        match kind:
            case "order":
                state, answer = ms.obey(state, event, float(now))
                assert answer.accepted == (answer.reason == "")
            case "hold":
                state = ms.hold(state, event)
            case "accept":
                state = ms.accept(state, event, float(now))
            case "progress":
                state = ms.progress(state, event, float(now))
            case "route":
                state = ms.routed(state, event)
            case "light":
                state = ms.measured(state, event)
        for action in A:
            possible = ms.obey(state, order(action, 99), float(now))[1].accepted
            assert possible == (action in ms.status(state).orders), "as the status says"
        driving = state.phase in (MissionPhase.RUNNING, MissionPhase.RETURNING)
        assert ms.goal_order(state).active == driving
        assert driving <= (not state.held and not state.paused)
        assert (state.phase is MissionPhase.PAUSED) <= bool(state.held or state.paused)
        assert len(state.step_times_s) == state.step
        assert len({found.light for found in state.lights}) == len(state.lights)
        if state.phase is MissionPhase.SUCCEEDED:
            assert state.step == len(state.goals) > 0
            assert not state.skipped
            assert not state.homing
        assert msgspec.msgpack.decode(msgspec.msgpack.encode(state), type=MissionState) == state
