"""What the processes of the run use, for the page: those of the nodes, and their guards.

The nodes' pids come from the supervisor's table. Supervisor, spawners and launcher are in no
table, for the supervisor would have to be well to say that it is not; they are found by their
titles in /proc. Everything is looked at only while a page is open.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rampart.actors.ftm.messages import NodeTable
from rampart.actors.machine.process_usage import ProcessUsage, UsageMeter
from rampart.actors.supervision.process_title import RunProcess, find_processes, process_state

SEARCH_EVERY = 5
"""Looks between two searches of /proc for the guards: a search reads a file of every process."""

MAX_NODES = 200
"""So many rows of a table are looked up in /proc; the page shows no more."""

GUARD_KIND = "supervision"
LAUNCHER = "launch.py"
_STATES = {"T": "stopped", "t": "stopped", "Z": "crashed", "X": "crashed"}


class ProcessObserver:
    """Looks at the processes of one run.

    Args:
        port: base port of the run; 0 if there is none, then only nodes are looked at.
        launcher: pid of its launcher.
        host: name of this machine among those of the run.
        meter: counts what they use.
        find: finds the processes of a run by its port.
        state: the kernel's state letter of a process, "X" if there is none.
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
        """Return what each node and guard uses; to be called about once a second.

        Returns:
            `nodes`: usage by node name, of those whose process exists. `guards`: a row for each
            process that is in no table: name, kind, pid, state, incarnation, restarts, and
            whether it can be sent signals by its name. The usage of a guard is among the nodes'.
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
        # Without a table it is not known which are guards: search again at the next look.
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
    """Return per name: percent of a core, megabytes resident, age in real seconds."""
    return {
        name: {"cpu": round(100 * used.cpu_share, 1), "mb": round(used.memory_bytes / 1e6, 1),
               "age_s": round(used.age_s)}
        for name, pid in pids.items() if (used := usage.get(pid)) is not None}
