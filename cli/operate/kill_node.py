"""`kill-node`: fault injection from the shell, on this host and others.

A process of this host is found in /proc and signalled. What runs on other hosts is listed and
signalled by their supervisors, over the bus.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import sys
import uuid
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from rampart.actors.bus.envelope import Header
from rampart.actors.bus.run_info import RunInfo, find_runs
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics
from rampart.actors.supervision.kill_node import (
    SIGNALS,
    SignalError,
    UnknownNodeError,
    signal_node,
)
from rampart.actors.supervision.process_title import find_processes
from rampart.cli import completion
from rampart.cli.session import UsageError, connect
from rampart.files import streams
from rampart.files.plain_text import one_line

_EPILOG = """\
signals:
  KILL   end the process at once (default)
  STOP   freeze the process; CONT continues it
  TERM   end the process in order; the supervisor treats this as a crash, too
  SEGV   crash the process as a memory error does
  WEDGE  hang the process: it exists, and its event loop is blocked (SIGUSR2)

examples:
  kill-node osmosis_control                  # it is restarted
  kill-node localization --signal STOP       # its heartbeat stops: it is replaced
  kill-node --list                           # list the nodes
In a system of several hosts it signals and lists the nodes of all hosts.
`kill -9 PID` and `pkill -9 -f osmosis_control` also work.
"""

_TABLE_S = 2.0
_ANSWER_S = 5.0

_LISTED_S = 1.0
"""Simulated seconds that the other hosts' tables are waited for: each repeats its own twice."""

_GONE = (fm.NodeState.CRASHED, fm.NodeState.GIVEN_UP, fm.NodeState.UNREACHABLE)
"""A row of a table that stands for no process: it has ended, or was given back."""

_PATIENCE_S = 3.0
"""Real seconds that the bus is waited for, to list what runs on other hosts."""


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


