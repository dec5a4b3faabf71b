"""`rampart campaign`: thousands of runs in virtual time with faults, and a report."""

from __future__ import annotations

import argparse
import fnmatch
import shlex
import sys
from collections.abc import Iterable, Sequence
from importlib.metadata import entry_points
from itertools import combinations, product
from pathlib import Path

from tqdm import tqdm

from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.system.members import application_class, load_application
from rampart.actors.system.topics import system_topics
from rampart.cli import application_options, systems
from rampart.cli.output import (
    NoEffectError,
    UsageError,
    print_json,
    print_table,
    say,
    say_text,
    warn,
)
from rampart.cli.verbs import (
    add_options,
    flag,
    group,
    help_of,
    number,
    option,
    several,
    whole,
    word,
)
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.strategies.registry import find_strategy
from rampart.sim.campaign.content import content_of, with_content
from rampart.sim.campaign.defaults import PATIENCE_S
from rampart.sim.campaign.job import Job, RunResult, run_virtually, virtual_run
from rampart.sim.campaign.plan import cross, fault_groups, sample
from rampart.sim.campaign.report import Campaign, NamedCampaign, write_campaign_report
from rampart.sim.campaign.statistics import (
    Rate,
    Row,
    as_json,
    table,
    total,
    varying_options,
)
from rampart.sim.campaign.store import JobError, Run, Store, StoreError, execute
from rampart.sim.faults.faults import faults_of
from rampart.sim.faults.injector import can_be_hit
from rampart.sim.faults.scenario import PlannedFault, ScenarioError, action_of, parse_fault
from rampart.sim.faults.topic_faults import UnknownFaultError
from rampart.sim.runs.report import NONE, in_words
from rampart.sim.runs.trial import trial_class
from rampart.sim.virtual.network import NETWORKS, find_network

_LOG_S = 60.0
"""Real seconds between two lines of progress if stderr is not a terminal."""

_SHOWN = 60
"""Rows, at most; the report has all."""


_CHOICE = (
    whole("--runs", "N", "inject N random faults of all kinds, one per run"),
    several("--fault", "FAULT[@WHEN][+S]",
            "inject this fault, or all that match a pattern such as 'kill:*'; repeatable"),
    whole("--together", "K", "K faults in each run (default: 1); with --fault: every combination "
          "of K on different topics", 1),
    word("--replay", "RUN", "repeat a run of --out by its key, with a report"))

_CONDITIONS = (
    option("--ftm", choices=("on", "off", "both"), default="on",
           help="run with fault tolerance, without, or both (default: on)"),
    several("--strategy", "NAME", "strategy; repeatable (default: the system's)"),
    word("--network", "NAME", f"network model: {', '.join(NETWORKS)} (default: measured)",
         "measured"),
    whole("--seed", "N", "first seed (default: 1)", 1),
    whole("--seeds", "N", "with --fault: runs of each fault, each with its seed (default: 1)"),
    number("--patience", "S", "simulated seconds without progress after which a run fails "
           f"(default: {PATIENCE_S:g})", PATIENCE_S),
    number("--duration", "S", "simulated seconds of a run of a system without a mission "
           "(default: that of [end])"))

_PLACE = (
    word("--out", "DIR", "directory of results and report (default: reports/campaign-NAME)"),
    whole("--jobs", "N", "parallel processes (default: one per core)", 0))


def parser(program: str, system: str, campaigns: Sequence[type[NamedCampaign]]
           ) -> argparse.ArgumentParser:
    """Return the parser of the verb.

    Args:
        program: name of the command.
        system: the system whose options the verb takes.
        campaigns: named campaigns, which add options.

    Raises:
        UsageError: there is no such system.
    """
    which = "".join(f"; with {each.flag} alone: {each.system}" for each in campaigns)
    made = argparse.ArgumentParser(prog=program, **help_of(campaign.__doc__ or ""))
    what = made.add_argument_group("faults and runs")
    for each in campaigns:
        each.add(what)
    add_options(what, _CHOICE)
    add_options(made, (
        group("conditions",
              word("--system", "SPEC", "system file, or name of a shipped system (default: "
                   f"{systems.DEFAULT.stem}{which}). Its options, below, take several values; "
                   "--fault crosses them, --runs draws from them"), *_CONDITIONS),
        group("results and processes", *_PLACE), flag("--json", "print the rows as JSON")))
    spec = systems.load(system)
    application_options.add(made, application_class(spec), spec.application, crossed=True)
    return made


