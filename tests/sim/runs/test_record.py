"""What becomes of a run's messages in its record."""

from __future__ import annotations

import pytest

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import NodeInfo, NodeState, NodeTable, ProcessEvent
from rampart.actors.runtime.actor import Header
from rampart.actors.runtime.run_plan import RunPlan
from rampart.sim.runs.record import Interval, RunRecorder


def recorder_with(*told: tuple[float, str]) -> RunRecorder:
    recorder = RunRecorder(RunPlan())
    for number, (at_s, what) in enumerate(told):
        recorder.feed(topics.PROCESS_EVENT, ProcessEvent("pump", what, 1, 2, "supervisor", ""),
                      Header("supervisor", 1, number, at_s))
    return recorder


def show(recorder: RunRecorder, at_s: float, state: NodeState) -> None:
    row = NodeInfo("pump", "control", 1, state, 2, 1)
    recorder.feed(topics.NODES, NodeTable((row,)), Header("supervisor", 1, 1, at_s))


def test_a_node_whose_return_was_not_heard_is_up_when_the_table_shows_it():
    recorder = recorder_with((5.0, "wedged"))
    show(recorder, 5.1, NodeState.STARTING)
    show(recorder, 5.5, NodeState.RUNNING)
    show(recorder, 6.0, NodeState.RUNNING)
    record = recorder.record(250.0)
    assert record.intervals == (Interval("down", "pump", 5.0, 5.5, "wedged"),)
    assert [event.text for event in record.events] == [
        "pump wedged, incarnation 2", "pump runs again"]


@pytest.mark.parametrize(("at_s", "state"), [
    (4.9, NodeState.RUNNING), (5.5, NodeState.CRASHED), (5.5, NodeState.STARTING)])
def test_what_was_shown_before_it_failed_or_shows_that_it_has_ends_nothing(at_s, state):
    recorder = recorder_with((5.0, "crashed"))
    show(recorder, at_s, state)
    assert recorder.record(9.0).intervals == (Interval("down", "pump", 5.0, 9.0, "crashed"),)


def test_the_bar_of_a_fault_whose_end_nothing_reported_is_as_long_as_the_fault():
    recorder = RunRecorder(RunPlan())
    order = bm.Injection("gps-bias", "summit_xl/gps", "drop", 5.0)
    recorder.feed(bus_topics.INJECT, order, Header("tools", 1, 1, 10.0))
    recorder.feed(bus_topics.INJECTION_REPORT, bm.InjectionReport("gps-bias", "base", 3, False, ""),
                  Header("base", 1, 1, 10.1))
    (bar,) = recorder.fields(100.0)["intervals"]
    assert (bar.name, bar.from_s, round(bar.to_s, 3)) == ("gps-bias", 10.1, 15.1)


def test_the_record_names_the_nodes_that_were_failing_at_the_end():
    recorder = RunRecorder(RunPlan())
    for at_s, failing in ((5.0, ("pump", "valve")), (5.5, ("valve",))):
        rows = tuple(NodeInfo(name, "control", 1, NodeState.RUNNING, 3, 2, failing=name in failing)
                     for name in ("pump", "valve", "gauge"))
        recorder.feed(topics.NODES, NodeTable(rows), Header("supervisor", 1, 1, at_s))
    assert recorder.record(9.0).failing == ("valve",)