async def signal_anywhere(node: str, name: str, port: int | None) -> Signalled:
    """Send a signal to a node of this host, or have it sent on another one.

    Raises:
        SignalError: there is no such node, or it cannot be signalled.
        UsageError: there is no run.
    """
    try:
        process = signal_node(node, name, port)
        return Signalled(process.pid, process.incarnation)
    except UnknownNodeError:
        if (found := await _signal(node, name, port)) is None:
            raise
        return found


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code: 0 signalled, 2 bad usage or no such node."""
    streams.secure()
    parser = build_parser()
    completion.complete(parser)
    options = parser.parse_args(arguments)
    act = _list_nodes if options.list else _signal_node
    try:
        for line in act(options):
            print(line)
    except (SignalError, UsageError) as refusal:
        print(f"kill-node: {refusal}", file=sys.stderr)
        return 2
    return 0


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(
        prog="kill-node", description="Kill, stop or hang a node of a running robot.",
        epilog=_EPILOG, formatter_class=argparse.RawDescriptionHelpFormatter)
    node: Any = parser.add_argument("node", nargs="?",
                                    help="name of the node, for example osmosis_control")
    node.completer = completion.nodes
    parser.add_argument("--signal", default="KILL", type=str.upper, metavar="SIG",
                        help="KILL (default), STOP, CONT, TERM, SEGV or WEDGE")
    parser.add_argument("--port", type=int, default=os.environ.get("RAMPART_PORT") or None,
                        help="base port of the run, if this machine has several (default: the "
                             "variable RAMPART_PORT)")
    parser.add_argument("--list", action="store_true", help="list the nodes of all runs")
    parser.add_argument("--json", action="store_true", help="print JSON")
    return parser


def _signal_node(options: argparse.Namespace) -> list[str]:
    if options.node is None:
        raise SignalError("no node given; --list shows what there is")
    if options.signal not in SIGNALS:
        raise SignalError(f"--signal {options.signal}: unknown signal; known: {', '.join(SIGNALS)}")
    victim = asyncio.run(signal_anywhere(options.node, options.signal, options.port))
    if options.json:
        return [json.dumps({"node": options.node, "pid": victim.pid, "signal": options.signal,
                            "incarnation": victim.incarnation})]
    return [f"{options.node} (pid {victim.pid}, incarnation {victim.incarnation}): "
            f"{options.signal}"]


def _list_nodes(options: argparse.Namespace) -> list[str]:
    """Return the nodes of this machine as its kernel has them, and those that other hosts list."""
    runs = [asyncio.run(_listed(run)) for run in find_runs()
            if run.hosts and options.port in {None, run.base_port}]
    own_hosts = {run.port: run.host for run in runs}
    rows: list[dict[str, Any]] = [
        {"name": name, "pid": p.pid, "incarnation": p.incarnation, "port": p.port,
         **({"host": own_hosts[p.port]} if p.port in own_hosts else {})}
        for p in find_processes(options.port) for name in p.names]
    for run in runs:
        rows += ({**one._asdict(), "port": run.port} for one in run.processes)
        if run.missing:
            print(f"kill-node: {one_line(run.missing)}", file=sys.stderr)
    if options.json:
        return [json.dumps(rows)]
    width = max((len(row.get("host", "")) for row in rows), default=0)
    return ["{port:>6} {pid:>8} #{incarnation:<4} {where}{name}".format(
        where=f"{row.get('host', ''):<{width}} " if width else "", **row) for row in rows]


async def _signal(node: str, name: str, port: int | None) -> Signalled | None:
    async with connect(port) as session:
        heard = await session.latest((topics.NODES,), _TABLE_S)
        table: fm.NodeTable | None = heard.get(topics.NODES.key)
        host = next((row.host for row in table.nodes if row.name == node), None) if table else None
        if host is None:
            return None
        order = fm.SignalOrder(f"kill-node-{uuid.uuid4().hex[:10]}", node, name)
        answers: list[fm.ProcessEvent] = []

        def event(_key: str, _header: object, body: fm.ProcessEvent) -> None:
            if body.by == order.order:
                answers.append(body)

        session.listen(topics.PROCESS_EVENT, topics.PROCESS_EVENT.at(), event)
        if not await session.command(topics.SIGNAL, order, lambda: bool(answers), _ANSWER_S):
            raise SignalError(f"{node}: no answer from the supervisor of host "
                              f"{host or 'the first'} within {_ANSWER_S:g} s")
    [answer, *_] = answers
    if answer.event != "signalled":
        raise SignalError(f"{node}: {answer.detail}")
    return Signalled(answer.pid, answer.incarnation)


async def _listed(run: RunInfo) -> RunElsewhere:
    """Return what the supervisors of the other hosts say they run, as far as they are heard."""
    others = {supervisor: host for host, supervisor in run.hosts.items() if host != run.own_host}
    tables: dict[str, fm.NodeTable] = {}
    complete, why = asyncio.Event(), "nothing was heard"

    def heard(_key: str, header: Header, table: fm.NodeTable) -> None:
        if header.source in others:
            tables[header.source] = table
        if len(tables) == len(others):
            complete.set()

    try:
        async with asyncio.timeout(_PATIENCE_S + _LISTED_S / run.rate):
            async with connect(run.base_port) as session:
                for supervisor in others:
                    session.listen(topics.HOST_NODES, topics.HOST_NODES.at(supervisor), heard)
                async with asyncio.timeout(session.real_s(_LISTED_S)):
                    await complete.wait()
    except UsageError as error:
        why = str(error)
    except TimeoutError:
        pass
    return listed(run, {others[supervisor]: table for supervisor, table in tables.items()}, why)


def listed(run: RunInfo, tables: Mapping[str, fm.NodeTable], why: str) -> RunElsewhere:
    """Return what runs on other hosts.

    Args:
        run: as this machine's launcher knows it.
        tables: of those hosts that were heard, what the supervisor of each runs.
        why: others were not.
    """
    missing = [host for host in run.hosts if host != run.own_host and host not in tables]
    processes = tuple(OtherProcess(host, row.name, row.pid, row.incarnation)
                      for host, table in tables.items() for row in table.nodes
                      if row.pid and row.state not in _GONE)
    return RunElsewhere(
        run.base_port, run.own_host, processes,
        f"the processes of {' and '.join(missing)} are missing: {why}" if missing else "")


if __name__ == "__main__":
    sys.exit(main())
