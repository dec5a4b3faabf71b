"""The paper's tables III, IV and V: faults, conditions and verdicts, with Rampart's beside them.

Table III has decisions only. Tables IV and V are runs with one fault each, with and without
obstacles, without and with fault tolerance. The verdict of a row is that of its worst run. Three
conditions are run:

* *without FTM*: the unprotected baseline (table IV);
* *with FTM, as in the paper* (table V): its seven mechanisms under safety-first; as in the
  authors' code, RM2 and RM5 are latched, so a stop or the switch to teleoperation outlasts its
  fault;
* *with FTM, as shipped*: the same mechanisms and strategy, but recoveries end with their cause.

These are conditions of the paper's system (systems/paper.toml). In the fourth, *the full system*,
the runs of table V use more mechanisms and another strategy. Its expected verdicts are not the
paper's: no fault may cost the mission.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from itertools import product
from typing import Any

import msgspec
from markupsafe import Markup

from rampart.manager.spec.schema import SystemSpec
from rampart.manager.strategies.registry import decide
from rampart.sim.campaign.job import Job
from rampart.sim.campaign.report import Section
from rampart.sim.campaign.statistics import NO_EFFECT, verdict, worst
from rampart.sim.campaign.store import Run
from rampart.sim.faults.scenario import PlannedFault
from rampart.sim.osmosis.trial.mission_trial import MissionTrial
from rampart.sim.runs.report import environment

(AS_THE_PAPER,) = MissionTrial.retunings.values()
"""Differences from the shipped system: the authors' code releases neither RM2 nor RM5."""

CONDITIONS = ("without FTM", "with FTM, as in the paper", "with FTM, as shipped")
FULL = "the full system"
PAPER_SYSTEM, FULL_SYSTEM = "paper", "osmosis"
PAPER_STRATEGY = "safety-first"
GOOD = "success, safe"
"""Expected verdict of the full system in each row of table V."""

OBSTACLES = (0, 2)

_AT_S = (8.0, 24.0, 85.0, 150.0)
"""On the route to the first goal, before its last bend, at the end of the row of lights, on the
route to the last goal."""

_OUT_OF_BOUNDS_S = 4.0
"""The paper calls this fault temporary, without a duration."""


def _lasting(fault: str, duration_s: float) -> tuple[PlannedFault, ...]:
    return tuple(PlannedFault(fault, at_s, duration_s=duration_s) for at_s in _AT_S)


def _crashes(*nodes: str) -> tuple[PlannedFault, ...]:
    return tuple(PlannedFault(f"kill:{node}", at_s) for node in nodes for at_s in _AT_S[:3])


FAULTS: dict[str, tuple[PlannedFault | None, ...]] = {
    "none": (None,),
    "command out of bounds": _lasting("command-out-of-bounds", _OUT_OF_BOUNDS_S),
    "localization not updated": _lasting("localization-not-updated", math.inf),
    "command not updated": _lasting("command-not-updated", math.inf),
    "non-control node crash": _crashes("hmi", "teleoperation", "localization"),
    "control node crash": _crashes("mission_manager", "graph_planner", "osmosis_control")}
"""Runs of each row: the fault at different moments or in different nodes."""

WITHOUT_FTM: dict[str, tuple[str, str]] = {
    "none": ("success, safe", "success, safe"),
    "command out of bounds": ("success, unsafe", "fail, unsafe"),
    **dict.fromkeys(("localization not updated", "command not updated", "non-control node crash",
                     "control node crash"), ("fail, unsafe", "fail, unsafe"))}
"""Table IV: verdict without and with obstacles."""

WITH_FTM: dict[str, tuple[str, str]] = {
    **dict.fromkeys(FAULTS, ("fail, safe", "fail, safe")),
    **dict.fromkeys(("none", "non-control node crash"), ("success, safe", "success, safe"))}
"""Table V: verdict without and with obstacles."""

TABLE_III: tuple[tuple[tuple[str, ...], int, tuple[str, ...]], ...] = (
    (("FTM7",), 1, ("RM4",)),
    (("FTM1", "FTM6"), 2, ("RM1",)),
    (("FTM3", "FTM4"), 3, ("RM2",)),
    (("FTM2", "FTM5", "FTM6"), 4, ("RM1",)))
"""Active mechanisms, block, recovery executed."""


class Cell(msgspec.Struct, frozen=True, kw_only=True):
    """A cell of table IV or V: the paper's verdict, the expected one, ours, and the runs.

    The expected verdict is the paper's, or `GOOD` of the full system. `worst_key` and `story` are
    key and decisions of the worst run. `ineffective` runs have no verdict; see `RunResult.counts`.
    """

    table: str
    fault: str
    obstacles: int
    condition: str
    paper: str
    expected: str
    ours: str
    runs: int
    ineffective: int
    success: int
    safe: int
    worst_key: str
    worst_fault: str
    story: str
    reasons: tuple[str, ...]

    @property
    def agrees(self) -> bool:
        """Whether our worst run has the expected verdict."""
        return self.expected == self.ours


