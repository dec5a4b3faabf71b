"""Signals to the processes of nodes, found in /proc by their titles.

A node with a command has two processes: its own, and the program. A signal that a user sends to try
the program goes to the program, with all processes of its group.
"""

from __future__ import annotations

import os
import signal
from dataclasses import replace
from pathlib import Path

from rampart.actors.foreign.descendants import descendants
from rampart.actors.machine.unix_peer import stat_fields
from rampart.actors.supervision.process_title import RunProcess, find_processes

SIGNALS = {name: signal.Signals[f"SIG{name}"] for name in ("KILL", "STOP", "CONT", "TERM", "SEGV")}
SIGNALS["WEDGE"] = signal.SIGUSR2

TO_PROGRAM = ("STOP", "CONT", "TERM", "SEGV")
"""Signals that the program of a command gets. Its node's process gets the others: the death of that
ends the program too, and only that can be hung."""


class SignalError(Exception):
    """A node cannot be signalled; the text is one line for the user."""


class UnknownNodeError(SignalError):
    """The node has no process on this machine."""


def signal_node(node: str, name: str, port: int | None = None) -> RunProcess:
    """Send a signal of `SIGNALS` to the newest process of a node, and return the process.

    Args:
        node: Its name, as in the title of the process.
        name: Of the signal, e.g. "KILL".
        port: Base port of the run; None if there is only one.

    Raises:
        SignalError: There is no such node or signal, or sending it is not permitted.
    """
    victim = find_node(node, name, port)
    try:
        send(victim, name)
    except OSError as error:
        raise SignalError(f"{node} (pid {victim.pid}): {error.strerror}") from None
    return victim


def send(victim: RunProcess, name: str) -> None:
    """Send a signal of `SIGNALS` to a process that `find_node` has returned; raises OSError."""
    (os.killpg if victim.is_program else os.kill)(victim.pid, SIGNALS[name])


def find_node(node: str, name: str, port: int | None = None) -> RunProcess:
    """Return the process that `signal_node` would signal.

    Raises:
        SignalError: There is no such node or signal.
    """
    if name not in SIGNALS:
        raise SignalError(f"unknown signal {name!r}; known: {', '.join(SIGNALS)}")
    processes = find_processes(port)
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
    found = max(matches, key=lambda p: p.incarnation)
    program = _program(node, found.pid) if name in TO_PROGRAM else None
    return replace(found, pid=program, is_program=True) if program else found


def _program(node: str, parent: int) -> int | None:
    """Return the program of a node, which leads a process group; None without a command."""
    for pid in sorted(descendants(parent)):
        if stat_fields(pid)[1:3] == [b"%d" % parent, b"%d" % pid]:
            try:
                variables = Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
            except OSError:
                continue
            if f"RAMPART_NODE={node}".encode() in variables:
                return pid
    return None