def named_campaigns() -> list[type[NamedCampaign]]:
    """Return the campaigns of the entry points `rampart.campaigns`."""
    return [found.load() for found in sorted(
        entry_points(group="rampart.campaigns"), key=lambda campaign: campaign.name)]


def parse(arguments: Sequence[str], program: str = "rampart campaign") -> argparse.Namespace:
    """Return the options, with the chosen named campaign, if any, in the list `named`.

    Raises:
        UsageError: there is no such system, or the options contradict each other.
    """
    campaigns = named_campaigns()
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    what = first.add_argument_group()
    for each in campaigns:
        each.add(what)
    first.add_argument("--system")
    known = first.parse_known_args(arguments)[0]
    named = [chosen for each in campaigns if (chosen := each.chosen(known))]
    default = named[0].system if named else systems.DEFAULT.stem
    options = parser(program, known.system or default, campaigns).parse_args(arguments)
    options.system = options.system or default
    options.named, options.run, options.flags = named, campaign, [each.flag for each in campaigns]
    return options


def campaign(options: argparse.Namespace) -> int:
    """Do what the options ask for.

    Run missions in virtual time with injected faults, on all cores, and report how
    often the robot succeeded and whether it was safe. Results and report are in
    --out. An interrupted campaign continues with the same command.

    Examples:
      rampart campaign --runs 200                    # random single faults
      rampart campaign --runs 200 --together 2       # random pairs of faults
      rampart campaign --fault 'kill:*' --seeds 5    # kill each process, five seeds
      rampart campaign --fault gps-bias@20+5 --obstacles 0,2 --ftm both
      rampart campaign --fault 'gps-*@30+inf' --fault 'imu-*@30+inf' --together 2
      rampart campaign --replay 3f2a --out DIR       # repeat one run of DIR
      rampart campaign --paper                       # the paper's tables
      rampart campaign --paper --full                # its rows on the full system

    exit code: 0 no unsafe run with fault tolerance; 1 an unsafe run, or a failed run
    with --full; 2 bad usage, or not completed, for example on a full disk
    """
    spec = systems.load(options.system)
    if options.replay:
        return _replay(options)
    _check(options)
    name, chosen = _choose(options, spec)
    jobs = with_content(chosen)
    named: NamedCampaign | None = options.named[0] if options.named else None
    directory = Path(options.out) if options.out else Path("reports") / f"campaign-{name}"
    store = Store(directory)
    try:
        made = _execute(options, jobs, store)
        results = {run.job.key: run.result for run in store.runs({job.key for job in jobs})}
        store.close()
    except (StoreError, JobError) as error:
        raise UsageError(f"{error}; the finished runs are in {directory}, and the same command "
                         "continues there") from None
    # With the jobs of this campaign: an earlier one may have stored a run under another row.
    runs = [Run(job, results[job.key]) for job in jobs if job.key in results]
    _show_runs(spec, runs, made, named, is_json=options.json)
    try:
        page = _write_report(options, spec, directory, runs, named)
    except Exception as error:  # of disk, template or chart: the verdict stands
        warn(f"report: {directory}: {in_words(error)}")
    else:
        if not options.json:
            say()
            say(f"Report: {page}")
    unsafe = any(r.job.ftm and not r.result.safe for r in runs)
    return 1 if unsafe or (named and named.failed(runs)) else 0


# -- choosing ----------------------------------------------------------------------------------


