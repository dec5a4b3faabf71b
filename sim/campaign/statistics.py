"""Statistics of a campaign's runs, and their figures as text. Pure."""

from __future__ import annotations

import math
import statistics
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec

from rampart.sim.campaign.job import Job, application_of_system, faults_of_system, trial_of_system
from rampart.sim.campaign.store import Run
from rampart.sim.runs.report import NONE

CONFIDENCE_Z = 1.959963984540054
"""Two-sided 95 %."""

NO_EFFECT = "no effect"
"""Verdict of a row in which no run counts."""


class Rate(msgspec.Struct, frozen=True):
    """A share of runs with its 95 % confidence interval (Wilson 1927)."""

    count: int
    of: int
    low: float
    high: float

    @property
    def share(self) -> float:
        """The share seen; not a number if there were no runs."""
        return self.count / self.of if self.of else math.nan


class Spread(msgspec.Struct, frozen=True):
    """A figure over some runs: how many have it, minimum, median, 95th percentile, maximum."""

    n: int
    least: float
    median: float
    p95: float
    most: float


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """All runs with one fault under one condition.

    `seeds` is the number of different seeds. Runs without an effect are `ineffective` and count for
    nothing else, unless they were unsafe or failed: see `RunResult.counts`. `first_by` counts runs
    by the module that detected something first. `idle` counts, of a fault of the specification,
    runs in which a module of its `detected_by` detected nothing.
    """

    fault: str
    options: dict[str, Any]
    ftm: bool
    strategy: str
    retuned: dict[str, dict[str, Any]]
    judged: bool
    runs: int
    seeds: int
    ineffective: int
    restarts: int
    success: Rate
    safe: Rate
    worst: str
    worst_key: str
    stopped_for_good: int
    undetected: int
    first_by: dict[str, int]
    idle: dict[str, int]
    false_alarms: int
    detected_after_s: Spread | None
    recovered_after_s: Spread | None
    margins: dict[str, Spread | None]


def rate(count: int, of: int) -> Rate:
    """Return a share with its interval; (0, 1) if there were no runs."""
    if of == 0:
        return Rate(0, 0, 0.0, 1.0)
    z2 = CONFIDENCE_Z**2
    share = count / of
    middle = (share + z2 / (2 * of)) / (1 + z2 / of)
    half = CONFIDENCE_Z / (1 + z2 / of) * math.sqrt(
        share * (1 - share) / of + z2 / (4 * of * of))
    # At the ends the formula gives 0 and 1 but for rounding.
    low = 0.0 if count == 0 else max(0.0, middle - half)
    high = 1.0 if count == of else min(1.0, middle + half)
    return Rate(count, of, low, high)


def spread(values: Iterable[float | None]) -> Spread | None:
    """Return the spread of the finite values, None without any."""
    known = sorted(v for v in values if v is not None and math.isfinite(v))
    if not known:
        return None
    return Spread(len(known), known[0], statistics.median(known),
                  known[min(len(known) - 1, math.ceil(0.95 * len(known)) - 1)], known[-1])


def verdict(run: Run) -> str:
    """Return "success, safe" and the like."""
    return (f"{'success' if run.result.success else 'fail'}, "
            f"{'safe' if run.result.safe else 'unsafe'}")


def badness(run: Run) -> tuple[bool, bool, float]:
    """Return a key to sort runs by: unsafe, failed, small margin."""
    return (not run.result.safe, not run.result.success, -run.result.margin)


def worst(runs: Iterable[Run]) -> Run:
    """Return the worst run, whose verdict is that of the row (paper, section V)."""
    return max(runs, key=badness)


def table(runs: Iterable[Run]) -> list[Row]:
    """Return one row per fault and condition (options, FTM, strategy, retuned modules).

    Rows are in order of first appearance.
    """
    rows: dict[tuple[object, ...], list[Run]] = {}
    for run in runs:
        job = run.job
        condition = msgspec.json.encode((job.options, job.retuned), order="deterministic")
        rows.setdefault((job.row, job.ftm, job.strategy, condition), []).append(run)
    return [_row(found[0].job, found) for found in rows.values()]


def total(runs: Sequence[Run], name: str) -> Row:
    """Return all runs, at least one, as one row."""
    return _row(Job(row=name), runs)


def _row(condition: Job, runs: Sequence[Run]) -> Row:
    counted = [run for run in runs if run.result.counts]
    results = [run.result for run in counted]
    effective = [run for run in counted if run.result.outcomes and run.result.effective]
    bad = worst(counted or runs)
    return Row(
        fault=condition.row, options=condition.options, ftm=condition.ftm,
        strategy=condition.strategy, retuned=condition.retuned, runs=len(runs),
        seeds=len({run.job.seed for run in runs}),
        judged=all(run.result.judged for run in runs), ineffective=len(runs) - len(counted),
        restarts=sum(run.result.restarts for run in runs),
        success=rate(sum(r.success for r in results), len(results)),
        safe=rate(sum(r.safe for r in results), len(results)),
        worst=verdict(bad) if counted else NO_EFFECT, worst_key=bad.job.key,
        stopped_for_good=sum(r.stopped_for_good for r in results),
        undetected=sum(run.result.detected_after_s is None for run in effective),
        first_by=dict(Counter(name for r in results for name in r.detected_by[:1]).most_common()),
        idle=dict(Counter(name for run in effective if run.job.ftm for name in _expected(run.job)
                          if name not in run.result.detected_by)),
        false_alarms=sum(r.false_alarms for r in results),
        detected_after_s=spread(r.detected_after_s for r in results),
        recovered_after_s=spread(r.recovered_after_s for r in results),
        margins={name: spread(r.margins.get(name) for r in results)
                 for name in dict.fromkeys(name for r in results for name in r.margins)})


