"""Usage of the processes of a run, for the page: nodes, and processes of the supervision.

The nodes' pids come from the supervisor's table. Supervisor, routers and launcher are found by
their titles in /proc, so that the page shows them even if the supervisor fails. Everything is
measured only while a page is open.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rampart.actors.ftm.messages import NodeTable
from rampart.actors.machine.process_usage import ProcessUsage, UsageMeter
from rampart.actors.supervision.process_title import RunProcess, find_processes, process_state

SEARCH_EVERY = 5
"""Looks between two searches of /proc, which read a file of every process."""

MAX_NODES = 200
"""Most rows of the table that are measured; the page shows no more."""

GUARD_KIND = "supervision"
LAUNCHER = "launch.py"
_STATES = {"T": "stopped", "t": "stopped", "Z": "crashed", "X": "crashed"}


class ProcessObserver:
    """Measures the processes of one run.

    Args:
        port: base port of the run; 0 for nodes only.
        launcher: pid of its launcher.
        host: name of this machine among the hosts of the run.
        meter: measures usage.
        find: returns the processes of a run by its port.
        state: returns the kernel's state letter of a process, "X" if it does not exist.
    """

    def __init__(self, port: int, launcher: int, host: str = "", *,
                 meter: UsageMeter | None = None,
                 find: Callable[[int], Sequence[RunProcess]] = find_processes,
                 state: Callable[[int], str] = process_state) -> None:
        self._port = port
        self._launcher = launcher
        self._host = host
        self._meter = meter or UsageMeter()
        self._find = find
        self._state = state
        self._looks = 0
        self._guards: dict[str, tuple[int, int]] = {}

    def look(self, table: NodeTable | None) -> dict[str, Any]:
        """Return the usage of each process; call it about once a second.

        Returns:
            `nodes`: usage by name, of nodes and guards whose process exists. `guards`: a row for
            each process of the supervision: name, kind, pid, state, incarnation, restarts, and
            whether it can be signalled by name.
        """
        nodes = [node for node in (table.nodes[:MAX_NODES] if table else ())
                 if node.host == self._host]
        known = {node.name for node in nodes}
        if self._port and self._looks % SEARCH_EVERY == 0:
            found = self._find(self._port) if nodes else ()
            self._guards = {
                "+".join(p.names): (p.pid, p.incarnation) for p in found
                if p.launcher == self._launcher and known.isdisjoint(p.names)}
            self._guards |= {LAUNCHER: (self._launcher, 1)} if self._launcher else {}
        # Without a table guards cannot be told from nodes: search again at the next look.
        self._looks = self._looks + 1 if nodes else 0
        pids = {node.name: node.pid for node in nodes} | {
            name: pid for name, (pid, _) in self._guards.items()}
        usage = self._meter.look(set(pids.values()))
        return {"nodes": figures(pids, usage), "guards": [
            {"name": name, "kind": GUARD_KIND, "pid": pid, "incarnation": incarnation,
             "state": _STATES.get(self._state(pid), "running"),
             "restarts": max(0, incarnation - 1), "signals": name != LAUNCHER}
            for name, (pid, incarnation) in sorted(self._guards.items())]}


def figures(pids: Mapping[str, int], usage: Mapping[int, ProcessUsage]) -> dict[str, Any]:
    """Return by name: percent of a core, resident megabytes, age in real seconds."""
    return {
        name: {"cpu": round(100 * used.cpu_share, 1), "mb": round(used.memory_bytes / 1e6, 1),
               "age_s": round(used.age_s)}
        for name, pid in pids.items() if (used := usage.get(pid)) is not None}
