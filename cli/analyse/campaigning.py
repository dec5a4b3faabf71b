"""The work behind `rampart campaign`: choose the runs, make them, show what came of them."""

from __future__ import annotations

import argparse
import fnmatch
import shlex
import sys
import time
from collections.abc import Iterable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

from tqdm import tqdm

from rampart.actors.layout.layout import load_application
from rampart.actors.run.run_plan import RunPlan
from rampart.cli import systems
from rampart.cli.analyse.hunting import hunt
from rampart.cli.output import (
    NoEffectError,
    UsageError,
    print_json,
    print_table,
    say,
    say_text,
    unknown,
    warn,
)
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.strategies.registry import STRATEGIES
from rampart.sim.campaign.execute import BackendError, JobError, execute
from rampart.sim.campaign.job import Job, RunResult, run_virtually
from rampart.sim.campaign.plan import cross, fault_groups, sample
from rampart.sim.campaign.report import Campaign, worth_showing, write_campaign_report
from rampart.sim.campaign.statistics import Rate, Row, Spread, as_json, table, total
from rampart.sim.campaign.store import Run, Store, StoreError
from rampart.sim.faults.disturbance import UnknownFaultError
from rampart.sim.faults.faults import faults_of
from rampart.sim.faults.injector import can_be_hit
from rampart.sim.faults.scenario import PlannedFault, ScenarioError, action_of, parse_fault
from rampart.sim.osmosis.trial.paper_tables import (
    FULL_SYSTEM,
    PAPER_SYSTEM,
    Cell,
    cells,
    full_jobs,
    paper_jobs,
    table_iii,
)
from rampart.sim.osmosis.trial.record import MissionRecord
from rampart.sim.osmosis.trial.report import render
from rampart.sim.runs.report import in_words, try_report
from rampart.sim.virtual.network import NETWORKS


def campaign(options: argparse.Namespace) -> int:
    """Run the campaign, or what else was asked for."""
    if not options.system:
        options.system = PAPER_SYSTEM if options.paper and not options.full else FULL_SYSTEM
    spec = systems.load(options.system)
    if spec.mobile is None:
        raise UsageError(f"--system {options.system}: it has no [robot] and drives no mission")
    if options.list:
        return _list(spec, as_json=options.json)
    if options.replay:
        return _replay(options)
    _check(options)
    if options.search is not None:
        return hunt(options, _groups(options, spec), _base_jobs(options), faults_of(spec))
    name, jobs = _choose(options, spec)
    directory = _directory(options, name)
    try:
        store = Store(directory)
    except StoreError as error:
        raise UsageError(str(error)) from None
    try:
        made = _execute(options, jobs, store)
        keys = {job.key for job in jobs}
        runs = _in_order(store.runs(keys), jobs)
        store.close()
    except BackendError as error:
        raise UsageError(str(error)) from None
    except (StoreError, JobError) as error:
        raise UsageError(f"{error}; what was finished is in {directory}, and the same command "
                         "goes on from there") from None
    _show(options, spec, runs, made)
    try:
        page = _write_report(options, spec, directory, runs)
    except Exception as error:  # of disk, template or chart alike: the verdict stands
        warn(f"report: {directory}: {in_words(error)}")
    else:
        if not options.json:
            say()
            say(f"Report: {page}")
    unsafe = any(r.job.ftm and not r.result.safe for r in runs)
    failed = options.full and not all(cell.agrees for cell in cells(runs))
    return 1 if unsafe or failed else 0


# -- choosing ----------------------------------------------------------------------------------


def _check(options: argparse.Namespace) -> None:
    if options.full and not options.paper:
        raise UsageError("--full: goes with --paper only; it runs the paper's rows on the full "
                         "system")
    chosen = [name for name, given in (
        ("--paper", options.paper), ("--runs", options.runs is not None),
        ("--fault", options.fault), ("--search", options.search is not None)) if given]
    if len(chosen) != 1:
        raise UsageError("give one of --paper, --runs N, --fault FAULT, --search N; "
                         f"given: {', '.join(chosen) or 'none'}")
    for name, value, least in (("--runs", options.runs, 1), ("--together", options.together, 1),
                               ("--seeds", options.seeds, 1), ("--search", options.search, 1),
                               ("--jobs", options.jobs, 0)):
        if value is not None and value < least:
            raise UsageError(f"{name} {value}: must be {least} or more")
    if not options.patience > 0:
        raise UsageError(f"--patience {options.patience:g}: must be above 0")
    if options.network not in NETWORKS:
        raise unknown("network", options.network, NETWORKS)
    for strategy in options.strategy:
        if strategy not in STRATEGIES:
            raise unknown("strategy", strategy, STRATEGIES)