def _expected(job: Job) -> set[str]:
    """Return the modules that should detect a run's faults, as the specification says."""
    named = faults_of_system(job.system).named
    return {module for fault in job.faults if fault.fault in named
            for module in named[fault.fault].detected_by}


def as_json(row: Row) -> dict[str, object]:
    """Return a row for scripts: options and margins among the figures, rates as counts."""
    more = msgspec.to_builtins(row)
    options, margins = more.pop("options"), more.pop("margins")
    if not row.judged:
        more |= dict.fromkeys(("success", "safe", "success_interval", "safe_interval", "worst"))
        return {**options, **margins, **more}
    return {**options, **margins, **more, "success": row.success.count, "safe": row.safe.count,
            "success_interval": [row.success.low, row.success.high],
            "safe_interval": [row.safe.low, row.safe.high]}


def percent(share: float) -> str:
    """Return a share in percent without the sign; only what is 0 or 1 reads "0" or "100"."""
    if math.isnan(share):
        return NONE
    if share in (0.0, 1.0):
        return f"{100 * share:.0f}"
    for digits in (1, 2):
        text = f"{100 * share:.{digits}f}"
        if 0 < float(text) < 100:
            return text
    return "< 0.01" if share < 0.5 else "> 99.99"


def interval(found: Rate) -> str:
    """Return the confidence interval of a share, "" without runs."""
    return f"{percent(found.low)} to {percent(found.high)} %" if found.of else ""


def seconds(value: float) -> str:
    """Return a time with three digits: milliseconds below a second."""
    if value < 0.9995:
        return f"{value * 1e3:.0f} ms"
    return f"{value:.{2 if value < 9.995 else 1 if value < 99.95 else 0}f} s"


def count(number: int, what: str) -> str:
    """Return "1 run", "2 runs", "1,200 runs"."""
    return f"{number:,} {what}{'' if number == 1 else 's'}"


@dataclass(frozen=True)
class Condition:
    """Runs with the same condition; `text` names only what varies."""

    text: str
    ftm: bool
    runs: list[Run]


def kind_of(job: Job) -> str:
    """Return the title of the kind of a run's faults."""
    faults = faults_of_system(job.system)
    if len(job.faults) == 1:
        return faults.kinds[faults.kind_of(job.faults[0].fault)]
    return faults.kinds["several" if job.faults else "none"]


def by_kind(runs: Iterable[Run]) -> dict[str, list[Run]]:
    """Return the runs by kind, in the robot's order; kinds without runs are left out."""
    found: dict[str, list[Run]] = {}
    for run in runs:
        for kind in faults_of_system(run.job.system).kinds.values():
            found.setdefault(kind, [])
        found[kind_of(run.job)].append(run)
    return {kind: there for kind, there in found.items() if there}


def conditions(runs: Sequence[Run]) -> list[Condition]:
    """Return the runs by condition: without FTM first, then by mechanisms and strategy."""
    values_of = _values(runs)
    varying = [name for name, values in values_of.items() if len(set(values) - {""}) > 1]
    groups: dict[tuple[str, ...], list[Run]] = {}
    for number, run in enumerate(runs):
        key = ("with FTM" if run.job.ftm else "without FTM",
               *(values_of[name][number] for name in varying))
        groups.setdefault(key, []).append(run)
    found = [Condition(", ".join(filter(None, key)), there[0].job.ftm, there)
             for key, there in groups.items()]
    return sorted(found, key=lambda condition: (condition.ftm, condition.text))


def in_common(runs: Sequence[Run]) -> list[str]:
    """Return the conditions that all runs have in common."""
    found = [set(values) - {""} for values in _values(runs).values()]
    return [next(iter(values)) for values in found if len(values) == 1]


def varying_options(runs: Iterable[Run]) -> list[str]:
    """Return the options of the application that differ among runs."""
    options = [run.job.options for run in runs]
    return [name for name in dict.fromkeys(name for each in options for name in each)
            if any(each.get(name) != options[0].get(name) for each in options)]


def _values(runs: Sequence[Run]) -> dict[str, list[str]]:
    """Return the parts of a condition besides FTM: a text per run, "" for none."""
    jobs = [run.job for run in runs]
    return {
        "mechanisms": [_mechanisms(job) for job in jobs],
        "strategy": [(job.strategy or "the system's strategy") if job.ftm else "" for job in jobs],
        "system": [f"system {job.system}" for job in jobs],
        **{name: [application_of_system(job.system).said(name, job.options[name])
                  if name in job.options else "" for job in jobs]
           for name in dict.fromkeys(name for job in jobs for name in job.options)},
        "network": [f"{job.network} network" for job in jobs],
        "patience": [f"given up after {job.patience_s:g} s without progress" for job in jobs],
    }


def _mechanisms(job: Job) -> str:
    if not job.ftm or not job.retuned:
        return "mechanisms as shipped" if job.ftm else ""
    for name, retuned in trial_of_system(job.system).retunings.items():
        if job.retuned == retuned:
            return name
    return "retuned " + msgspec.json.encode(job.retuned, order="deterministic").decode()
