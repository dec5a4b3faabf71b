"""`rampart campaign`: thousands of runs in virtual time with faults, and what came of them."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib.metadata import entry_points

from rampart.actors.layout.layout import application_class
from rampart.cli import application_options, systems
from rampart.sim.campaign.defaults import BACKENDS, PATIENCE_S
from rampart.sim.campaign.named import NamedCampaign
from rampart.sim.virtual.network import NETWORKS

_EPILOG = """examples:
  rampart campaign --paper                       the paper's tables, beside the paper's verdicts
  rampart campaign --paper --full                ... their rows on the full system
  rampart campaign --runs 200                    200 random single faults
  rampart campaign --runs 200 --together 2       ... pairs of faults
  rampart campaign --fault 'kill:*' --seeds 5    every process killed, five seeds each
  rampart campaign --fault gps-bias@20+5 --obstacles 0,2 --ftm both
  rampart campaign --list                        the faults that there are
  rampart campaign --replay 3f2a --out DIR       repeat one run of DIR and write its report
  rampart campaign --search 200                  look for the fault with the smallest margin
The same command goes on where it was interrupted; each run is made once. Results, with a report,
are in --out.

exit code: 0 no unsafe run with fault tolerance, 1 there was one, or with --full one that failed,
2 bad usage, or it could not be finished, as on a full disk"""


def parser(program: str, system: str | None, campaigns: Sequence[type[NamedCampaign]]
           ) -> argparse.ArgumentParser:
    """Return the parser of the verb.

    Args:
        program: as it is typed.
        system: whose options it takes.
        campaigns: that have names, and options of their own.

    Raises:
        UsageError: there is no such system.
    """
    parser = argparse.ArgumentParser(
        prog=program, formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Run missions in virtual time with faults injected, on all cores, and say how\n"
                    "often the robot succeeded and whether it was always safe.",
        epilog=_EPILOG)
    what = parser.add_argument_group("what is run")
    for campaign in campaigns:
        campaign.add(what)
    what.add_argument("--runs", type=int, metavar="N", help="N random faults of all kinds")
    what.add_argument("--fault", action="append", default=[], metavar="FAULT[@WHEN][+S]",
                      help="this fault; may be repeated, and be a pattern of names: 'gps-*'")
    what.add_argument("--together", type=int, default=1, metavar="K",
                      help="with --runs: K faults in each (default 1)")
    what.add_argument("--kinds", metavar="K,...",
                      help="with --runs: only these kinds of faults, of those that --list shows")
    what.add_argument("--search", type=int, metavar="N",
                      help="N runs of an optimiser that looks for the smallest safety margin")
    what.add_argument("--replay", metavar="RUN", help="repeat a run of --out by its key")
    what.add_argument("--list", action="store_true", help="list the faults that there are")
    how = parser.add_argument_group("under which conditions")
    how.add_argument("--system", metavar="SPEC",
                     help=f"file, or name of a shipped system (default: {systems.DEFAULT.stem}"
                     f"{''.join(f'; with {c.flag} alone: {c.system}' for c in campaigns)}); its "
                     "options, below, take several values, which are crossed, or drawn from with "
                     "--runs")
    how.add_argument("--ftm", choices=("on", "off", "both"), default="on",
                     help="fault tolerance, the paper's baseline, or both (default: on)")
    how.add_argument("--strategy", action="append", default=[], metavar="NAME",
                     help="of the manager; may be repeated (default: the system's)")
    how.add_argument("--network", default="measured", metavar="NAME",
                     help=f"{', '.join(NETWORKS)} (default: measured)")
    how.add_argument("--seed", type=int, default=1, metavar="N", help="default: 1")
    how.add_argument("--seeds", type=int, default=1, metavar="N",
                     help="with --fault: so many runs of each, from --seed on (default: 1)")
    how.add_argument("--patience", type=float, default=PATIENCE_S, metavar="S",
                     help=f"simulated seconds without progress that end a run "
                     f"(default: {PATIENCE_S:g})")
    where = parser.add_argument_group("where")
    where.add_argument("--out", metavar="DIR",
                       help="default: reports/campaign-NAME, by what is run")
    where.add_argument("--jobs", type=int, default=0, metavar="N",
                       help="processes (default: one per core)")
    where.add_argument("--backend", default="loky", choices=BACKENDS,
                       help="loky is this machine; dask and ray are existing clusters")
    where.add_argument("--address", default="", metavar="A", help="of the cluster's scheduler")
    parser.add_argument("--json", action="store_true", help="print the rows as JSON")
    spec = systems.load(system)
    application_options.add(parser, application_class(spec), spec.application, crossed=True)
    return parser


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
    """Run the campaign, or what else was asked for."""
    from rampart.cli.analyse.campaigning import campaign  # noqa: PLC0415 physics and all: help needs none

    return campaign(options)
