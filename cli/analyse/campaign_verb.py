"""`rampart campaign`: thousands of runs in virtual time with faults, and what came of them."""

from __future__ import annotations

import argparse
from typing import Any

from rampart.cli.verbs import add_verb, flag, group, number, option, several, whole, word
from rampart.sim.campaign.defaults import BACKENDS, PATIENCE_S
from rampart.sim.virtual.network import NETWORKS


def add(verbs: Any) -> None:
    """Add the verb to the parser."""
    add_verb(
        verbs, "campaign", "run many missions with faults in them", run,
        group("what is run",
              flag("--paper", "tables III, IV and V of the paper"),
              flag("--full", "with --paper: the runs of table V on the full system instead, each "
                   "of which is to end in success, safe"),
              whole("--runs", "N", "N random faults of all kinds"),
              several("--fault", "FAULT[@WHEN][+S]",
                      "this fault; may be repeated, and be a pattern of names: 'gps-*'"),
              whole("--together", "K", "with --runs: K faults in each (default 1)", 1),
              word("--kinds", "K,...", "with --runs: only these kinds of faults (paper, sensor, "
                   "topic, process, actuator, world)"),
              whole("--search", "N",
                    "N runs of an optimiser that looks for the smallest safety margin"),
              word("--replay", "RUN", "repeat a run of --out by its key"),
              flag("--list", "list the faults that there are")),
        group("under which conditions",
              word("--system", "SPEC", "file, or name of a shipped system (default: osmosis, the "
                   "full one; with --paper alone: paper)"),
              word("--mission", "NAME", "default: A", "A"),
              word("--airport", "NAME", "default: the system's", ""),
              word("--obstacles", "N,...", "how many of the airport's; several are crossed, or "
                   "drawn from with --runs (default: 0,2)", "0,2"),
              option("--ftm", choices=("on", "off", "both"), default="on",
                     help="fault tolerance, the paper's baseline, or both (default: on)"),
              several("--strategy", "NAME",
                      "of the manager; may be repeated (default: the system's)"),
              word("--network", "NAME", f"{', '.join(NETWORKS)} (default: measured)", "measured"),
              whole("--seed", "N", "default: 1", 1),
              whole("--seeds", "N",
                    "with --fault: so many runs of each, from --seed on (default: 1)", 1),
              number("--patience", "S", "simulated seconds without progress that end a run "
                     f"(default: {PATIENCE_S:g})", PATIENCE_S)),
        group("where",
              word("--out", "DIR", "default: reports/campaign-NAME, by what is run"),
              whole("--jobs", "N", "processes (default: one per core)", 0),
              option("--backend", default="loky", choices=BACKENDS,
                     help="loky is this machine; dask and ray are existing clusters"),
              word("--address", "A", "of the cluster's scheduler", "")),
        flag("--json", "print the rows as JSON"))


def run(options: argparse.Namespace) -> int:
    """Run the campaign, or what else was asked for.

    Run missions in virtual time with faults injected, on all cores, and say how
    often the robot succeeded and whether it was always safe.

    Examples:
      rampart campaign --paper                       the paper's tables, beside the paper's verdicts
      rampart campaign --paper --full                ... their rows on the full system
      rampart campaign --runs 200                    200 random single faults
      rampart campaign --runs 200 --together 2       ... pairs of faults
      rampart campaign --fault 'kill:*' --seeds 5    every process killed, five seeds each
      rampart campaign --fault gps-bias@20+5 --obstacles 0,2 --ftm both
      rampart campaign --list                        the faults that there are
      rampart campaign --replay 3f2a --out DIR       repeat one run of DIR and write its report
      rampart campaign --search 200                  look for the fault with the smallest margin
    The same command goes on where it was interrupted; each run is made once. Results, with a
    report, are in --out.

    exit code: 0 no unsafe run with fault tolerance, 1 there was one, or with --full one that
    failed, 2 bad usage, or it could not be finished, as on a full disk
    """
    from rampart.cli.analyse.campaigning import campaign  # noqa: PLC0415 physics and all: other verbs need not

    return campaign(options)
