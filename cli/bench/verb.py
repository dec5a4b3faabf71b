"""`rampart bench`: how fast the system is, against peers and floors measured in the same run."""

from __future__ import annotations

import argparse
from typing import Any

from rampart import systems
from rampart.cli.bench.figures import PARTS, SIZES
from rampart.cli.bench.peers import KEEPERS
from rampart.cli.verbs import JSON, add_verb, option, several, whole, word


def add(verbs: Any) -> None:
    """Add the verb to the parser."""
    add_verb(
        verbs, "bench", "measure it, against peers and floors", run,
        option("--only", action="append", default=[], choices=PARTS,
               help="this part alone; may be repeated (default: all)"),
        whole("--kills", "N", "of each node, under each keeper (default: 12)", 12),
        several("--peer", "NAME", f"only this keeper; may be repeated: {', '.join(KEEPERS)}"),
        word("--peers-in", "DIR", "environment in which the peers are installed (default: "
             ".venv-peers)", ".venv-peers"),
        word("--system", "SPEC", "whose nodes are killed: a file, or name of a shipped system "
             f"(default: {systems.DEFAULT.stem})"),
        several("--node", "NAME", "kill only this one; may be repeated (default: all nodes, one "
                "detection and one recovery module)"),
        word("--sizes", "N,...", f"processes of the synthetic systems (default: {SIZES})", SIZES),
        word("--out", "DIR", "where bench.html, bench.json and the plots go (default: "
             "reports/bench)", "reports/bench"),
        JSON)


def run(options: argparse.Namespace) -> int:
    """Measure, show, and write the page.

    Measure how soon a killed process works again, and what a system costs, on
    this machine. Five parts:

      peers    one small node (Zenoh, numpy, input at 20 Hz) killed under dora,
               supervisord, circus, a loop round subprocess, and under Rampart: as
               the same command, and as an actor. `make bench-peers` installs peers
      floors   a fork, an interpreter, a Zenoh round trip without actors, physics
               alone: what cannot be beaten, with the ratio to what Rampart takes
      restart  every node of a whole system killed while it works
      size     systems of 10 to 140 processes: start, memory, processor, restart
      keys     the same nodes killed, and round trips, with keys and without, in turn;
               needs the extra: pip install 'rampart[keys]'

    Kills go round: each round kills once under each keeper, so that a slow moment of
    the machine hits all. Ratios are of the same run; figures of two runs, or of a
    machine that does other work, say little. Ctrl-C ends all that was started.

    Examples:
      rampart bench                                  all, a quarter of an hour
      rampart bench --only peers --kills 30          the peers alone, more kills
      rampart bench --only peers --peer dora --peer rampart-actor
      rampart bench --only restart --system my.toml --node planner
      rampart bench --only size --sizes 10,140
      rampart bench --json > figures.json            for machines

    exit code: 0 it was measured; 1 something did not start, did not come back or is
    not installed, which its row says; 2 bad usage
    """
    from rampart.cli.bench.measuring import bench  # noqa: PLC0415 physics and all: help needs none

    return bench(options)
