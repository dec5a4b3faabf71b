"""Report of a campaign: one self-contained HTML page.

It shows what was run, the results with their confidence, and the worst runs with the commands that
repeat them. All figures come from the runs.

A robot's package may have campaigns with expected results: entry points of the group
`rampart.campaigns` name classes derived from `NamedCampaign`. Each adds its options to `rampart
campaign`, and a section to the report.
"""

from __future__ import annotations

import argparse
import math
import re
import shlex
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from markupsafe import Markup

from rampart.files.writing import replace_file
from rampart.manager.spec.schema import SystemSpec
from rampart.sim.campaign.job import Job, RunResult, trial_of_system
from rampart.sim.campaign.statistics import (
    Condition,
    Row,
    Spread,
    badness,
    by_kind,
    conditions,
    count,
    in_common,
    interval,
    kind_of,
    percent,
    rate,
    seconds,
    table,
    total,
)
from rampart.sim.campaign.store import Run
from rampart.sim.runs.report import NONE, environment, margin_text
from rampart.sim.runs.trial import Trial


@dataclass(frozen=True)
class Section:
    """Additional section of a campaign's report.

    Args:
        sentence: For the headline.
        html: Makes the section from the keys of the runs shown one by one, and a function from a
            run's key to the command that repeats it.
    """

    sentence: str
    html: Callable[[set[str], Callable[[str], str]], Markup]


class NamedCampaign(ABC):
    """A campaign with expected results.

    Attributes:
        flag: Its option.
        name: Name of the folder of its results.
        title: Title of its report.
        system: Its system, unless `--system` names another.
    """

    flag: str
    name: str
    title: str
    system: str

    @classmethod
    @abstractmethod
    def add(cls, group: Any) -> None:
        """Add its options to an argument group."""

    @classmethod
    @abstractmethod
    def chosen(cls, options: argparse.Namespace) -> Self | None:
        """Return the campaign if the options select it, else None.

        Raises:
            ValueError: The options are invalid.
        """

    @abstractmethod
    def jobs(self, base: Job) -> list[Job]:
        """Return its runs; `base` has the chosen system, options and seed."""

    @abstractmethod
    def section(self, spec: SystemSpec, runs: Sequence[Run]) -> Section:
        """Return its section of the report."""

    @abstractmethod
    def show(self, spec: SystemSpec, runs: Sequence[Run]) -> None:
        """Print its results."""

    def expected(self, runs: Sequence[Run], row: Row) -> dict[str, Any]:
        """Return what `--json` adds to a row."""
        del runs, row
        return {}

    def failed(self, runs: Sequence[Run]) -> bool:
        """Return whether the exit code has to be 1."""
        del runs
        return False


FILE_NAME = "report.html"

SHOWN_AT_ONCE = 12
"""Faults of a kind that are shown; the others are folded."""

DECISIONS = 8
"""Most decisions that are shown of a run."""


@dataclass(frozen=True)
class Campaign:
    """Data that a reader needs to repeat the campaign.

    Args:
        title: Of the page.
        command: As typed.
        seed: Of all random numbers.
        section: Section of a named campaign.
    """

    title: str
    command: str
    seed: int
    section: Section | None = None


def write_campaign_report(directory: Path, about: Campaign, runs: Sequence[Run]) -> Path:
    """Write `report.html` into the campaign's directory, atomically.

    Args:
        directory: Of the campaign, as the user names it; made if necessary.
        about: The campaign.
        runs: All runs, of one system.

    Returns:
        The path of the page.

    Raises:
        OSError: The directory cannot be written.
    """
    directory.mkdir(parents=True, exist_ok=True)
    page = directory / FILE_NAME
    replace_file(page, render(directory, about, runs).encode(), 0o644)
    return page