def _check(options: argparse.Namespace) -> None:
    chosen = [*(named.flag for named in options.named), *(name for name, given in (
        ("--runs", options.runs is not None), ("--fault", options.fault)) if given)]
    if len(chosen) != 1:
        known = ", ".join([*options.flags, "--runs N", "--fault FAULT"])
        raise UsageError(f"expected one of {known}; given: {', '.join(chosen) or 'none'}")
    for name, value, least in (("--runs", options.runs, 1), ("--together", options.together, 1),
                               ("--seeds", options.seeds, 1), ("--jobs", options.jobs, 0)):
        if value is not None and value < least:
            raise UsageError(f"{name} {value}: must be {least} or more")
    if options.seeds and not options.fault:
        raise UsageError(f"--seeds {options.seeds}: only with --fault; each run of {chosen[0]} has "
                         "its own seed")
    if not options.patience > 0:
        raise UsageError(f"--patience {options.patience:g}: must be above 0")
    find_network(options.network)
    for strategy in options.strategy:
        find_strategy(strategy)


def _base_jobs(options: argparse.Namespace, spec: SystemSpec) -> list[Job]:
    """Return a job for each combination of conditions.

    Raises:
        UsageError: the application cannot be loaded with the options.
    """
    ftm = {"on": (True,), "off": (False,), "both": (False, True)}[options.ftm]
    chosen = application_options.alternatives(options, application_class(spec))
    for each in chosen:
        load_application(RunPlan(system_file=options.system, options=each), spec)
    return [Job(row="", system=options.system, strategy=strategy, options=each, ftm=with_ftm,
                network=options.network, seed=options.seed, patience_s=options.patience,
                duration_s=options.duration)
            for with_ftm, strategy, each in product(ftm, options.strategy or [""], chosen)]


def _choose(options: argparse.Namespace, spec: SystemSpec) -> tuple[str, list[Job]]:
    """Return a name for the campaign, and its jobs."""
    jobs = _base_jobs(options, spec)
    if options.named:
        named: NamedCampaign = options.named[0]
        return named.name, named.jobs(jobs[0])
    if options.runs is not None:
        together = f"-{options.together}" if options.together > 1 else ""
        return f"sample{together}", sample(
            jobs, fault_groups(spec), options.runs, seed=options.seed, faults=faults_of(spec),
            together=options.together, moments=_moments(spec, jobs[0]))
    planned = list(_planned(options.fault, spec))
    together = options.together
    found = [(fault,) if fault else () for fault in planned] if together == 1 else [
        each for each in combinations([fault for fault in planned if fault], together)
        if _on_different_topics(each, spec)]
    return f"faults-{together}" if together > 1 else "faults", cross(
        jobs, found, range(options.seed, options.seed + (options.seeds or 1)))


def _on_different_topics(faults: Sequence[PlannedFault], spec: SystemSpec) -> bool:
    """Whether no two faults disturb the same topic or the same process."""
    hit: list[str] = []
    of_robot, known = faults_of(spec), system_topics(spec)
    for fault in faults:
        try:
            hit += {each.topic for each in of_robot.find(fault.fault, 0, known).disturbances}
        except UnknownFaultError:
            hit.append(fault.fault.partition(":")[2])
    return len(hit) == len(set(hit))


def _moments(spec: SystemSpec, job: Job) -> tuple[float, float]:
    """Return the interval from which moments of faults are drawn: within a run without faults."""
    if found := trial_class(spec).moments:
        return found
    lasts_s = run_virtually(job).record.duration_s
    return round(min(2.0, 0.1 * lasts_s), 2), round(0.9 * lasts_s, 2)


def _planned(texts: Iterable[str], spec: SystemSpec) -> Iterable[PlannedFault | None]:
    every = [name for names in fault_groups(spec).values() for name in names]
    nodes, known, faults = can_be_hit(spec), system_topics(spec), faults_of(spec)
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


# -- running -----------------------------------------------------------------------------------


def _execute(options: argparse.Namespace, jobs: Sequence[Job], store: Store) -> int:
    unique = {job.key for job in jobs}
    done = len(unique & store.keys())
    unsafe = 0
    with tqdm(total=len(unique), initial=done, unit="run", file=sys.stderr, smoothing=0.05,
              mininterval=0.1 if sys.stderr.isatty() else _LOG_S) as bar:

        def progress(job: Job, result: RunResult) -> None:
            nonlocal unsafe
            if not result.safe:
                unsafe += 1
                bar.write(f"unsafe: {job.key} {job.text()}", file=sys.stderr)
            bar.set_postfix(unsafe=unsafe, refresh=False)
            bar.update()

        return execute(jobs, store, workers=options.jobs, progress=progress)


