"""When the HMI sends missions and orders, and the effect of its joystick."""

import pytest

from rampart.actors.operator.requests import RefusedError
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.page import hmi

GOALS = (m.Goal(1.0, 2.0, m.Mode.TAXI),)
FIRST = hmi.first_request("r7", "AB", GOALS)
IDLE = m.MissionStatus("", "", m.MissionPhase.IDLE, 0, (), (), (), "")


def status(request, phase=m.MissionPhase.RUNNING):
    return m.MissionStatus(request.mission_id, request.name, phase, 0, GOALS, (), (), "")


@pytest.mark.parametrize(("incarnation", "now_s", "sends"), [
    (1, 60.0, True), (2, hmi.RESPAWN_WINDOW_S - 0.1, True), (2, hmi.RESPAWN_WINDOW_S, False)])
def test_a_respawned_hmi_sends_the_first_mission_only_at_the_start(incarnation, now_s, sends):
    submission = hmi.Submission("r7", incarnation, now_s, FIRST)
    submission.hear(IDLE)
    assert (submission.pending is not None) is sends


def test_the_first_mission_is_settled_when_the_mission_manager_has_another_one():
    submission = hmi.Submission("r7", 2, hmi.RESPAWN_WINDOW_S / 2, FIRST)
    submission.hear(status(m.MissionRequest("r7/1.1", "B", GOALS), m.MissionPhase.CANCELLED))
    assert submission.pending is None
    submission.ask("A", GOALS, 10.0)
    submission.hear(status(FIRST, m.MissionPhase.CANCELLED))
    assert submission.pending is not None, "later ones are settled by their own id alone"


def test_missions_from_the_page_have_ids_of_their_own_in_every_life():
    ids = set()
    for incarnation in (1, 2):
        submission = hmi.Submission("r7", incarnation, 50.0, None)
        for _ in range(2):
            request = submission.ask("A", GOALS, 50.0)
            ids.add(request.mission_id)
            submission.hear(status(request, m.MissionPhase.SUCCEEDED))
    assert len(ids) == 4
    assert FIRST.mission_id not in ids
    assert hmi.first_request("r7", "AB", GOALS) == FIRST, "twice is once"
    assert hmi.first_request("r8", "AB", GOALS).mission_id != FIRST.mission_id


def test_a_mission_from_the_page_is_withdrawn_when_nobody_takes_it_but_the_first_is_not():
    submission = hmi.Submission("r7", 2, 50.0, None)
    submission.ask("A", GOALS, 50.0)
    assert submission.expire(50.0 + hmi.MISSION_GIVE_UP_S - 0.1) == ""
    assert submission.expire(50.0 + hmi.MISSION_GIVE_UP_S) == (
        "mission A was not accepted: the Mission Manager does not answer")
    assert submission.pending is None
    first = hmi.Submission("r7", 1, 0.0, FIRST)
    assert first.expire(1e6) == ""
    assert first.pending == FIRST


UNDER_WAY = m.MissionStatus("r7/first", "AB", m.MissionPhase.RUNNING, 0, GOALS, (), (), "",
                            orders=(m.MissionAction.PAUSE, m.MissionAction.HOME))


def test_an_order_is_repeated_as_the_same_message_until_it_is_answered_or_withdrawn():
    orders = hmi.Orders("r7/hmi.1", "operator")
    orders.hear(UNDER_WAY)
    order = orders.give(m.MissionAction.PAUSE, " runway \n in use ", 10.0)
    assert (order.action, order.reason, order.by) == (
        m.MissionAction.PAUSE, "runway in use", "operator")
    with pytest.raises(RefusedError, match="pause waits for its answer"):
        orders.give(m.MissionAction.HOME, "", 10.1)
    assert orders.answer(m.MissionOrderAnswer("another's", True, "")) == ""
    assert (orders.pending, orders.expire(10.1)) == (order, "")
    assert orders.answer(m.MissionOrderAnswer(order.order, True, "")) == "pause obeyed"
    assert orders.pending is None
    assert orders.answer(m.MissionOrderAnswer(order.order, True, "")) == ""
    other = orders.give(m.MissionAction.HOME, "", 11.0)
    assert other.order != order.order
    assert other.reason == hmi.NO_REASON
    assert orders.expire(11.0 + hmi.ORDER_GIVE_UP_S) == (
        "home was not obeyed: the Mission Manager does not answer")


@pytest.mark.parametrize(("known", "works", "text"), [
    ({"mode": "teleoperation"}, True, "obeys only the joystick"),
    ({"forbids": "RM2: it is stale", "mode": "stop"}, False, "no effect: RM2: it is stale"),
    ({"dead_nodes": ("teleoperation",), "brake": True}, False, "teleoperation does not run")])
def test_the_page_says_whether_the_stick_has_an_effect_and_why_not(known, works, text):
    heard = {"pilot_heard": True, "mode": "auto", "forbids": "", "brake": False, "dead_nodes": ()}
    got, words = hmi.effect(**heard | known)
    assert got is works
    assert text in words
