"""`kill-node` for what runs on another host: its supervisor there signals it, told over the bus."""

from __future__ import annotations

import asyncio
import sys
import uuid

from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics
from rampart.actors.supervision import kill_node
from rampart.actors.supervision.kill_node import SignalError, Signalled
from rampart.cli.session import UsageError, connect

_TABLE_S = 2.0
_ANSWER_S = 5.0


def main(arguments: list[str] | None = None) -> int:
    """Run `kill-node`, with nodes of other hosts as well."""
    return kill_node.main(arguments, signal_elsewhere)


def signal_elsewhere(node: str, name: str, port: int | None) -> Signalled | None:
    """Have a node of another host signalled; None if the run knows no such node.

    Raises:
        SignalError: it was refused, nobody answered, or there is no run.
    """
    try:
        return asyncio.run(_signal(node, name, port))
    except UsageError as error:
        raise SignalError(str(error)) from None


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


if __name__ == "__main__":
    sys.exit(main())
