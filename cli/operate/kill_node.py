"""`kill-node`: signals to nodes of this host and of other hosts.

Kill, stop or hang a node of a running robot.

Examples:
  kill-node osmosis_control                  # it is restarted
  kill-node localization --signal STOP       # its heartbeat stops: it is replaced
In a system of several hosts it signals nodes of all hosts. `rampart node list` lists
the nodes. `kill -9 PID` also works.

signals:
  KILL   end the process at once (default)
  STOP   freeze the process; CONT continues it
  TERM   end the process in order; the supervisor treats this as a crash, too
  SEGV   crash the process as a memory error does
  WEDGE  hang the process: it exists, and its event loop is blocked (SIGUSR2)
STOP, CONT, TERM and SEGV go to the program of a node that has a `command`, and
to all of its process group. KILL of the node's own process ends the program too.
"""
# A process of this host is found in /proc. The supervisors of other hosts signal their processes,
# over the bus.

from __future__ import annotations

import argparse
import asyncio
import json
import sys
import uuid

import argcomplete

from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics
from rampart.actors.supervision.kill_node import (
    SIGNALS,
    SignalError,
    UnknownNodeError,
    signal_node,
)
from rampart.actors.supervision.process_title import RunProcess
from rampart.cli import completion
from rampart.cli.output import say
from rampart.cli.session import connect
from rampart.cli.verbs import JSON, PORT, add_options, help_of, option
from rampart.files import streams

_TABLE_S = 2.0
_ANSWER_S = 5.0


async def signal_anywhere(node: str, name: str, port: int | None) -> RunProcess | fm.ProcessEvent:
    """Send a signal to a node of this host or of another one; return pid and incarnation.

    Raises:
        SignalError: there is no such node, or it cannot be signalled.
        UsageError: there is no run.
    """
    try:
        return signal_node(node, name, port)
    except UnknownNodeError:
        if (found := await _signal(node, name, port)) is None:
            raise
        return found


def main(arguments: list[str] | None = None) -> int:
    """Run the command and return its exit code: 0 signalled, 2 bad usage or no such node."""
    streams.secure()
    try:
        parser = build_parser()
        argcomplete.autocomplete(parser)
        options = parser.parse_args(arguments)
        _signal_node(options)
    except (SignalError, ValueError) as refusal:
        print(f"kill-node: {refusal}", file=sys.stderr)
        return 2
    return 0


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser(prog="kill-node", **help_of(__doc__ or ""))
    add_options(parser, (
        option("node", completer=completion.nodes,
               help="name of the node, for example osmosis_control"),
        option("--signal", default="KILL", type=str.upper, metavar="SIG",
               help="KILL (default), STOP, CONT, TERM, SEGV or WEDGE"),
        PORT, JSON))
    return parser


def _signal_node(options: argparse.Namespace) -> None:
    if options.signal not in SIGNALS:
        raise SignalError(f"--signal {options.signal}: unknown signal; known: {', '.join(SIGNALS)}")
    victim = asyncio.run(signal_anywhere(options.node, options.signal, options.port))
    if options.json:
        print(json.dumps({"node": options.node, "pid": victim.pid, "signal": options.signal,
                          "incarnation": victim.incarnation}))
    else:
        say(f"{options.node} (pid {victim.pid}, incarnation {victim.incarnation}): "
            f"{options.signal}")


async def _signal(node: str, name: str, port: int | None) -> fm.ProcessEvent | None:
    async with connect(port) as session:
        found = await session.latest((topics.NODES,), _TABLE_S)
        table: fm.NodeTable | None = found.get(topics.NODES.key)
        host = next((row.host for row in table.nodes if row.name == node), None) if table else None
        if host is None:
            return None
        order = fm.SignalOrder(f"kill-node-{uuid.uuid4().hex[:10]}", node, name)
        answers: list[fm.ProcessEvent] = []

        def event(_key: str, _header: object, body: fm.ProcessEvent) -> None:
            if body.by == order.order:
                answers.append(body)

        session.listen(topics.PROCESS_EVENT, event)
        if not await session.command(topics.SIGNAL, order, lambda: bool(answers), _ANSWER_S):
            raise SignalError(f"{node}: no answer from the supervisor of host "
                              f"{host or 'the first'} within {_ANSWER_S:g} s")
    [answer, *_] = answers
    if answer.event != "signalled":
        raise SignalError(f"{node}: {answer.detail}")
    return answer


if __name__ == "__main__":
    sys.exit(main())
