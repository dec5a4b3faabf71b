"""The report of a campaign: one self-contained HTML page, a sibling of the inspection report.

It says what was run, what came of it, how sure that is, and shows the worst runs so that a reader
can repeat them. All figures come from the runs; the page needs nothing but itself.
"""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from markupsafe import Markup

from rampart.actors.osmosis.airport.drawing import AirportDrawing
from rampart.sim.campaign.defaults import EXACT_BELOW_M
from rampart.sim.campaign.distributions import distributions
from rampart.sim.campaign.grouping import Condition, by_kind, conditions, in_common
from rampart.sim.campaign.statistics import Row, Spread, rate, table, total
from rampart.sim.campaign.store import Run
from rampart.sim.campaign.wording import NONE, count, interval, metres, percent, seconds
from rampart.sim.campaign.worst_runs import track, worth_showing
from rampart.sim.osmosis.trial import paper_tables
from rampart.sim.osmosis.trial.paper_tables import CONDITIONS, FAULTS, FULL, GOOD, Cell, Decided
from rampart.sim.osmosis.trial.record import MissionRecord
from rampart.sim.runs.report import environment, write_atomically

__all__ = ["Campaign", "headline", "render", "worth_showing", "write_campaign_report"]

FILE_NAME = "report.html"

SHOWN_AT_ONCE = 12
"""Faults of a kind that are shown; the rest can be unfolded."""


@dataclass(frozen=True)
class Campaign:
    """What was run, so that it can be repeated.

    Args:
        title: Of the page.
        command: As typed.
        seed: Of all that is random.
        note: Anything else that a reader should know.
    """

    title: str
    command: str
    seed: int
    note: str = ""


def write_campaign_report(directory: Path, about: Campaign, runs: Sequence[Run],
                          decided: Sequence[Decided] = (),
                          worst_tracks: Mapping[str, MissionRecord] = {}) -> Path:
    """Write `report.html` into the campaign's directory; it appears complete or not at all.

    Args:
        directory: Of the campaign, as the user names it; it is made if need be.
        about: What was run.
        runs: All of them.
        decided: Table III, if it is to be shown.
        worst_tracks: Records of the runs to be shown on the map, by key; see `worth_showing`.

    Returns:
        The path of the page.

    Raises:
        OSError: The directory cannot be written.
    """
    directory.mkdir(parents=True, exist_ok=True)
    page = directory / FILE_NAME
    write_atomically(page, render(directory, about, runs, decided, worst_tracks).encode())
    return page


def render(directory: Path, about: Campaign, runs: Sequence[Run], decided: Sequence[Decided] = (),
           worst_tracks: Mapping[str, MissionRecord] = {}) -> str:
    """Return the HTML page; arguments as for `write_campaign_report`."""
    found = conditions(runs)
    cells = paper_tables.cells(runs) if are_the_papers(runs) else []
    by_key = {run.job.key: run for run in runs}
    tracks = [(by_key[key], record) for key, record in worst_tracks.items() if key in by_key]
    airports: list[AirportDrawing] = []
    for _, record in tracks:
        if record.airport not in airports:
            airports.append(record.airport)
    texts = {run.job.key: condition.text for condition in found for run in condition.runs}
    pages = environment()
    pages.filters["breakable"] = _breakable
    return pages.get_template("campaign/report.html").render(
        about=about, runs=runs, headline=headline(runs), figures=_figures(runs),
        in_common=in_common(runs), decided=decided, verdicts=_paper_tables(cells),
        agreeing=_agreement(cells), differing=[cell for cell in cells if not cell.agrees],
        summary=[(each, _summary(each)) for each in found], every=_every_fault(found),
        shown_at_once=SHOWN_AT_ONCE, charts=distributions(runs), airports=airports,
        tracks=[{"condition": texts[run.job.key], "airport": airports.index(record.airport),
                 "command": _replay(run.job.key, directory), **track(run, record)}
                for run, record in tracks],
        shown={run.job.key for run, _ in tracks}, failures=_failures(runs),
        replay=lambda key: _replay(key, directory), exact_below_m=EXACT_BELOW_M, none=NONE)


def are_the_papers(runs: Iterable[Run]) -> bool:
    """Tell whether the runs are those of the paper's tables IV and V, or some of them.

    Its rows have names of their own; only "none" is a row of other campaigns too.
    """
    rows = {run.job.row for run in runs}
    return bool(rows - {"none"}) and rows <= FAULTS.keys()


