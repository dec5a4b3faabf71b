"""The worst runs of a campaign: which are worth a look, and what is shown of each. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rampart.sim.campaign.grouping import kind_of
from rampart.sim.campaign.statistics import badness
from rampart.sim.campaign.store import Run
from rampart.sim.runs.pictures import Moment
from rampart.sim.runs.record import RunRecord

_DECISIONS = 8


def worth_showing(runs: Sequence[Run], most: int = 6) -> list[Run]:
    """Return the runs that are worth a look: the worst ones, worst first.

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


def story(run: Run, record: RunRecord, narrowest_s: float | None) -> dict[str, Any]:
    """Return what is shown of one of the worst runs: what happened when.

    Args:
        run: of the campaign.
        record: of the same run, made again.
        narrowest_s: when the smallest margin was measured.
    """
    result = run.result
    detected_s = (None if result.injected_s is None or result.detected_after_s is None
                  else result.injected_s + result.detected_after_s)
    marks = [Moment(at_s, kind, name) for kind, name, at_s in (
        ("end", "end of the run", result.duration_s),
        ("fault", "fault injected", result.injected_s),
        ("detected", "first detection", detected_s),
        ("narrow", "smallest margin", narrowest_s if result.safe else None),
        ("unsafe", "first unsafe", result.unsafe_s)) if at_s is not None]
    return {
        "key": run.job.key, "fault": run.job.text(), "run": run, "kind": kind_of(run.job),
        "marks": marks,
        "moments": sorted([*marks, *(Moment(d.t_s, "", d.words)
                                     for d in record.decisions[:_DECISIONS])]),
        "more": max(0, len(record.decisions) - _DECISIONS),
    }


def _rank(run: Run) -> tuple[bool, tuple[bool, bool, float]]:
    return (run.job.ftm and not run.result.safe, badness(run))