class Decided(msgspec.Struct, frozen=True):
    """A row of table III: the paper's decision and ours."""

    active: tuple[str, ...]
    block: int
    paper: tuple[str, ...]
    our_block: int
    ours: tuple[str, ...]

    @property
    def agrees(self) -> bool:
        """Whether block and recovery are the paper's."""
        return (self.block, self.paper) == (self.our_block, self.ours)


def paper_jobs(mission: str = "A", seed: int = 1, system: str = PAPER_SYSTEM) -> list[Job]:
    """Return all runs of tables IV and V; `system` is a shipped name or a path."""
    return [Job(row=name, system=system, options={"mission": mission, "obstacles": obstacles},
                strategy=PAPER_STRATEGY, ftm=condition != CONDITIONS[0],
                retuned=AS_THE_PAPER if condition == CONDITIONS[1] else {},
                faults=(fault,) if fault else (), seed=seed + i)
            for condition, obstacles, name in product(CONDITIONS, OBSTACLES, FAULTS)
            for i, fault in enumerate(FAULTS[name])]


def full_jobs(mission: str = "A", seed: int = 1, system: str = FULL_SYSTEM) -> list[Job]:
    """Return the runs of table V on another system with its own strategy."""
    return [msgspec.structs.replace(job, system=system, strategy="")
            for job in paper_jobs(mission, seed) if condition_of(job) == CONDITIONS[2]]


def condition_of(job: Job) -> str:
    """Return the condition of a job of `paper_jobs` or `full_jobs`."""
    if not job.strategy:
        return FULL
    if not job.ftm:
        return CONDITIONS[0]
    return CONDITIONS[1] if job.retuned else CONDITIONS[2]


def cells(runs: Iterable[Run]) -> list[Cell]:
    """Return tables IV and V, and the runs of table V under the other conditions."""
    found: dict[tuple[str, str, int], list[Run]] = {}
    for run in runs:
        found.setdefault((condition_of(run.job), run.job.row, _obstacles(run.job)), []).append(run)
    table = []
    for condition, name, obstacles in product((*CONDITIONS, FULL), FAULTS, OBSTACLES):
        if there := found.get((condition, name, obstacles)):
            verdicts = WITHOUT_FTM if condition == CONDITIONS[0] else WITH_FTM
            table.append(_cell(condition, verdicts[name][OBSTACLES.index(obstacles)], there))
    return table


def _obstacles(job: Job) -> int:
    return int(job.options.get("obstacles", 0))


def _cell(condition: str, paper: str, runs: Sequence[Run]) -> Cell:
    counted = [run for run in runs if run.result.counts]
    bad = worst(counted or runs)
    decisions = [f"{d.t_s:.2f} s {', '.join(d.active) or 'nothing'}: "
                 f"{' and '.join(d.recoveries) or 'nothing to recover'}"
                 for d in bad.result.decisions[:6]]
    return Cell(
        table="IV" if condition == CONDITIONS[0] else "V", fault=bad.job.row,
        obstacles=_obstacles(bad.job), condition=condition, paper=paper,
        expected=GOOD if condition == FULL else paper,
        ours=verdict(bad) if counted else NO_EFFECT, runs=len(runs),
        ineffective=len(runs) - len(counted), success=sum(r.result.success for r in counted),
        safe=sum(r.result.safe for r in counted), worst_key=bad.job.key,
        worst_fault=bad.job.text(), story="; ".join(decisions), reasons=bad.result.reasons)


def table_iii(spec: SystemSpec) -> list[Decided]:
    """Return table III with the decisions of safety-first in a system."""
    rows = []
    for active, block, recoveries in TABLE_III:
        made = decide(active, spec.build_mechanisms(), spec.build_ftm_tree(), spec.build_order(),
                      PAPER_STRATEGY)
        rows.append(Decided(active, block, recoveries, made.rule, made.recoveries))
    return rows


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
        "that fail in the paper continue. The verdicts beside ours are those of table V.", _PAPERS),
    FULL: (
        "The paper's rows on the full system",
        "Faults, moments, obstacles and seeds of table V, with more mechanisms and another "
        f"strategy. Expected in each row: {GOOD}.",
        "verdicts are as expected"),
}
"""Title, text, and meaning of agreement of each condition."""


def section(cells: Sequence[Cell], decided: Sequence[Decided] = ()) -> Section:
    """Return the report's section on tables IV and V, and on table III if given."""

    def html(shown: set[str], replay: Callable[[str], str]) -> Markup:
        return Markup(environment().get_template("osmosis/trial/paper_section.html").render(  # noqa: S704 it escapes
            decided=decided, verdicts=_paper_tables(cells), shown=shown, replay=replay,
            differing=[cell for cell in cells if not cell.agrees]))

    return Section(_agreement(cells), html)


def _paper_tables(cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """Return the verdicts of each condition by fault and obstacles."""
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
    """Return the numbers of agreeing verdicts as text."""
    parts = []
    for text, conditions in (
            ("verdicts of tables IV and V agree with the paper's", CONDITIONS[:2]),
            (f"rows of table V end in {GOOD} on the full system", (FULL,))):
        counted = [cell for cell in cells if cell.condition in conditions]
        if counted:
            parts.append(f"{sum(c.agrees for c in counted)} of {len(counted)} {text}.")
    return " ".join(parts)
