"""`rampart campaign`: thousands of runs in virtual time with faults, and what came of them."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib.metadata import entry_points

from rampart.actors.system.members import application_class
from rampart.cli import application_options, systems
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
from rampart.sim.campaign.defaults import BACKENDS, PATIENCE_S, SEEDS
from rampart.sim.campaign.named import NamedCampaign
from rampart.sim.virtual.network import NETWORKS

_CHOICE = (
    whole("--runs", "N", "N random faults of all kinds"),
    several("--fault", "FAULT[@WHEN][+S]",
            "this fault; may be repeated, and be a pattern of names: 'kill:*'"),
    whole("--together", "K", "K faults in each run (default 1); with --fault: every combination of "
          "K of those on different topics", 1),
    word("--kinds", "K,...", "with --runs or --search: only these kinds of faults, of those that "
         "--list shows"),
    whole("--search", "N", "N runs of an optimiser that looks for the smallest safety margin"),
    word("--replay", "RUN", "repeat a run of --out by its key"),
    flag("--list", "list the faults that there are"))

_CONDITIONS = (
    option("--ftm", choices=("on", "off", "both"), default="on",
           help="fault tolerance, the unprotected baseline, or both (default: on)"),
    several("--strategy", "NAME", "of the manager; may be repeated (default: the system's)"),
    word("--network", "NAME", f"{', '.join(NETWORKS)} (default: measured)", "measured"),
    whole("--seed", "N", "default: 1", 1),
    whole("--seeds", "N", "with --fault: so many runs of each, from --seed on (default: 1); with "
          "--search: so many among the runs (default: 1); with "
          f"--runs: so many seeds among them (default: {SEEDS})"),
    number("--patience", "S", "simulated seconds without progress that end a run "
           f"(default: {PATIENCE_S:g})", PATIENCE_S),
    number("--duration", "S", "simulated seconds that a run of a system without a mission takes "
           "(default: what the system's [end] says)"))

_PLACE = (
    word("--out", "DIR", "default: reports/campaign-NAME, by what is run"),
    whole("--jobs", "N", "processes (default: one per core)", 0),
    option("--backend", default="loky", choices=BACKENDS,
           help="loky is this machine; dask and ray are existing clusters"),
    word("--address", "A", "of the cluster's scheduler", ""))


def parser(program: str, system: str, campaigns: Sequence[type[NamedCampaign]]
           ) -> argparse.ArgumentParser:
    """Return the parser of the verb.

    Args:
        program: as it is typed.
        system: whose options it takes.
        campaigns: that have names, and options of their own.

    Raises:
        UsageError: there is no such system.
    """
    which = "".join(f"; with {each.flag} alone: {each.system}" for each in campaigns)
    made = argparse.ArgumentParser(prog=program, **help_of(run.__doc__ or ""))
    what = made.add_argument_group("what is run")
    for each in campaigns:
        each.add(what)
    add_options(what, _CHOICE)
    add_options(made, (
        group("under which conditions",
              word("--system", "SPEC", "file, or name of a shipped system (default: "
                   f"{systems.DEFAULT.stem}{which}); its options, below, take several values, "
                   "which are crossed, or drawn from with --runs"), *_CONDITIONS),
        group("where", *_PLACE), flag("--json", "print the rows as JSON")))
    spec = systems.load(system)
    application_options.add(made, application_class(spec), spec.application, crossed=True)
    return made


def parse(arguments: Sequence[str], program: str = "rampart campaign") -> argparse.Namespace:
    """Return the options, with the campaign that has a name if one was chosen as `named`.

    Raises:
        UsageError: there is no such system, or the options make no sense together.
    """
    campaigns = [found.load() for found in sorted(
        entry_points(group="rampart.campaigns"), key=lambda campaign: campaign.name)]
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    what = first.add_argument_group()
    for each in campaigns:
        each.add(what)
    first.add_argument("--system")
    said = first.parse_known_args(arguments)[0]
    named = [chosen for each in campaigns if (chosen := each.chosen(said))]
    default = named[0].system if named else systems.DEFAULT.stem
    options = parser(program, said.system or default, campaigns).parse_args(arguments)
    options.system = options.system or default
    options.named, options.run, options.flags = named, run, [each.flag for each in campaigns]
    return options


def run(options: argparse.Namespace) -> int:
    """Run the campaign, or what else was asked for.

    Run missions in virtual time with faults injected, on all cores, and say how
    often the robot succeeded and whether it was always safe.

    Examples:
      rampart campaign --paper                       the paper's tables, beside the paper's verdicts
      rampart campaign --paper --full                ... their rows on the full system
      rampart campaign --runs 200                    200 random single faults, 20 seeds
      rampart campaign --runs 200 --seeds 200        ... each with a seed of its own: slower
      rampart campaign --runs 200 --together 2       ... pairs of faults
      rampart campaign --fault 'kill:*' --seeds 5    every process killed, five seeds each
      rampart campaign --fault gps-bias@20+5 --obstacles 0,2 --ftm both
      rampart campaign --fault 'gps-*@30+inf' --fault 'imu-*@30+inf' --together 2   every pair
      rampart campaign --list                        the faults that there are
      rampart campaign --replay 3f2a --out DIR       repeat one run of DIR and write its report
      rampart campaign --search 200                  look for the fault with the smallest margin
    The same command goes on where it was interrupted; each run is made once. Results, with a
    report, are in --out.

    exit code: 0 no unsafe run with fault tolerance, 1 there was one, or with --full one that
    failed, 2 bad usage, or it could not be finished, as on a full disk
    """
    from rampart.cli.analyse.campaigning import campaign  # noqa: PLC0415 physics and all: help needs none

    return campaign(options)
