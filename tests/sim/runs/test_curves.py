"""Curves of a robot's numbers in the report of its run."""

from __future__ import annotations

import math

from rampart.actors.bus.envelope import Header
from rampart.actors.runtime.run_plan import RunPlan
from rampart.sim.runs.curves import MOST, CurveRecorder
from rampart.sim.runs.record import RunRecorder
from rampart.sim.runs.report import render
from tests.tank import LEVEL, PUMP, Level, Phase, Pump


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