def _base_jobs(options: argparse.Namespace) -> list[Job]:
    """Return what the runs have in common, crossed."""
    try:
        obstacles = [int(n) for n in options.obstacles.split(",")]
    except ValueError:
        raise UsageError(f"--obstacles {options.obstacles}: must be numbers, e.g. 0,2") from None
    ftm = {"on": (True,), "off": (False,), "both": (False, True)}[options.ftm]
    jobs = [Job(row="", system=options.system, strategy=strategy, airport=options.airport,
                mission=options.mission, obstacles=n, ftm=with_ftm, network=options.network,
                patience_s=options.patience)
            for with_ftm, strategy, n in product(ftm, options.strategy or [""], obstacles)]
    _try_world(jobs)
    return jobs


def _try_world(jobs: Sequence[Job]) -> None:
    """Refuse a mission, airport or number of obstacles that does not exist before any run."""
    spec = systems.load(jobs[0].system)
    for each in jobs:
        try:
            load_application(RunPlan(system_file=each.system, options=each.options), spec)
        except ValueError as error:
            raise UsageError(" ".join(str(error).split())) from None


def _choose(options: argparse.Namespace, spec: SystemSpec) -> tuple[str, list[Job]]:
    """Return a name for what is run, and the runs."""
    if options.paper:
        if options.full:
            return "paper-full", full_jobs(options.mission, options.seed, options.system)
        return "paper", paper_jobs(options.mission, options.seed, options.system)
    jobs = _base_jobs(options)
    if options.runs is not None:
        groups = _groups(options, spec)
        together = f"-{options.together}" if options.together > 1 else ""
        return f"sample{together}", sample(
            jobs, groups, options.runs, seed=options.seed, faults=faults_of(spec),
            together=options.together)
    faults = list(_planned(options.fault, spec, _all_groups(spec)))
    return "faults", cross(jobs, faults, range(options.seed, options.seed + options.seeds))


def _groups(options: argparse.Namespace, spec: SystemSpec) -> dict[str, tuple[str, ...]]:
    """Return the faults to draw from: of the kinds asked for, or all."""
    groups = _all_groups(spec)
    if not options.kinds:
        return groups
    wanted = options.kinds.split(",")
    for kind in wanted:
        if kind not in groups:
            raise unknown("kind", kind, groups)
    return {kind: groups[kind] for kind in wanted}


def _all_groups(spec: SystemSpec) -> dict[str, tuple[str, ...]]:
    try:
        return fault_groups(spec)
    except ValueError as error:
        raise UsageError(str(error)) from None


def _planned(texts: Iterable[str], spec: SystemSpec, groups: dict[str, tuple[str, ...]]
             ) -> Iterable[PlannedFault | None]:
    every = [name for names in groups.values() for name in names]
    nodes, known, faults = can_be_hit(spec), systems.topics_of(spec), faults_of(spec)
    for text in texts:
        if text == "none":
            yield None
            continue
        try:
            planned = parse_fault(text)
            found = fnmatch.filter(every, planned.fault)
            if not found:
                action_of(planned, "f1", nodes, known, faults)
                found = [planned.fault]
        except (ScenarioError, UnknownFaultError) as error:
            raise UsageError(f"--fault {text}: {error}") from None
        for name in found:
            yield PlannedFault(name, planned.at_s, planned.goal, planned.duration_s)


def _directory(options: argparse.Namespace, name: str) -> Path:
    return Path(options.out) if options.out else Path("reports") / f"campaign-{name}"


# -- running -----------------------------------------------------------------------------------


def _execute(options: argparse.Namespace, jobs: Sequence[Job], store: Store) -> int:
    unique = {job.key for job in jobs}
    done = len(unique & store.keys())
    unsafe = 0
    # On a terminal a bar; in a log a line now and then.
    watched = sys.stderr.isatty()
    with tqdm(total=len(unique), initial=done, unit="run", file=sys.stderr, smoothing=0.05,
              disable=not watched) as bar:
        log = ProgressLog(len(unique), done)

        def progress(job: Job, result: RunResult) -> None:
            nonlocal unsafe
            if job.ftm and not result.safe:
                unsafe += 1
                bar.write(f"unsafe: {job.key} {job.text()}", file=sys.stderr)
            bar.set_postfix(unsafe=unsafe, refresh=False)
            bar.update()
            if not watched:
                line = log.made_one(time.monotonic(), unsafe)
                if line:
                    print(line, file=sys.stderr, flush=True)

        return execute(jobs, store, workers=options.jobs, backend=options.backend,
                       address=options.address, progress=progress)