def headline(runs: Sequence[Run]) -> str:
    """Return the result of the campaign in a sentence or two."""
    if not runs:
        return "No run was made."
    faulty = [run for run in runs if run.job.faults]
    if not faulty:
        return (f"{_runs(len(runs))} without a fault: {_many(runs, 'unsafe')}, "
                f"{_many(runs, 'complete')}.")
    odd = sum(run.result.counts and not run.result.effective for run in faulty)
    parts: list[str] = []
    for ftm, name in ((True, "With fault tolerance"), (False, "Without fault tolerance")):
        counted = [run for run in faulty if run.job.ftm == ftm and run.result.counts]
        if counted:
            more = "" if parts or odd else "with an effective fault "
            parts.append(f"{name} {_many(counted, 'unsafe', more)}; "
                         f"{_many(counted, 'complete')}.")
    if odd:
        parts.append(f"In {odd:,} of these the fault had no effect; what ends badly counts all "
                     "the same.")
    if lost := sum(not run.result.counts for run in faulty):
        parts.append(f"In {_runs(lost)}{' more' if parts else ''} the fault had no effect.")
    return " ".join(parts).replace(" %", "\N{NO-BREAK SPACE}%")


def _replay(key: str, directory: Path) -> str:
    return shlex.join(["rampart", "campaign", "--replay", key, "--out", str(directory)])


def _breakable(text: str) -> Markup:
    """Return a name, escaped, that may be broken behind its separators."""
    return Markup("<wbr>").join(re.split(r"(?<=[:/_])", text))


def _runs(number: int) -> str:
    return count(number, "run")


def _many(runs: Sequence[Run], what: str, more: str = "") -> str:
    """Return how many of some runs were unsafe, with the interval, or completed the mission."""
    if what == "complete":
        return f"{sum(run.result.success for run in runs):,} completed the mission"
    found = rate(sum(not run.result.safe for run in runs), len(runs))
    number = f"{found.count:,}" if found.count else "none"
    sure = interval(found) if found.count else f"at most {percent(found.high)} %"
    return (f"{number} of {_runs(found.of)} {more}{'was' if found.count == 1 else 'were'} unsafe "
            f"(95 % interval: {sure})")


# -- tables ------------------------------------------------------------------------------------


def _figures(runs: Sequence[Run]) -> list[tuple[str, str, str]]:
    """Return name, value and class of the figures at the top; of runs with FTM and a fault."""
    figures = [("runs in all", f"{len(runs):,}", "")]
    protected = [run for run in runs if run.job.ftm and run.job.faults]
    if not any(run.result.counts for run in protected):
        return figures
    row = total(protected, "")
    unsafe = row.safe.of - row.safe.count
    return [
        *figures,
        ("with FTM and a fault, counted", f"{row.safe.of:,}", ""),
        ("not counted, no effect", f"{row.ineffective:,}", ""),
        ("of these unsafe", f"{unsafe:,}", "bad-text" if unsafe else "good-text"),
        ("mission completed", f"{percent(row.success.share)} %", ""),
        ("detected after, median",
         seconds(row.detected_after_s.median if row.detected_after_s else None), ""),
        ("stopped for good", f"{row.stopped_for_good:,}", ""),
    ]


def _summary(condition: Condition) -> list[dict[str, Any]]:
    """Return one line per kind of fault, and one for all faults if there are several kinds."""
    kinds = by_kind(condition.runs)
    lines = [_cells(total(runs, kind), condition.ftm) for kind, runs in kinds.items()]
    faulty = [run for run in condition.runs if run.job.faults]
    if sum(bool(runs[0].job.faults) for runs in kinds.values()) > 1:
        lines.append(_cells(total(faulty, "all faults"), condition.ftm) | {"sum": True})
    return lines


def _every_fault(found: Sequence[Condition]) -> list[tuple[str, int, list[list[dict[str, Any]]]]]:
    """Return label, number of rows, and the rows by fault, worst fault first, of each kind."""
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
                [_cells(row, condition.ftm) | {"condition": condition.text}
                 for condition, row in rows] for rows in ordered]))
    return every


def _how_good(rows: Sequence[tuple[Condition, Row]]) -> tuple[Any, ...]:
    """Return a key that sorts faults worst first, by their rows with FTM if there are any."""
    with_ftm = [row for condition, row in rows if condition.ftm]
    counted = [row for row in with_ftm or [row for _, row in rows] if row.safe.of]
    least = [s.least for row in counted for s in (row.obstacle_m, row.prohibited_m) if s]
    return (not counted, min((row.safe.share for row in counted), default=1.0),
            min((row.success.share for row in counted), default=1.0),
            min(least, default=math.inf), rows[0][1].fault)


