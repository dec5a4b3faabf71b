import itertools

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from actors import messages as m
from actors.control import mission_state as ms
from actors.control.localization import is_newer
from actors.control.mission_state import TRANSITIONS, IllegalTransitionError, MissionState
from actors.messages import ControlPhase, ControlStatus, MissionPhase, Mode
from actors.operator.teleoperation import stick_twist

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
    assert ms.goal_order(state) == m.GoalOrder("id-1", 1, GOALS[1], True)
    state = ms.measured(state, light("A01"))
    state = ms.progress(state, arrived(1), 20.0)
    state = ms.measured(state, light("A02"))
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


def test_a_repeated_arrival_steps_on_once():
    state = ms.progress(running(), arrived(0), 11.0)
    assert ms.progress(state, arrived(0), 12.0) is state


def test_the_same_id_is_one_mission_even_when_it_is_over():
    state = running()
    assert ms.accept(state, REQUEST, 11.0) is state
    over = ms.cancel(state, "enough")
    assert ms.accept(over, REQUEST, 12.0) is over


def test_a_new_mission_replaces_the_one_under_way():
    state = ms.measured(ms.progress(running(), arrived(0), 11.0), light("A01"))
    state = ms.accept(state, m.MissionRequest("id-2", "B", GOALS), 12.0)
    assert (state.mission_id, state.step, state.lights) == ("id-2", 0, ())
    assert state.phase is MissionPhase.RUNNING
    assert ms.accept(state, REQUEST, 13.0) is state, "the replaced one does not come back"


def test_a_mission_without_goals_fails_at_once():
    state = ms.accept(MissionState(), m.MissionRequest("id-3", "empty", ()), 0.0)
    assert (state.phase, state.reason) == (MissionPhase.FAILED, "the mission has no goals")


def test_no_route_fails_the_mission_with_the_planners_reason():
    state = running()
    none = m.Route("id-1", 0, Mode.TAXI, True, (), "no way")
    assert ms.routed(state, msgspec.structs.replace(none, step=1)) is state
    assert ms.routed(state, msgspec.structs.replace(none, active=False)) is state
    assert ms.routed(state, msgspec.structs.replace(none, waypoints=((0.0, 0.0),))) is state
    failed = ms.routed(state, none)
    assert (failed.phase, failed.reason) == (MissionPhase.FAILED, "goal 1: no way")


def test_a_light_keeps_its_first_measurement():
    state = ms.measured(running(), light("A01", 1.0))
    assert ms.measured(state, light("A01", 0.1)) is state
    assert ms.measured(MissionState(), light("A01")).lights == ()


def test_a_paused_mission_gives_no_goal_and_resumes_at_the_same_one():
    state = ms.progress(running(), arrived(0), 11.0)
    paused = ms.pause(state, "the operator drives")
    assert not ms.goal_order(paused).active
    assert ms.progress(paused, arrived(1), 12.0) is paused
    assert ms.goal_order(ms.resume(paused)) == ms.goal_order(state)


@pytest.mark.parametrize(("old", "new"), list(itertools.product(MissionPhase, repeat=2)))
def test_a_phase_is_entered_by_the_table_or_not_at_all(old, new):
    state = MissionState(mission_id="x", phase=old)
    if new in TRANSITIONS[old]:
        assert ms.enter(state, new).phase is new
    else:
        with pytest.raises(IllegalTransitionError, match=f"{old.value} → {new.value}"):
            ms.enter(state, new)


def test_resuming_what_is_not_paused_is_refused():
    with pytest.raises(IllegalTransitionError, match="running → running"):
        ms.resume(running())


def test_the_state_survives_serialisation():
    state = ms.measured(ms.progress(running(), arrived(0), 11.0), light("A01"))
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(state), type=MissionState) == state


@given(st.lists(st.one_of(
    st.builds(lambda i, n: ("accept", m.MissionRequest(f"id-{i}", "x", GOALS[:n])),
              st.integers(0, 2), st.integers(0, 2)),
    st.builds(lambda i, s, p: ("progress", arrived(s, f"id-{i}", p)),
              st.integers(0, 2), st.integers(0, 2), st.sampled_from(ControlPhase)),
    st.builds(lambda n: ("light", light(f"L{n}")), st.integers(0, 3))), max_size=30))
def test_no_order_of_messages_breaks_the_machine(events):
    state = MissionState()
    for now, (kind, event) in enumerate(events):
        if kind == "accept":
            state = ms.accept(state, event, float(now))
        elif kind == "progress":
            state = ms.progress(state, event, float(now))
        else:
            state = ms.measured(state, event)
        assert ms.goal_order(state).active == (state.phase is MissionPhase.RUNNING)
        assert len(state.step_times_s) == state.step
        assert (state.phase is MissionPhase.SUCCEEDED) == (
            bool(state.goals) and state.step == len(state.goals))
        assert len({found.light for found in state.lights}) == len(state.lights)


def test_a_pose_without_a_newer_stamp_is_not_passed_on():
    pose = m.Pose(0.0, 0.0, 0.0)
    assert is_newer(pose, 1.0, 0.9)
    assert not is_newer(pose, 1.0, 1.0)
    assert not is_newer(pose, float("nan"), 0.0)
    assert not is_newer(m.Pose(float("nan"), 0.0, 0.0), 2.0, 1.0)


@pytest.mark.parametrize(("stick", "expected"), [
    (m.Joystick(1.0, 0.0, True), m.Twist(0.8, 0.0)),
    (m.Joystick(-0.5, 0.5, True), m.Twist(-0.4, 0.5)),
    (m.Joystick(7.0, -7.0, True), m.Twist(0.8, -1.0)),
    (m.Joystick(1.0, 0.0, False), None),
    (m.Joystick(float("nan"), 0.0, True), None)])
def test_the_stick_is_a_velocity_only_while_the_dead_man_is_held(stick, expected):
    assert stick_twist(stick, 0.8, 1.0) == expected
