"""The distributions that a campaign's report shows, by kind of fault. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rampart.sim.campaign import charts
from rampart.sim.campaign.grouping import by_kind
from rampart.sim.campaign.store import Run
from rampart.sim.campaign.wording import count
from rampart.sim.runs.trial import Trial


def distributions(runs: Sequence[Run], trial: type[Trial]) -> list[charts.Chart]:
    """Return the charts of some runs; those without anything to show are left out.

    Args:
        runs: of one system.
        trial: of that system.
    """
    counted = [run for run in runs if run.result.counts]
    faulty = [run for run in counted if run.job.ftm and run.job.faults]
    made = []
    for name, title, words, done in (
            ("detected_after_s", "Time to detect",
             "From the injection of the fault to the first detection, with FTM.", "detected"),
            ("recovered_after_s", "Time to recover",
             "From the injection to the moment when nothing was left to recover, with FTM.",
             "recovered")):
        lanes: list[tuple[str, list[charts.Value], str]] = []
        never = []
        for kind, there in by_kind(faulty).items():
            values = [charts.Value(value, not run.result.safe) for run in there
                      if (value := getattr(run.result, name)) is not None]
            if values:
                lanes.append((kind, values, _beside(len(values), len(there), f"not {done}")))
            else:
                never.append(f"{kind} ({count(len(there), 'run')})")
        if lanes:
            more = f" Never {done}: {', '.join(never)}." if never else ""
            axis = charts.time_axis([each.value for _, values, _ in lanes for each in values])
            made.append(charts.chart(title, words + more, axis, lanes))
    for ftm, title in ((True, "Smallest margin with FTM"), (False, "Smallest margin without FTM")):
        margins = {kind: [charts.Value(run.result.margin, not run.result.safe) for run in there]
                 for kind, there in by_kind(r for r in counted if r.job.ftm == ftm).items()}
        every = [each.value for there in margins.values() for each in there]
        if any(map(math.isfinite, every)):
            exact = ("" if trial.exact_below is None else
                     f" Measured exactly below {trial.exact_below:g} {trial.margin_unit} only.")
            made.append(charts.chart(
                title, f"The smallest of: {', '.join(trial.margins.values())}.{exact}",
                charts.margin_axis([v for v in every if math.isfinite(v)], trial.exact_below,
                                   trial.margin_unit),
                [(kind, there, count(len(there), "run"))
                 for kind, there in margins.items()]))
    return made


def _beside(known: int, of: int, without: str) -> str:
    return count(of, "run") + (f", {of - known:,} {without}" if known < of else "")
