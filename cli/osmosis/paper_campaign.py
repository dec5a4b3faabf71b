"""`rampart campaign --paper`: the paper's tables III, IV and V, and table V on the full system."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from typing import Any, Self

from rampart.cli.output import UsageError, print_table, say
from rampart.manager.spec.schema import SystemSpec
from rampart.sim.campaign.job import Job
from rampart.sim.campaign.report import NamedCampaign, Section
from rampart.sim.campaign.statistics import Row
from rampart.sim.campaign.store import Run
from rampart.sim.osmosis.trial.paper_tables import (
    FULL_SYSTEM,
    PAPER_SYSTEM,
    Cell,
    cells,
    full_jobs,
    paper_jobs,
    section,
    table_iii,
)

_HEAD = ("fault", "obst.", "paper", "ours", "runs", "no effect", "success", "safe", "")


class PaperCampaign(NamedCampaign):
    """The paper's tables on the paper's system."""

    flag, name, title, system = "--paper", "paper", "The paper's tables", PAPER_SYSTEM

    @classmethod
    def add(cls, group: Any) -> None:
        """Add `--paper` and `--full`."""
        group.add_argument("--paper", action="store_true",
                           help="make tables III, IV and V of the paper")
        group.add_argument("--full", action="store_true",
                           help="with --paper: make the runs of table V on the full system, "
                           "and expect each to succeed and be safe")

    @classmethod
    def chosen(cls, options: argparse.Namespace) -> Self | None:
        """Return the campaign that the options choose, if any."""
        if options.full and not options.paper:
            raise UsageError("--full: only with --paper, whose rows it runs on the full system")
        kind: Any = FullCampaign if options.full else cls
        return kind() if options.paper else None

    def jobs(self, base: Job) -> list[Job]:
        """Return all runs of tables IV and V.

        Raises:
            UsageError: the system has no missions.
        """
        return paper_jobs(_mission(base), base.seed, base.system)

    def section(self, spec: SystemSpec, runs: Sequence[Run]) -> Section:
        """Return the three tables of the paper and ours."""
        return section(cells(runs), table_iii(spec))

    def show(self, spec: SystemSpec, runs: Sequence[Run]) -> None:
        """Print the three tables of the paper and ours."""
        say("Table III: what is executed")
        say()
        print_table(("active", "block", "paper", "ours", ""), [
            (", ".join(row.active), row.block, ", ".join(row.paper), ", ".join(row.ours),
             "agrees" if row.agrees else f"DIFFERS: block {row.our_block}")
            for row in table_iii(spec)])
        found = cells(runs)
        for title in ("IV", "V"):
            say()
            say(f"Table {title}: mission and safety, worst run of each row")
            say()
            print_table(("condition", *_HEAD), [
                (c.condition, *_row(c, "agrees", "differs")) for c in found if c.table == title])
        _show_differing(found)


class FullCampaign(PaperCampaign):
    """The rows of the paper's table V on the full system, all to end in success and safe."""

    name, title, system = "paper-full", "The paper's rows on the full system", FULL_SYSTEM

    def jobs(self, base: Job) -> list[Job]:
        """Return the runs of table V on the full system."""
        return full_jobs(_mission(base), base.seed, base.system)

    def section(self, spec: SystemSpec, runs: Sequence[Run]) -> Section:
        """Return table V of the paper and ours."""
        del spec
        return section(cells(runs))

    def show(self, spec: SystemSpec, runs: Sequence[Run]) -> None:
        """Print table V of the paper and ours."""
        del spec
        say("The paper's rows on the full system, worst run of each row; expected in each: "
            "success, safe\n")
        found = cells(runs)
        print_table(_HEAD, [_row(c, "as expected", "NOT as expected") for c in found])
        _show_differing(found)

    def expected(self, runs: Sequence[Run], row: Row) -> dict[str, Any]:
        """Return the paper's verdict on a row, the expected one, and ours."""
        return next(({"paper": c.paper, "expected": c.expected, "ours": c.ours}
                     for c in cells(runs)
                     if (c.fault, c.obstacles) == (row.fault, row.options.get("obstacles", 0))), {})

    def failed(self, runs: Sequence[Run]) -> bool:
        """Return whether a row differs from the expectation."""
        return not all(cell.agrees for cell in cells(runs))


def _mission(base: Job) -> str:
    if "mission" not in base.options:
        raise UsageError(f"--system {base.system}: expected a system with the paper's missions")
    return str(base.options["mission"])


def _row(cell: Cell, well: str, ill: str) -> tuple[Any, ...]:
    return (cell.fault, cell.obstacles, cell.paper, cell.ours, cell.runs, cell.ineffective,
            cell.success, cell.safe, well if cell.agrees else f"{ill}: run {cell.worst_key}")


def _show_differing(found: Iterable[Cell]) -> None:
    for cell in found:
        if not cell.agrees:
            say()
            say(f"{cell.condition}, {cell.fault}, {cell.obstacles} obstacles: paper "
                f"{cell.paper}, ours {cell.ours}; worst run {cell.worst_key}, "
                f"{cell.worst_fault}\n  "
                f"{cell.story or 'no decision'}\n  {'; '.join(cell.reasons) or 'nothing amiss'}")
