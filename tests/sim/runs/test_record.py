"""What a run tells and keeps: its record, terminal output, report, and how late it was."""

from __future__ import annotations

import json
import math
from io import StringIO

import msgspec
import pytest

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.envelope import Header
from rampart.actors.bus.messages import ON_TIME
from rampart.actors.ftm import messages as m
from rampart.actors.ftm import topics
from rampart.actors.ftm.keeping_up import LINE_S, WINDOW_S, KeepingUp, KeptUp
from rampart.actors.ftm.messages import NodeInfo, NodeState, NodeTable, ProcessEvent
from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.web.audit import AuditLine, AuditLog
from rampart.manager.spec.budget import allowed_late_s
from rampart.sim.runs.console import Console
from rampart.sim.runs.curves import MOST, CurveRecorder
from rampart.sim.runs.record import Interval, RunRecord, RunRecorder
from rampart.sim.runs.report import render, try_report
from rampart.sim.runs.trial import Trial
from tests.osmosis_system import run_context, shipped_system
from tests.tank import LEVEL, PUMP, Level, Phase, Pump


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


# -- Terminal output --


PLAN = RunPlan("r")
CALM = m.ManagerStatus((), (), (), (), "guarded-repair", 0)


def test_a_module_that_falls_silent_and_is_heard_again_is_told_once_each():
    stream = StringIO()
    console = Console(stream)
    for second, silent in enumerate([(), ("D_FAST",), ("D_FAST",), ()]):
        console.take(topics.MANAGER_STATUS, msgspec.structs.replace(CALM, silent=silent),
                     Header("manager", 1, second, float(second)))
    assert stream.getvalue().splitlines() == [
        "[   1.00 s] D_FAST silent: it counts as active", "[   3.00 s] D_FAST: no longer silent"]


@pytest.mark.parametrize(("mission", "safety", "told"), [
    ("success", "safe", True), ("fail", "unsafe", True), (None, None, False)])
def test_the_verdict_on_a_run_that_was_judged_is_told_also_if_it_is_a_success(
        mission, safety, told):
    stream = StringIO()
    record = RunRecorder(PLAN, "").record(12.0, mission=mission, safety=safety)
    Console(stream).conclusion(record, None)
    assert (stream.getvalue() == f"{mission}, {safety}, 12.0 s simulated.\n") is told
    assert bool(stream.getvalue()) is told


# -- The report: who did what on the page, and curves of a robot's numbers --


def record(*lines: AuditLine) -> RunRecord:
    return RunRecord(run_id="r1", duration_s=60.0, events=(), intervals=(), decisions=(),
                     restarts={}, strategy="", seed=1, rate=1.0, audit=lines)


def line(number: int, **fields: object) -> AuditLine:
    return AuditLine(**{"utc": "2026-01-01T10:20:30.000+00:00", "t_s": float(number), "who": "anna",
                        "what": "reset", "outcome": "accepted", **fields})


def test_what_was_done_is_in_both_reports_and_its_text_is_no_markup(tmp_path):
    run = record(line(1, asked={"recovery": "<b>RM1</b>"}, role="drive", address="10.0.0.7"),
                 line(2, who="", outcome="refused", why="unknown token", left_out=7))
    written = try_report(run, lambda r: render(r, "Tank"), tmp_path)
    page = written.html.read_text()
    for text in ("anna (drive)", "10:20:30", "recovery: &lt;b&gt;RM1&lt;/b&gt;", "not known",
                 "refused: unknown token", "7 lines before this one were too many"):
        assert text in page
    assert "<b>RM1" not in page
    kept = json.loads(written.data.read_text())["audit"]
    assert [(k.get("who", ""), k["outcome"]) for k in kept] == [
        ("anna", "accepted"), ("", "refused")]


def test_a_run_reads_what_its_page_has_written_down(tmp_path):
    file = tmp_path / "audit-r1.jsonl"
    log = AuditLog(file, lambda: 3.0, lambda _: None, lambda: 0.0)
    log.write("reset", who="anna")
    context = run_context(system=shipped_system(), hmi_audit_log=str(file), run_id="r1")
    assert [(x.who, x.what) for x in Trial(context, 10.0).conclude(5.0, "over").audit] == [
        ("anna", "reset")]
    assert RunPlan().page.audit_log == ""


