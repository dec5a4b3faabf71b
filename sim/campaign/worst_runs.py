"""The worst runs of a campaign: which are worth a look, and what is shown of each. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from rampart.sim.campaign.grouping import kind_of
from rampart.sim.campaign.statistics import badness
from rampart.sim.campaign.store import Run
from rampart.sim.campaign.wording import metres
from rampart.sim.osmosis.trial.record import MissionRecord
from rampart.sim.osmosis.trial.report import points

_DECISIONS = 8
_CLOSE_UP_M = 9.0
_ASPECT = 1.75
_ROUND_TRACK_M = 4.0


def worth_showing(runs: Sequence[Run], most: int = 6) -> list[Run]:
    """Return the runs whose tracks are worth a look: the worst ones, worst first.

    Each shows another fault. An unprotected robot is unsafe as a matter of course, so runs
    without fault tolerance get at most half of the places that runs with it could fill, and an
    unsafe run with it comes before all others. Runs in which nothing went wrong are left out.
    """
    ranked = sorted(runs, key=_rank, reverse=True)
    different: dict[tuple[bool, tuple[str, ...]], Run] = {}
    for run in ranked:
        bad = not (run.result.safe and run.result.success)
        if bad or (run.job.faults and run.result.effective):
            faults = tuple(sorted(fault.fault for fault in run.job.faults))
            different.setdefault((run.job.ftm, faults), run)
    protected = [run for run in different.values() if run.job.ftm]
    bare = [run for run in different.values() if not run.job.ftm]
    bare = bare[:max(most // 2, most - len(protected))]
    return sorted([*protected[:most - len(bare)], *bare], key=_rank, reverse=True)


def track(run: Run, record: MissionRecord) -> dict[str, Any]:
    """Return what is shown of one of the worst runs: its map, a close-up, and its story."""
    result = run.result
    detected_s = (None if result.injected_s is None or result.detected_after_s is None
                  else result.injected_s + result.detected_after_s)
    marks = [(kind, name, at_s, *_place(record, at_s)) for kind, name, at_s in (
        ("end", "end of the run", result.duration_s),
        ("fault", "fault injected", result.injected_s),
        ("detected", "first detection", detected_s),
        ("narrow", "smallest margin", record.narrowest_s if result.safe else None),
        ("unsafe", "first unsafe", result.unsafe_s)) if at_s is not None and record.track]
    views = []
    if record.track:
        views.append(_view(record))
        focus = next((mark for kind in ("unsafe", "narrow")
                      for mark in marks if mark[0] == kind), marks[0])
        views.append((focus[3] - _CLOSE_UP_M / 2, focus[4] - _CLOSE_UP_M / 2,
                      _CLOSE_UP_M, _CLOSE_UP_M))
    return {
        "key": run.job.key, "fault": run.job.text(), "run": run,
        "kind": kind_of(run.job), "marks": marks, "views": views,
        "line": points(record.track), "obstacles": record.obstacles, "goals": record.steps,
        "margin": metres(result.margin_m),
        "moments": sorted([*((at_s, kind, name) for kind, name, at_s, *_ in marks),
                           *((d.t_s, "", d.words) for d in record.decisions[:_DECISIONS])]),
        "more": max(0, len(record.decisions) - _DECISIONS),
    }


def _view(record: MissionRecord) -> tuple[float, float, float, float]:
    """Return left, bottom, width and height of the map, in metres: the track and its goals."""
    xs = [p[1] for p in record.track] + [goal.x_m for goal in record.steps]
    ys = [p[2] for p in record.track] + [goal.y_m for goal in record.steps]
    x0, x1 = min(xs) - _ROUND_TRACK_M, max(xs) + _ROUND_TRACK_M
    y0, y1 = min(ys) - _ROUND_TRACK_M, max(ys) + _ROUND_TRACK_M
    width = max(x1 - x0, (y1 - y0) * _ASPECT)
    height = width / _ASPECT
    return ((x0 + x1 - width) / 2, (y0 + y1 - height) / 2, width, height)


def _place(record: MissionRecord, at_s: float) -> tuple[float, float]:
    """Return where the robot was, to the step of the track, m."""
    before = [p for p in record.track if p[0] <= at_s] or record.track[:1]
    return before[-1][1:] if before else (math.nan, math.nan)


def _rank(run: Run) -> tuple[bool, tuple[bool, bool, float]]:
    return (run.job.ftm and not run.result.safe, badness(run))
