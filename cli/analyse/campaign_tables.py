"""The results of a campaign, on the terminal and as JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rampart.cli.output import print_json, print_table, say
from rampart.manager.spec.schema import SystemSpec
from rampart.sim.campaign import statistics
from rampart.sim.campaign.named import NamedCampaign
from rampart.sim.campaign.statistics import Rate, Row, Spread, table, total, varying_options
from rampart.sim.campaign.store import Run
from rampart.sim.runs.report import NONE, margin_text
from rampart.sim.runs.trial import Trial, trial_class

_SHOWN = 60
"""Rows, at most; the report has all."""


def show_runs(spec: SystemSpec, runs: Sequence[Run], made: int, named: NamedCampaign | None, *,
              as_json: bool) -> None:
    """Print the results.

    Args:
        spec: the system.
        runs: all runs of the campaign.
        made: number of runs made now.
        named: the named campaign, if it is one.
        as_json: print rows for scripts.
    """
    rows = table(runs)
    if as_json:
        print_json([statistics.as_json(row) | (named.expected(runs, row) if named else {})
                    for row in rows])
        return
    if named:
        named.show(spec, runs)
    else:
        _show_rows(spec, runs, rows)
    say()
    say(f"{len(runs)} runs, {made} of them made now")
    protected = [run for run in runs if run.job.ftm and run.job.faults]
    if protected and trial_class(spec).judges:
        all_of_them = total(protected, "all")
        say(f"with fault tolerance: {_rate(all_of_them.safe)} safe, {_rate(all_of_them.success)} "
            f"successful, {all_of_them.ineffective} without effect")


def show_faults(groups: Mapping[str, Sequence[str]], *, as_json: bool) -> int:
    """Print the faults by kind; return the exit code."""
    if as_json:
        print_json(groups, names=True)
        return 0
    for kind, names in groups.items():
        say(f"{kind} ({len(names)})")
        for name in names:
            say(f"  {name}")
    return 0


def _show_rows(spec: SystemSpec, runs: Sequence[Run], rows: Sequence[Row]) -> None:
    options, trial = varying_options(runs), trial_class(spec)
    shown = sorted(rows, key=lambda row: (row.safe.share if row.safe.of else 2.0,
                                          row.success.share if row.success.of else 2.0))
    verdicts = ("success", "safe", "worst") if trial.judges else ("restarts",)
    margins = ("smallest margin",) if trial.margins else ()
    print_table(
        ("fault", *options, "FTM", "strategy", "runs", "no effect", *verdicts, "detected after",
         "first by", *margins),
        [_cells(row, options, trial) for row in shown[:_SHOWN]])
    if len(shown) > _SHOWN:
        say(f"... and {len(shown) - _SHOWN} rows more, in the report")


def _cells(row: Row, options: Sequence[str], trial: type[Trial]) -> tuple[Any, ...]:
    margin = min((s.least for s in row.margins.values() if s), default=None)
    margins = (margin_text(margin, trial.margin_unit, None),) if trial.margins else ()
    return (row.fault, *(row.options.get(name, NONE) for name in options),
            "yes" if row.ftm else "no", row.strategy or "-", row.runs, row.ineffective,
            *((_share(row.success), _share(row.safe), row.worst) if row.judged
              else (row.restarts,)), _milliseconds(row.detected_after_s), _detecting(row), *margins)


def _detecting(row: Row) -> str:
    """Return the module that detected most often first, and those expected that stayed idle."""
    first = next(iter(row.first_by), NONE)
    return "; ".join([first, *(f"{name} idle: {number}" for name, number in row.idle.items())])


def _share(found: Rate) -> str:
    return f"{found.count}/{found.of}"


def _rate(found: Rate) -> str:
    return (f"{found.count} of {found.of} ({100 * found.share:.1f} %, 95 % interval "
            f"{100 * found.low:.2f} to {100 * found.high:.2f} %)" if found.of else "none")


def _milliseconds(found: Spread | None) -> str:
    return "-" if found is None else f"{found.median * 1e3:.0f} ms, at most {found.most * 1e3:.0f}"