# -- Curves of a robot's numbers in the report of its run --


def test_a_report_draws_each_number_over_the_whole_run_in_a_bounded_number_of_points():
    recorder = CurveRecorder((LEVEL, PUMP))
    assert recorder.topics == {"tank/level": LEVEL, "tank/pump": PUMP}
    for i in range(20_000):
        header = Header("tank", 1, i, i / 10)
        recorder.take(LEVEL, Level(math.nan if i == 7 else math.sin(i / 1000)), header)
    recorder.take(PUMP, Pump(Phase.IDLE, 3.0), header)
    heights = next(curve for curve in recorder.curves() if curve.field == "height_m")
    assert MOST / 4 < len(heights.points) <= MOST
    assert heights.points[0][0] == 0.0
    assert heights.points[-1][0] > 1990
    gaps = [b[0] - a[0] for a, b in zip(heights.points, heights.points[1:], strict=False)]
    assert max(gaps) < 20
    page = render(RunRecorder(RunPlan("r")).record(2000.0, curves=recorder.curves()), "a tank")
    assert page.count("<polyline") == len(recorder.curves()) == 3
    assert "height_m" in page


def test_a_robot_without_regular_numbers_has_no_curves():
    assert CurveRecorder(()).curves() == ()


# -- How late event loops were, and the rate with which the machine would have kept up --


TIMING = shipped_system().timing


def table(**late_s: float) -> NodeTable:
    return NodeTable(tuple(
        NodeInfo(name, "control", 1, NodeState.RUNNING, 1, 0, s or ON_TIME)
        for name, s in late_s.items()))


def run(late_s: list[float], rate: float = 1.0, world_s: float = 0.0) -> tuple[KeptUp, list[str]]:
    """Measure one table a half real second; return the result and the lines."""
    keeping, step_s = KeepingUp(TIMING, ["world"], rate), 0.5 * rate
    lines = [keeping.take(table(a=s, b=0.0, world=world_s), i * step_s)
             for i, s in enumerate(late_s)]
    return keeping.result(len(late_s) * step_s), list(filter(None, lines))


def test_a_machine_that_keeps_up_is_told_nothing():
    kept, lines = run([0.0, 0.02, 0.1, 0.15] * 10)
    assert lines == []
    assert (kept.rate, kept.with_rate, kept.behind_s) == (1.0, 1.0, 0.0)
    assert (kept.late_s, kept.node) == (0.15, "a")


@pytest.mark.parametrize(("rate", "late_s", "with_rate"), [
    (4.0, 0.6, 1.0), (4.0, 0.2, 3.0), (1.0, 0.3, 0.5)])
def test_the_rate_it_keeps_up_with_is_that_at_which_the_same_real_lateness_is_in_order(
        rate, late_s, with_rate):
    kept, _ = run([late_s] * 40, rate)
    assert kept.with_rate == pytest.approx(with_rate)
    assert kept.behind_s == pytest.approx(40 * 0.5 * rate)


def test_it_is_said_while_it_runs_with_node_and_world_and_not_too_often():
    _, lines = run([0.6] * 100, 4.0, world_s=0.36)
    assert lines[0] == (
        "this machine keeps up with rate 1, not 4: event loops are up to 600 ms late (a), the "
        "world 360 ms behind; allowed are 150 ms of simulated time")
    assert len(lines) == pytest.approx(50 / LINE_S, abs=3)


def test_a_hiccup_is_told_and_does_not_lower_the_rate_and_a_short_run_has_a_figure_too():
    kept, lines = run([0.0] * 20 + [0.9] + [0.0] * 40)
    assert len(lines) == 1
    assert (kept.with_rate, kept.late_s) == (1.0, 0.9)
    assert kept.behind_s == pytest.approx(WINDOW_S)
    kept, _ = run([0.6], 4.0)  # over before a window is full
    assert (kept.with_rate, kept.late_s) == (pytest.approx(1.0), 0.6)


def test_while_the_system_starts_nothing_is_measured():
    keeping = KeepingUp(TIMING, [], 1.0)
    assert keeping.take(table(a=2.0), -0.5) == ""
    assert keeping.result(1.0) == KeptUp(1.0, 1.0, 0.0, "", 0.0, allowed_late_s(TIMING), 0.0)
