"""`kill-node`: fault injection from the shell. Finds a node's process in /proc and signals it."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
from collections.abc import Callable
from typing import NamedTuple

from rampart.actors.supervision.process_title import RunProcess, find_processes
from rampart.files import streams

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
In a system of several hosts it reaches nodes of all of them; --list shows those of this one.
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


Elsewhere = Callable[[str, str, int | None], Signalled | None]
"""Signals a node that no process of this machine is: name, signal, port of the run; None if nobody
knows of such a node. It raises `SignalError` if it cannot."""


def main(arguments: list[str] | None = None,
         elsewhere: Elsewhere = lambda _node, _name, _port: None) -> int:
    """Run the command and return its exit code: 0 signalled, 2 bad usage or no such node."""
    streams.secure()
    options = _parser().parse_args(arguments)
    try:
        for line in _listed(options) if options.list else _signalled(options, elsewhere):
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
        found = elsewhere(options.node, options.signal, options.port)
        if found is None:
            raise
        victim = found
    if options.json:
        return [json.dumps({"node": options.node, "pid": victim.pid, "signal": options.signal,
                            "incarnation": victim.incarnation})]
    return [f"{options.node} (pid {victim.pid}, incarnation {victim.incarnation}): "
            f"{options.signal}"]


def _listed(options: argparse.Namespace) -> list[str]:
    rows = [{"name": name, "pid": p.pid, "incarnation": p.incarnation, "port": p.port}
            for p in find_processes(options.port) for name in p.names]
    if options.json:
        return [json.dumps(rows)]
    return ["{port:>6} {pid:>8} #{incarnation:<4} {name}".format(**row) for row in rows]


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
