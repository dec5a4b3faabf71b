"""The paper's tables beside ours, as a section of a campaign's report."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from markupsafe import Markup

from rampart.sim.campaign.named import Section
from rampart.sim.osmosis.trial.paper_tables import (
    CONDITIONS,
    FAULTS,
    FULL,
    GOOD,
    OBSTACLES,
    Cell,
    Decided,
)
from rampart.sim.runs.report import environment

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


def section(cells: Sequence[Cell], decided: Sequence[Decided] = ()) -> Section:
    """Return what the report says: of tables IV and V, and of table III if it was decided."""

    def html(shown: set[str], replay: Callable[[str], str]) -> Markup:
        return Markup(environment().get_template("osmosis/trial/paper_section.html").render(  # noqa: S704 it escapes
            decided=decided, verdicts=_paper_tables(cells), shown=shown, replay=replay,
            differing=[cell for cell in cells if not cell.agrees]))

    return Section(_agreement(cells), html)


def _paper_tables(cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """Return tables IV, V, and V under our own conditions: verdicts by fault and obstacles."""
    tables = []
    for condition, (title, words, agreement) in _TABLES.items():
        there = {(c.fault, c.obstacles): c for c in cells if c.condition == condition}
        if there:
            tables.append({
                "title": title, "words": words, "agreement": agreement,
                "agree": sum(c.agrees for c in there.values()), "of": len(there),
                "rows": [(fault, [there.get((fault, n)) for n in OBSTACLES])
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