def _cells(row: Row, ftm: bool) -> dict[str, Any]:
    """Return a row as texts; a pair is a figure and what is said below it."""
    counted = row.safe.of
    detected, recovered = row.detected_after_s, row.recovered_after_s
    found = [seconds(detected.median), *_tail(detected)] if ftm and detected else [NONE]
    if ftm and row.undetected:
        found.append(f"{row.undetected:,} not detected")
    calm = [seconds(recovered.median), *_tail(recovered)] if ftm and recovered else [NONE]
    if ftm and recovered and recovered.n < counted:
        calm.append(f"{counted - recovered.n:,} not recovered")
    return {
        "sum": False, "fault": row.fault, "worst": row.worst, "key": row.worst_key,
        "runs": (f"{row.runs:,}", f"{row.ineffective:,} no effect" if row.ineffective else ""),
        "success": _share(row.success.count, counted), "safe": _share(row.safe.count, counted),
        "unsafe": row.safe.count < counted,
        "detected": (found[0], "\n".join(found[1:])),
        "recovered": (calm[0], "\n".join(calm[1:])),
        "obstacle": metres(row.obstacle_m.least if row.obstacle_m else None),
        "prohibited": metres(row.prohibited_m.least if row.prohibited_m else None),
        "false_alarms": f"{row.false_alarms:,}" if ftm and counted else NONE,
        "stopped": f"{row.stopped_for_good:,}" if counted else NONE,
    }


def _share(number: int, of: int) -> tuple[str, str]:
    return (f"{number:,} of {of:,}", interval(rate(number, of))) if of else (NONE, "")


def _tail(found: Spread) -> list[str]:
    """Return the upper end of a spread; below twenty values the 95th percentile is the maximum."""
    most = [f"max {seconds(found.most)}"] if found.n > 1 else []
    return [f"p95 {seconds(found.p95)}", *most] if found.n >= 20 else most


def _failures(runs: Iterable[Run]) -> list[tuple[str, str]]:
    """Return key and text of the actors that ended by an error of the program."""
    return [(run.job.key, text) for run in runs for text in run.result.failures]


# -- the paper ---------------------------------------------------------------------------------


_PAPERS = "verdicts are the paper's"

_TABLES = {
    CONDITIONS[0]: ("Table IV: without FTM", "The unprotected baseline.", _PAPERS),
    CONDITIONS[1]: (
        "Table V: with FTM, as in the paper",
        "The paper's mechanisms under safety-first. As in the authors' code nothing releases "
        "a stop (RM2) or the switch to teleoperation (RM5) once the fault is gone.", _PAPERS),
    CONDITIONS[2]: (
        "Beside table V: with FTM, as shipped",
        "The same mechanisms and strategy, but recoveries end with their cause, so missions "
        "that the paper gives up go on. The verdicts beside ours are those of table V.", _PAPERS),
    FULL: (
        "The paper's rows on the full system",
        "Faults, moments, obstacles and seeds of table V, whose verdicts stand beside ours; more "
        f"mechanisms, another strategy. Expected of every row, whatever the paper has: {GOOD}.",
        "verdicts are as expected"),
}
"""Of each condition: title, words, and what it means that a verdict agrees."""


def _paper_tables(cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """Return tables IV, V, and V under our own conditions: verdicts by fault and obstacles."""
    tables = []
    for condition, (title, words, agreement) in _TABLES.items():
        there = {(c.fault, c.obstacles): c for c in cells if c.condition == condition}
        if there:
            tables.append({
                "title": title, "words": words, "agreement": agreement,
                "agree": sum(c.agrees for c in there.values()), "of": len(there),
                "rows": [(fault, [there.get((fault, n)) for n in paper_tables.OBSTACLES])
                         for fault in FAULTS if any(f == fault for f, _ in there)]})
    return tables


def _agreement(cells: Sequence[Cell]) -> str:
    """Return in words how many verdicts are those of the paper's two tables, or as expected."""
    parts = []
    for said, conditions_of_it in (
            ("verdicts of tables IV and V agree with the paper's", CONDITIONS[:2]),
            (f"rows of table V end in {GOOD} on the full system", (FULL,))):
        counted = [cell for cell in cells if cell.condition in conditions_of_it]
        if counted:
            parts.append(f"{sum(c.agrees for c in counted)} of {len(counted)} {said}.")
    return " ".join(parts)