def _replay(options: argparse.Namespace) -> int:
    if not options.out:
        raise UsageError("--replay RUN: expected --out DIR, the directory of the campaign")
    directory = Path(options.out)
    if not directory.is_dir():
        raise UsageError(f"--out {options.out}: no such directory")
    store = Store(directory)
    found = store.find(options.replay)
    store.close()
    if found is None:
        raise UsageError(f"--replay {options.replay}: expected the key of one run in {directory}; "
                         "none or several match")
    try:
        run = virtual_run(found.job)
        again = run.run()
        changed = found.job.content not in {"", content_of(found.job)}
    except ValueError as error:
        raise UsageError(f"--replay {options.replay}: {' '.join(str(error).split())}") from None
    same = again.trace == found.result.trace
    html, data, problem = run.trial.report(again.record, directory / "replays")
    if problem:
        raise UsageError(f"report: {problem}")
    if options.json:
        print_json({"run": found.job.key, "job": found.job, "same_trace": same,
                    "content_changed": changed, "report": str(html), "record": str(data)})
    else:
        verdict = "the same run, to the byte" if same else "NOT the same run: " + (
            "system, files or code have changed" if changed else "the program has changed")
        say_text(f"{found.job.key}: {found.job.text()}\n"
                 f"{again.record.mission}, {again.record.safety}; "
                 f"{'; '.join(again.record.reasons) or 'no problem'}\n"
                 f"{verdict}\nReport: {html}")
    if not same:
        raise NoEffectError(f"run {found.job.key}: the trace differs from that in the store")
    return 0


def _write_report(options: argparse.Namespace, spec: SystemSpec, directory: Path,
                  runs: Sequence[Run], named: NamedCampaign | None) -> Path:
    about = Campaign(
        title=named.title if named else "Fault-injection campaign", seed=options.seed,
        command=f"rampart {shlex.join(sys.argv[1:])}",
        section=named.section(spec, runs) if named else None)
    return write_campaign_report(directory, about, runs)


# -- showing -----------------------------------------------------------------------------------


def _show_runs(spec: SystemSpec, runs: Sequence[Run], made: int, named: NamedCampaign | None, *,
               is_json: bool) -> None:
    """Print the results.

    Args:
        spec: the system.
        runs: all runs of the campaign.
        made: number of runs made now.
        named: the named campaign, if it is one.
        is_json: print rows for scripts.
    """
    rows = table(runs)
    if is_json:
        print_json([as_json(row) | (named.expected(runs, row) if named else {})
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


def _show_rows(spec: SystemSpec, runs: Sequence[Run], rows: Sequence[Row]) -> None:
    options, trial = varying_options(runs), trial_class(spec)
    shown = sorted(rows, key=lambda row: (row.safe.share if row.safe.of else 2.0,
                                          row.success.share if row.success.of else 2.0))
    verdicts = ("success", "safe", "worst") if trial.judges else ("restarts",)
    print_table(("fault", *options, "FTM", "strategy", "runs", "no effect", *verdicts), [
        (row.fault, *(row.options.get(name, NONE) for name in options), "yes" if row.ftm else "no",
         row.strategy or "-", row.runs, row.ineffective,
         *((_share(row.success), _share(row.safe), row.worst) if row.judged else (row.restarts,)))
        for row in shown[:_SHOWN]])
    if len(shown) > _SHOWN:
        say(f"... and {len(shown) - _SHOWN} rows more, in the report")


def _share(found: Rate) -> str:
    return f"{found.count}/{found.of}"


def _rate(found: Rate) -> str:
    return (f"{found.count} of {found.of} ({100 * found.share:.1f} %, 95 % interval "
            f"{100 * found.low:.2f} to {100 * found.high:.2f} %)" if found.of else "none")