def render(directory: Path, about: Campaign, runs: Sequence[Run]) -> str:
    """Return the HTML page; arguments as for `write_campaign_report`."""
    found = conditions(runs)
    trial = trial_of_system(runs[0].job.system) if runs else Trial
    worst = worth_showing(runs)
    texts = {run.job.key: condition.text for condition in found for run in condition.runs}
    pages = environment()
    pages.filters["breakable"] = _breakable
    shown = {run.job.key for run in worst}

    def replay(key: str) -> str:
        return shlex.join(["rampart", "campaign", "--replay", key, "--out", str(directory)])

    return pages.get_template("campaign/report.html").render(
        about=about, runs=runs, headline=headline(runs), in_common=in_common(runs),
        section=about.section and about.section.html(shown, replay),
        sentence=about.section and about.section.sentence,
        summary=[(each, _summary(each, trial)) for each in found],
        every=_every_fault(found, trial), shown_at_once=SHOWN_AT_ONCE,
        worst=[(run, texts[run.job.key], kind_of(run.job), _margin(run.result.margin, trial),
                moments(run.result)) for run in worst], shown=shown, most=DECISIONS,
        failures=[(run.job.key, text) for run in runs for text in run.result.failures],
        replay=replay, margins=list(trial.margins.values()), exact_below=trial.exact_below,
        unit=trial.margin_unit, none=NONE)


def headline(runs: Sequence[Run]) -> str:
    """Return the result of the campaign in one or two sentences."""
    if not runs:
        return "No run was made."
    faulty = [run for run in runs if run.job.faults]
    if not all(run.result.judged for run in runs):
        detected = sum(run.result.detected_after_s is not None for run in faulty)
        restarts = sum(run.result.restarts for run in runs)
        return (f"{count(len(runs), 'run')} without a judge: of {len(faulty):,} with a fault "
                f"{sum(run.result.effective for run in faulty):,} had an effect and {detected:,} "
                f"were detected; {count(restarts, 'restart')}.")
    if not faulty:
        return (f"{count(len(runs), 'run')} without a fault: {_many(runs, 'unsafe')}, "
                f"{_many(runs, 'complete')}.")
    parts: list[str] = []
    for ftm, name in ((True, "With fault tolerance"), (False, "Without fault tolerance")):
        counted = [run for run in faulty if run.job.ftm == ftm and run.result.counts]
        if counted:
            parts.append(f"{name} {_many(counted, 'unsafe')}; {_many(counted, 'complete')}.")
    if lost := sum(not run.result.counts for run in faulty):
        parts.append(f"In {count(lost, 'run')}{' more' if parts else ''} the fault had no effect.")
    return " ".join(parts).replace(" %", "\N{NO-BREAK SPACE}%")


def _breakable(text: str) -> Markup:
    """Return an escaped name with line breaks allowed after its separators."""
    return Markup("<wbr>").join(re.split(r"(?<=[:/_])", text))


def _many(runs: Sequence[Run], what: str) -> str:
    """Return the number of unsafe runs with its interval, or of completed missions."""
    if what == "complete":
        return f"{sum(run.result.success for run in runs):,} completed the mission"
    found = rate(sum(not run.result.safe for run in runs), len(runs))
    number = f"{found.count:,}" if found.count else "none"
    sure = interval(found) if found.count else f"at most {percent(found.high)} %"
    return (f"{number} of {count(found.of, 'run')} {'was' if found.count == 1 else 'were'} unsafe "
            f"(95 % interval: {sure})")


# -- tables ------------------------------------------------------------------------------------


def _summary(condition: Condition, trial: type[Trial]) -> list[dict[str, Any]]:
    """Return one line per kind of fault, and one for all if there are several kinds."""
    kinds = by_kind(condition.runs)
    lines = [_cells(total(runs, kind), condition.ftm, trial) for kind, runs in kinds.items()]
    faulty = [run for run in condition.runs if run.job.faults]
    if sum(bool(runs[0].job.faults) for runs in kinds.values()) > 1:
        lines.append(_cells(total(faulty, "all faults"), condition.ftm, trial) | {"sum": True})
    return lines


def _every_fault(found: Sequence[Condition], trial: type[Trial]
                 ) -> list[tuple[str, int, list[list[dict[str, Any]]]]]:
    """Return title, number of rows, and rows by fault, worst fault first, of each kind."""
    kinds: dict[str, dict[str, list[tuple[Condition, Row]]]] = {
        kind: {} for kind in by_kind(run for condition in found for run in condition.runs)}
    for condition in found:
        for kind, runs in by_kind(condition.runs).items():
            for row in table(runs):
                kinds[kind].setdefault(row.fault, []).append((condition, row))
    every = []
    for kind, faults in kinds.items():
        ordered = sorted(faults.values(), key=_how_good)
        if ordered:
            every.append((kind, sum(map(len, ordered)), [
                [_cells(row, condition.ftm, trial) | {"condition": condition.text}
                 for condition, row in rows] for rows in ordered]))
    return every


