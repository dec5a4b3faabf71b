"""`kill-node`: fault injection from the shell. Finds a node's process in /proc and signals it."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
from dataclasses import dataclass
from typing import Any, NamedTuple

from rampart.actors.supervision.process_title import RunProcess, find_processes
from rampart.files import streams
from rampart.files.plain_text import one_line

SIGNALS = {name: signal.Signals[f"SIG{name}"] for name in ("KILL", "STOP", "CONT", "TERM", "SEGV")}
SIGNALS["WEDGE"] = signal.SIGUSR2

_EPILOG = """\
signals:
  KILL   the process is gone at once (default)
  STOP   the process stands still, as under a debugger; CONT lets it go on
  TERM   the process ends in order; its supervisor takes that for a crash all the same
  SEGV   as if it had touched memory that is not there
  WEDGE  the process stays, its event loop turns no more (SIGUSR2)

examples:
  kill-node osmosis_control                  kill it and watch it come back
  kill-node localization --signal STOP       only its heartbeat shows that it is gone
  kill-node --list                           what there is to kill
In a system of several hosts it reaches, and lists, the nodes of all of them.
A plain `kill -9 PID` or `pkill -9 -f osmosis_control` does the same.
"""


class SignalError(Exception):
    """A node cannot be signalled; one line for the user."""


class UnknownNodeError(SignalError):
    """No process of this machine is the node's."""


def signal_node(node: str, name: str, port: int | None = None) -> RunProcess:
    """Send a signal of `SIGNALS` to the newest process of a node and return which it was.

    Args:
        node: its name, as in the process's title.
        name: of the signal, e.g. "KILL".
        port: base port of the run; None if there is but one.

    Raises:
        SignalError: there is no such node or signal, or it may not be sent.
    """
    victim = find_node(node, name, port)
    try:
        os.kill(victim.pid, SIGNALS[name])
    except OSError as error:
        raise SignalError(f"{node} (pid {victim.pid}): {error.strerror}") from None
    return victim


def find_node(node: str, name: str, port: int | None = None) -> RunProcess:
    """Return what `signal_node` would signal.

    Raises:
        SignalError: there is no such node or signal.
    """
    if name not in SIGNALS:
        raise SignalError(f"unknown signal {name!r}; known: {', '.join(SIGNALS)}")
    return _find(find_processes(port), node, port)


class Signalled(NamedTuple):
    """Which process got a signal."""

    pid: int
    incarnation: int


class OtherProcess(NamedTuple):
    """A node's process on another machine."""

    host: str
    name: str
    pid: int
    incarnation: int


@dataclass(frozen=True, slots=True)
class RunElsewhere:
    """What a run has on other machines.

    Attributes:
        port: its base port on this one.
        host: name of this one.
        processes: of the others.
        missing: why which others' processes are not among them, in a line; "" if none are missing.
    """

    port: int
    host: str
    processes: tuple[OtherProcess, ...] = ()
    missing: str = ""


class Elsewhere:
    """What can be known of, and done on, other machines: here nothing."""

    def signal(self, _node: str, _name: str, _port: int | None) -> Signalled | None:
        """Signal a node that no process of this machine is; None if nobody knows of such a node.

        Raises:
            SignalError: it cannot be done.
        """
        return None

    def runs(self, _port: int | None) -> list[RunElsewhere]:
        """Return the runs of this machine, or the one on a base port, that have others as well."""
        return []


def main(arguments: list[str] | None = None, elsewhere: Elsewhere | None = None) -> int:
    """Run the command and return its exit code: 0 signalled, 2 bad usage or no such node."""
    streams.secure()
    options = _parser().parse_args(arguments)
    act = _listed if options.list else _signalled
    try:
        for line in act(options, elsewhere or Elsewhere()):
            print(line)
    except SignalError as refusal:
        print(f"kill-node: {refusal}", file=sys.stderr)
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="kill-node", description="Kill, stop or wedge a node of a running robot.",
        epilog=_EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("node", nargs="?", help="name of the node, e.g. osmosis_control")
    parser.add_argument("--signal", default="KILL", type=str.upper, metavar="SIG",
                        help="KILL (default), STOP, CONT, TERM, SEGV or WEDGE")
    parser.add_argument("--port", type=int, default=os.environ.get("RAMPART_PORT") or None,
                        help="base port of the run, if there are several (default: RAMPART_PORT "
                             "of the environment)")
    parser.add_argument("--list", action="store_true", help="list the nodes of the run(s)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    return parser


def _signalled(options: argparse.Namespace, elsewhere: Elsewhere) -> list[str]:
    if options.node is None:
        raise SignalError("no node given; --list shows what there is")
    if options.signal not in SIGNALS:
        raise SignalError(f"--signal {options.signal}: unknown signal; known: {', '.join(SIGNALS)}")
    try:
        process = signal_node(options.node, options.signal, options.port)
        victim = Signalled(process.pid, process.incarnation)
    except UnknownNodeError:
        found = elsewhere.signal(options.node, options.signal, options.port)
        if found is None:
            raise
        victim = found
    if options.json:
        return [json.dumps({"node": options.node, "pid": victim.pid, "signal": options.signal,
                            "incarnation": victim.incarnation})]
    return [f"{options.node} (pid {victim.pid}, incarnation {victim.incarnation}): "
            f"{options.signal}"]


def _listed(options: argparse.Namespace, elsewhere: Elsewhere) -> list[str]:
    """Return what there is: of this machine by its kernel, of others by what they tell."""
    rows: list[dict[str, Any]] = [
        {"name": name, "pid": p.pid, "incarnation": p.incarnation, "port": p.port}
        for p in find_processes(options.port) for name in p.names]
    runs = {run.port: run for run in elsewhere.runs(options.port)}
    for row in rows if runs else ():
        if row["port"] in runs:
            row["host"] = runs[row["port"]].host
    for run in runs.values():
        rows += ({**one._asdict(), "port": run.port} for one in run.processes)
        if run.missing:
            print(f"kill-node: {one_line(run.missing)}", file=sys.stderr)
    if options.json:
        return [json.dumps(rows)]
    width = max((len(row.get("host", "")) for row in rows), default=0)
    return ["{port:>6} {pid:>8} #{incarnation:<4} {where}{name}".format(
        where=f"{row.get('host', ''):<{width}} " if width else "", **row) for row in rows]


def _find(processes: list[RunProcess], node: str, port: int | None) -> RunProcess:
    where = f" on port {port}" if port is not None else ""
    if not processes:
        raise SignalError(f"no run found{where}; start one with `python launch.py`")
    matches = [p for p in processes if node in p.names]
    if not matches:
        known = ", ".join(sorted({n for p in processes for n in p.names}))
        raise UnknownNodeError(f"unknown node {node!r}{where}; known: {known}")
    if len({p.port for p in matches}) > 1:
        ports = ", ".join(str(p.port) for p in matches)
        raise SignalError(f"{node}: in several runs; choose one with --port: {ports}")
    return max(matches, key=lambda p: p.incarnation)


if __name__ == "__main__":
    sys.exit(main())
