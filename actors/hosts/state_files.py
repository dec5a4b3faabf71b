"""Checkpoint files of nodes that two hosts share: reads new states, keeps those of other hosts.

A thread does both, so the supervisor waits for no disk. It checks names and lengths of the files
fifty times a second, and reads those of a node again when they have changed. Nodes and their saves
are not affected.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable
from pathlib import Path

from rampart.actors.runtime.checkpoint import Record, in_words
from rampart.actors.runtime.checkpoint_file import files_of, put, read

LOOK_S = 0.02
"""Real seconds between two checks of the files."""

_END_S = 0.5


class StateFiles:
    """Files of some nodes. Use: `start`, then the rest, then `close`.

    Args:
        folder: Of the files.
        run: Name of the run.
        nodes: Names of the nodes.
        kept: Called in the thread with a node, its newest state (None if there is none) and whether
            it is the last: when that state has changed, and after `settle`, as the last.
        problem: Called in the thread with a node and one line.
    """

    def __init__(self, folder: Path, run: str, nodes: Iterable[str],
                 kept: Callable[[str, Record | None, bool], None],
                 problem: Callable[[str, str], None]) -> None:
        self._folder = folder
        self._nodes = tuple(nodes)
        self._run = run
        self._kept = kept
        self._problem = problem
        self._lock = threading.Lock()
        self._sent: dict[str, Record] = {}
        self._settling: set[str] = set()
        self._wanted = threading.Event()
        self._is_over = False
        self._seen: dict[str, object] = {}
        self._suspected: dict[str, object] = {}
        self._newest: dict[str, Record | None] = {}
        self._reported: dict[str, str] = {}
        self._thread = threading.Thread(target=self._work, name="states of nodes", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def take(self, node: str, record: Record) -> None:
        """Keep a state that another host has sent, unless there is a newer one."""
        with self._lock:
            waiting = self._sent.get(node)
            if waiting is None or record.age > waiting.age:
                self._sent[node] = record
        self._wanted.set()

    def settle(self, node: str) -> None:
        """Read a node's files in any case: no process of it is left."""
        with self._lock:
            self._settling.add(node)
        self._wanted.set()

    def close(self) -> None:
        """End the thread."""
        self._is_over = True
        self._wanted.set()
        if self._thread.is_alive():
            self._thread.join(_END_S)

    # -- in the thread --------------------------------------------------------------------------

    def _work(self) -> None:
        while not self._is_over:
            with self._lock:
                sent, self._sent = self._sent, {}
                settling, self._settling = self._settling, set()
            for node in self._nodes:
                if node in sent:
                    self._keep(node, sent[node])
                self._look(node, settles=node in settling)
            self._wanted.wait(LOOK_S)
            self._wanted.clear()

    def _look(self, node: str, *, settles: bool) -> None:
        try:
            trace = {file: os.lstat(file).st_size for file in files_of(self._folder, node).values()}
            if trace == self._seen.get(node) and not settles:
                return
            records, problems = read(self._folder, node, self._run)
        except FileNotFoundError:  # another file has just replaced it
            if settles:
                self.settle(node)
            return
        except OSError as error:
            self._report(node, in_words(error))
            if settles:
                self._kept(node, None, True)
            return
        if problems and trace != self._suspected.get(node) and not settles:
            self._suspected[node] = trace  # it may be half written: read it once more
            return
        self._seen[node] = trace
        self._report(node, "; ".join(problems))
        newest = records[0] if records else None
        if newest != self._newest.get(node) or settles:
            self._newest[node] = newest
            self._kept(node, newest, settles)

    def _report(self, node: str, why: str) -> None:
        if why and why != self._reported.get(node):
            self._problem(node, f"cannot be read for another host: {why}")
        self._reported[node] = why

    def _keep(self, node: str, record: Record) -> None:
        try:
            newest = read(self._folder, node, self._run).records
            if not newest or record.age > newest[0].age:
                put(self._folder, node, self._run, record)
        except OSError as error:
            self._problem(node, f"a state of another host is not kept: {in_words(error)}")