def _how_good(rows: Sequence[tuple[Condition, Row]]) -> tuple[Any, ...]:
    """Return a key that sorts faults worst first, by their rows with FTM if any."""
    with_ftm = [row for condition, row in rows if condition.ftm]
    counted = [row for row in with_ftm or [row for _, row in rows] if row.safe.of]
    least = [s.least for row in counted for s in row.margins.values() if s]
    return (not counted, min((row.safe.share for row in counted), default=1.0),
            min((row.success.share for row in counted), default=1.0),
            min(least, default=math.inf), rows[0][1].fault)


def _cells(row: Row, ftm: bool, trial: type[Trial]) -> dict[str, Any]:
    """Return a row as texts; a pair is a figure and the text below it."""
    counted = row.safe.of
    detected, recovered = row.detected_after_s, row.recovered_after_s
    found = [seconds(detected.median), *_tail(detected)] if ftm and detected else [NONE]
    if ftm and row.undetected:
        found.append(f"{row.undetected:,} not detected")
    if ftm:
        found += [f"first by {name}: {number:,}" for name, number in row.first_by.items()][:3]
        found += [f"{name} idle: {number:,}" for name, number in row.idle.items()]
    calm = [seconds(recovered.median), *_tail(recovered)] if ftm and recovered else [NONE]
    if ftm and recovered and recovered.n < counted:
        calm.append(f"{counted - recovered.n:,} not recovered")
    return {
        "sum": False, "fault": row.fault, "key": row.worst_key,
        "worst": row.worst if row.judged else NONE,
        "runs": (f"{row.runs:,}", f"{row.ineffective:,} no effect" if row.ineffective else ""),
        "success": _share(row.success.count, counted if row.judged else 0),
        "safe": _share(row.safe.count, counted if row.judged else 0),
        "unsafe": row.safe.count < counted,
        "detected": (found[0], "\n".join(found[1:])),
        "recovered": (calm[0], "\n".join(calm[1:])),
        "margins": [_margin(each.least if (each := row.margins.get(name)) else None, trial)
                    for name in trial.margins],
        "false_alarms": f"{row.false_alarms:,}" if ftm and counted else NONE,
        "stopped": f"{row.stopped_for_good:,}" if counted else NONE,
    }


def _share(number: int, of: int) -> tuple[str, str]:
    return (f"{number:,} of {of:,}", interval(rate(number, of))) if of else (NONE, "")


def _tail(found: Spread) -> list[str]:
    """Return the upper end of a spread; with fewer than 20 values the p95 is the maximum."""
    most = [f"max {seconds(found.most)}"] if found.n > 1 else []
    return [f"p95 {seconds(found.p95)}", *most] if found.n >= 20 else most


def _margin(value: float | None, trial: type[Trial]) -> str:
    return margin_text(value, trial.margin_unit, trial.exact_below)


def worth_showing(runs: Sequence[Run], most: int = 6) -> list[Run]:
    """Return the worst runs, each with another fault, those with fault tolerance first.

    Runs without any effect are left out.
    """
    different: dict[tuple[bool, tuple[str, ...]], Run] = {}
    for run in sorted(runs, key=lambda run: (run.job.ftm, badness(run)), reverse=True):
        bad = not (run.result.safe and run.result.success)
        if bad or (run.job.faults and run.result.effective):
            faults = tuple(sorted(fault.fault for fault in run.job.faults))
            different.setdefault((run.job.ftm, faults), run)
    return list(different.values())[:most]


def moments(result: RunResult) -> list[tuple[float, str]]:
    """Return the events of a run in their order: simulated seconds, and a text."""
    detected_s = (None if result.injected_s is None or result.detected_after_s is None
                  else result.injected_s + result.detected_after_s)
    marks = [(at_s, name) for name, at_s in (
        ("fault injected", result.injected_s), ("first detection", detected_s),
        ("smallest margin", result.narrowest_s if result.safe else None),
        ("first unsafe", result.unsafe_s), ("end of the run", result.duration_s))
        if at_s is not None]
    return sorted([*marks, *(
        (d.t_s, f"{', '.join(d.active) or 'nothing'}: {', '.join(d.recoveries) or 'no recovery'}")
        for d in result.decisions[:DECISIONS])])
