"""Who did what on the operator's page, in the report of any run."""

from __future__ import annotations

import json

from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.web.audit import AuditLine, AuditLog
from rampart.sim.runs.record import RunRecord
from rampart.sim.runs.report import render, try_report
from rampart.sim.runs.trial import Trial
from tests.osmosis_system import run_context, shipped_system


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
