"""`kill-node` for what runs on other hosts: their supervisors list and signal it, over the bus."""

from __future__ import annotations

import asyncio
import sys
import uuid
from collections.abc import Mapping

from rampart.actors.bus.envelope import Header
from rampart.actors.bus.run_info import RunInfo, find_runs
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics
from rampart.actors.supervision import kill_node
from rampart.actors.supervision.kill_node import (
    Elsewhere,
    OtherProcess,
    RunElsewhere,
    SignalError,
    Signalled,
    UnknownNodeError,
    signal_node,
)
from rampart.cli.session import UsageError, connect

_TABLE_S = 2.0
_ANSWER_S = 5.0

_LISTED_S = 1.0
"""Simulated seconds that the other hosts' tables are waited for: each repeats its own twice."""

_GONE = (fm.NodeState.CRASHED, fm.NodeState.GIVEN_UP, fm.NodeState.UNREACHABLE)
"""A row of a table that stands for no process: it has ended, or was given back."""

_PATIENCE_S = 3.0
"""Real seconds that the bus is waited for, to list what runs on other hosts."""


class OtherHosts(Elsewhere):
    """The other hosts of the runs of this machine."""

    def signal(self, node: str, name: str, port: int | None) -> Signalled | None:
        """Have a node of another host signalled; None if the run knows no such node.

        Raises:
            SignalError: it was refused, nobody answered, or there is no run.
        """
        try:
            return asyncio.run(_signal(node, name, port))
        except UsageError as error:
            raise SignalError(str(error)) from None

    def runs(self, port: int | None) -> list[RunElsewhere]:
        """Return what runs on other hosts, of the runs here that have some."""
        return [asyncio.run(_listed(run)) for run in find_runs()
                if run.hosts and port in {None, run.base_port}]


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
    """Run `kill-node`, with nodes of other hosts as well."""
    return kill_node.main(arguments, OtherHosts())


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
