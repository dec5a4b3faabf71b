"""What moves a supervised process from state to state, and what is then to be done: as a table."""

from __future__ import annotations

import pytest

from rampart.actors.ftm.messages import NodeState
from rampart.actors.machine.patience import AT_LEISURE, Patience
from rampart.actors.supervision.supervised_process import (
    START_TIMEOUT_S,
    STATUS,
    Event,
    RestartPolicy,
    State,
    SupervisedProcess,
)
from rampart.actors.system.layout import Unit
from rampart.manager.spec.schema import Kind, NodeSpec
from rampart.manager.spec.tables import Supervision


def process(state: State = State.CRASHED, **limits: float) -> SupervisedProcess:
    unit = Unit("a", (NodeSpec("a", Kind.CONTROL, "m:A"), NodeSpec("b", Kind.CONTROL, "m:B")))
    made = SupervisedProcess(unit, RestartPolicy(Supervision(**limits)), Patience(0.2), state)
    if state is not State.RESTARTING:
        made.shown = NodeState(state.value)
    return made


@pytest.mark.parametrize(("before", "shown"), [
    (State.STARTING, "crashed"), (State.RUNNING, "crashed"), (State.STOPPED, "stopped"),
    (State.WEDGED, "wedged"), (State.CRASHED, "crashed")])
def test_one_that_is_being_restarted_is_shown_as_what_it_was_and_never_as_well(before, shown):
    one = process(before)
    one.step(Event.RESTART)
    assert (one.state, one.shown.value, one.waits) == (State.RESTARTING, shown, True)
    assert one.is_dead == (shown == "crashed")


def silence(one: SupervisedProcess, now_s: float) -> str:
    return one.silence(now_s, 1.0, lambda: AT_LEISURE)


def test_a_new_process_is_silent_when_it_was_not_heard_for_as_long_as_it_may_take():
    one = process(State.STARTING)
    one.take(7, 1)
    assert silence(one, START_TIMEOUT_S - 0.1) == ""
    assert silence(one, START_TIMEOUT_S + 0.1) == "no heartbeat after its start"


@pytest.mark.parametrize(("heard_s", "expected", "excused"), [
    ({"a": 8.0, "b": 10.0}, "no heartbeat from a", ""),
    ({"a": 8.0, "b": 8.0, STATUS: 8.0}, "no heartbeat from a, b", ""),
    ({"a": 10.0, "b": 10.0, STATUS: 8.0}, f"no {STATUS}", ""),
    ({"a": 7.0, "b": 10.0}, "no heartbeat from a", "no heartbeat from a"),
    ({"a": 9.5, "b": 10.0}, "", ""), ({}, "", "")])
def test_each_node_has_to_be_heard_and_the_manager_s_status_unless_it_could_not_be(
        heard_s, expected, excused):
    one = process(State.RUNNING)
    one.take(7, 1)
    one.heard_s = heard_s
    assert silence(one, 10.0) == expected
    one.excuse(10.0, 1.5)  # the supervisor could not hear for so long
    assert silence(one, 10.0) == excused
    one.take(8, 3)
    assert silence(one, 10.0) == "", "another process"