class ProgressLog:
    """What to write into a log while runs are made: a line a minute, and one for the last run.

    Args:
        total: Runs of the campaign.
        done: Those that were made before.
    """

    PERIOD_S = 60.0

    def __init__(self, total: int, done: int) -> None:
        self._total, self._done, self._before = total, done, done
        self._begun_s: float | None = None
        self._told_s = 0.0

    def made_one(self, now_s: float, unsafe: int) -> str:
        """Note a run, and return the line to write, mostly none."""
        self._done += 1
        if self._begun_s is None:  # the first run took the start of the workers on top
            self._begun_s = self._told_s = now_s
            self._before = self._done
        left = self._total - self._done
        more = ""
        if left:
            if now_s - self._told_s < self.PERIOD_S:
                return ""
            minutes = (now_s - self._begun_s) / (self._done - self._before) * left / 60
            more = f", {minutes:.0f} min left"
        self._told_s = now_s
        return f"{self._done} of {self._total} runs, {unsafe} unsafe with FTM{more}"


def _in_order(runs: Iterable[Run], jobs: Sequence[Job]) -> list[Run]:
    """Return the runs in the order of their jobs, with the rows that these name."""
    results = {run.job.key: run.result for run in runs}
    return [Run(job, results[job.key]) for job in jobs if job.key in results]


def _replay(options: argparse.Namespace) -> int:
    if not options.out:
        raise UsageError("--replay RUN: --out DIR is missing: the campaign that the run is of")
    directory = Path(options.out)
    if not directory.is_dir():
        raise UsageError(f"--out {options.out}: no such directory")
    try:
        store = Store(directory)
        found = store.find(options.replay)
        store.close()
    except StoreError as error:
        raise UsageError(str(error)) from None
    if found is None:
        raise UsageError(f"--replay {options.replay}: no run, or several, of this key in "
                         f"{directory}")
    try:
        again = run_virtually(found.job)
    except ValueError as error:
        raise UsageError(f"--replay {options.replay}: {' '.join(str(error).split())}") from None
    same = again.trace == found.result.trace
    html, data, problem = try_report(again.record, render, directory / "replays")
    if problem:
        raise UsageError(f"report: {problem}")
    if options.json:
        print_json({"run": found.job.key, "job": found.job, "same_trace": same,
                    "report": str(html), "record": str(data)})
    else:
        say_text(f"{found.job.key}: {found.job.text()}\n"
            f"{again.record.mission}, {again.record.safety}; "
            f"{'; '.join(again.record.reasons) or 'as it should be'}\n"
            f"{'the same run, to the byte' if same else 'NOT the same run: the program changed'}\n"
            f"Report: {html}")
    if not same:
        raise NoEffectError(f"run {found.job.key}: the trace is not the one in the store")
    return 0


# -- showing -----------------------------------------------------------------------------------


def _show(options: argparse.Namespace, spec: SystemSpec, runs: Sequence[Run], made: int) -> None:
    rows = table(runs)
    if options.json:
        verdicts = _full_verdicts(runs) if options.full else {}
        print_json([as_json(row) | verdicts.get((row.fault, row.obstacles), {}) for row in rows])
        return
    if options.full:
        _show_full(runs)
    elif options.paper:
        _show_paper(spec, runs)
    else:
        shown = sorted(rows, key=lambda row: (row.safe.share if row.safe.of else 2.0,
                                              row.success.share if row.success.of else 2.0))
        print_table(
            ("fault", "obst.", "FTM", "strategy", "runs", "no effect", "success", "safe", "worst",
             "detected after", "smallest clearance"),
            [_cells(row) for row in shown[:60]])
        if len(shown) > 60:
            say(f"... and {len(shown) - 60} rows more, in the report")
    say()
    say(f"{len(runs)} runs, {made} of them made now")
    protected = [run for run in runs if run.job.ftm and run.job.faults]
    if protected:
        all_of_them = total(protected, "all")
        say(f"with fault tolerance: {_rate(all_of_them.safe)} safe, {_rate(all_of_them.success)} "
            f"successful, {all_of_them.ineffective} without effect")


