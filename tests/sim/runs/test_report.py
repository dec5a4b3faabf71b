"""Who did what on the operator's page, in the report of any run."""

from __future__ import annotations

import json
import math

from rampart.actors.bus.envelope import Header
from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.web.audit import AuditLine, AuditLog
from rampart.sim.runs.curves import MOST, CurveRecorder
from rampart.sim.runs.record import RunRecord, RunRecorder
from rampart.sim.runs.report import render, try_report
from rampart.sim.runs.trial import Trial
from tests.osmosis_system import run_context, shipped_system
from tests.tank import LEVEL, PUMP, Level, Phase, Pump


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
