"""`rampart campaign`: thousands of runs in virtual time with faults, and a report."""

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
from rampart.sim.campaign.defaults import PATIENCE_S
from rampart.sim.campaign.named import NamedCampaign
from rampart.sim.virtual.network import NETWORKS

_CHOICE = (
    whole("--runs", "N", "inject N random faults of all kinds, one per run"),
    several("--fault", "FAULT[@WHEN][+S]",
            "inject this fault, or all that match a pattern such as 'kill:*'; repeatable"),
    whole("--together", "K", "K faults in each run (default: 1); with --fault: every combination "
          "of K on different topics", 1),
    word("--kinds", "K,...", "with --runs: only these kinds of faults of --list"),
    word("--replay", "RUN", "repeat a run of --out by its key, with a report"),
    flag("--list", "list the faults of the system"))

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
    made = argparse.ArgumentParser(prog=program, **help_of(run.__doc__ or ""))
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
    options.named, options.run, options.flags = named, run, [each.flag for each in campaigns]
    return options


def run(options: argparse.Namespace) -> int:
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
      rampart campaign --list                        # the faults of the system
      rampart campaign --replay 3f2a --out DIR       # repeat one run of DIR
      rampart campaign --paper                       # the paper's tables
      rampart campaign --paper --full                # its rows on the full system

    exit code: 0 no unsafe run with fault tolerance; 1 an unsafe run, or a failed run
    with --full; 2 bad usage, or not completed, for example on a full disk
    """
    from rampart.cli.analyse.campaigning import campaign  # noqa: PLC0415 physics and all: help needs none

    return campaign(options)