def _cells(row: Row) -> tuple[Any, ...]:
    clearance = min((s.least for s in (row.obstacle_m, row.prohibited_m) if s), default=None)
    return (row.fault, row.obstacles, "yes" if row.ftm else "no", row.strategy or "-", row.runs,
            row.ineffective, _share(row.success), _share(row.safe), row.worst,
            _milliseconds(row.detected_after_s),
            "-" if clearance is None else f"{clearance:.2f} m")


def _share(found: Rate) -> str:
    return f"{found.count}/{found.of}"


def _rate(found: Rate) -> str:
    return (f"{found.count} of {found.of} ({100 * found.share:.1f} %, 95 % interval "
            f"{100 * found.low:.2f} to {100 * found.high:.2f} %)" if found.of else "none")


def _milliseconds(found: Spread | None) -> str:
    return "-" if found is None else f"{found.median * 1e3:.0f} ms, at most {found.most * 1e3:.0f}"


def _show_paper(spec: SystemSpec, runs: Sequence[Run]) -> None:
    say("Table III: what is executed")
    say()
    print_table(("active", "block", "paper", "ours", ""), [
        (", ".join(row.active), row.block, ", ".join(row.paper), ", ".join(row.ours),
         "agrees" if row.agrees else f"DIFFERS: block {row.our_block}")
        for row in table_iii(spec)])
    for title in ("IV", "V"):
        say()
        say(f"Table {title}: mission and safety, worst run of each row")
        say()
        print_table(("condition", "fault", "obst.", "paper", "ours", "runs", "no effect",
                     "success", "safe", ""),
                    [(c.condition, c.fault, c.obstacles, c.paper, c.ours, c.runs, c.ineffective,
                      c.success, c.safe, "agrees" if c.agrees else f"differs: run {c.worst_key}")
                     for c in cells(runs) if c.table == title])
    _show_differing(cells(runs))


def _show_full(runs: Sequence[Run]) -> None:
    say("The paper's rows on the full system, worst run of each row; expected in each: success, "
        "safe\n")
    found = cells(runs)
    print_table(("fault", "obst.", "paper", "ours", "runs", "no effect", "success", "safe", ""),
                [(c.fault, c.obstacles, c.paper, c.ours, c.runs, c.ineffective, c.success, c.safe,
                  "as expected" if c.agrees else f"NOT as expected: run {c.worst_key}")
                 for c in found])
    _show_differing(found)


def _show_differing(found: Iterable[Cell]) -> None:
    for cell in found:
        if not cell.agrees:
            say()
            say(f"{cell.condition}, {cell.fault}, {cell.obstacles} obstacles: paper "
                f"{cell.paper}, ours {cell.ours}; worst run {cell.worst_key}, "
                f"{cell.worst_fault}\n  "
                f"{cell.story or 'no decision'}\n  {'; '.join(cell.reasons) or 'nothing amiss'}")


def _full_verdicts(runs: Sequence[Run]) -> dict[tuple[str, int], dict[str, str]]:
    """Return what --json adds to the rows of the full system, by fault and obstacles."""
    return {(c.fault, c.obstacles): {"paper": c.paper, "expected": c.expected, "ours": c.ours}
            for c in cells(runs)}


def _list(spec: SystemSpec, *, as_json: bool) -> int:
    groups = _all_groups(spec)
    if as_json:
        print_json(groups)
        return 0
    for kind, names in groups.items():
        say(f"{kind} ({len(names)})")
        for name in names:
            say(f"  {name}")
    return 0


def _write_report(options: argparse.Namespace, spec: SystemSpec, directory: Path,
                  runs: Sequence[Run]) -> Path:
    worst: dict[str, MissionRecord] = {
        run.job.key: _record_of(run) for run in worth_showing(runs)}
    title = "Fault-injection campaign"
    if options.paper:
        title = "The paper's rows on the full system" if options.full else "The paper's tables"
    about = Campaign(title=title, command=f"rampart {shlex.join(sys.argv[1:])}", seed=options.seed)
    decided = table_iii(spec) if options.paper and not options.full else ()
    return write_campaign_report(directory, about, runs, decided, worst)


def _record_of(run: Run) -> MissionRecord:
    found = run_virtually(run.job).record
    if not isinstance(found, MissionRecord):
        raise TypeError(f"{run.job.system}: no track to show")
    return found
