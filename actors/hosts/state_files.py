"""The files of states that two hosts hold: sees what nodes keep here, and keeps what is sent.

A thread of its own does both, so that the supervisor waits for no disk. It looks at each file's
time and size fifty times a second and reads one that has changed; nodes do not know of it, and
their saves wait for nothing. It reads as whoever opens a file for the first time does, believing
nothing; what is damaged is the node's own process to mend.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path

from rampart.actors.runtime.checkpoint import CheckpointError, Record, SupersededError
from rampart.actors.runtime.checkpoint_file import beside, is_damage, primary_code, words
from rampart.actors.runtime.checkpoint_store import LOCKED, SqliteCheckpoints, newest

LOOK_S = 0.02
"""Real seconds between two looks at the files."""

_SETTLED_S = 0.05
"""A file that has changed within so many seconds before it was read may have changed since, without
its time or size telling: it is read once more."""

_END_S = 0.5

_Trace = tuple[tuple[int, int, int], ...]


class StateFiles:
    """The files of some nodes. Use: `start`, then the rest, then `close`.

    Args:
        folder: of the files.
        run: name of the run.
        nodes: their names.
        kept: called in the thread with a node and the newest state of it, None if there is none:
            when that has changed, and after `settle`, then with True.
        problem: called in the thread with a node and one line on what went wrong.
    """

    def __init__(self, folder: Path, run: str, nodes: Iterable[str],
                 kept: Callable[[str, Record | None, bool], None],
                 problem: Callable[[str, str], None]) -> None:
        self._files = {node: folder / f"{node}.sqlite" for node in nodes}
        self._run = run
        self._kept = kept
        self._problem = problem
        self._lock = threading.Lock()
        self._sent: dict[str, Record] = {}
        self._settling: set[str] = set()
        self._wanted = threading.Event()
        self._is_over = False
        self._seen: dict[str, _Trace] = {}
        self._told: dict[str, tuple[int, int]] = {}
        self._why_not: dict[str, str] = {}
        self._stores: dict[str, tuple[int, SqliteCheckpoints]] = {}
        self._thread = threading.Thread(target=self._work, name="states of nodes", daemon=True)

    def start(self) -> None:
        """Begin to look."""
        self._thread.start()

    def take(self, node: str, record: Record) -> None:
        """Keep a state that was sent, unless there is a newer one."""
        with self._lock:
            waiting = self._sent.get(node)
            if waiting is None or record.age > waiting.age:
                self._sent[node] = record
        self._wanted.set()

    def settle(self, node: str) -> None:
        """Look at a file in any case: no process of the node is there any more."""
        with self._lock:
            self._settling.add(node)
        self._wanted.set()

    def close(self) -> None:
        """End the thread, and close what it has open."""
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
            for node, record in sent.items():
                self._keep(node, record)
            for node in self._files:
                self._look(node, settles=node in settling)
            self._wanted.wait(LOOK_S)
            self._wanted.clear()
        for _, store in self._stores.values():
            store.close()

    def _look(self, node: str, *, settles: bool = False) -> None:
        file, read_s = self._files[node], time.time()
        trace = _trace(file)
        if trace == self._seen.get(node) and not settles:
            return
        try:
            record = newest(file, self._run)
        except Exception as error:  # whatever lies there
            is_passing = not is_damage(error, file)
            if is_passing and settles:
                with self._lock:
                    self._settling.add(node)
            if primary_code(error) in LOCKED:  # in this moment
                return
            if words(error) != self._why_not.get(node):
                self._why_not[node] = words(error)
                self._problem(node, f"{file.name} cannot be read for another host: {words(error)}")
            if not is_passing:
                self._seen[node] = trace
                if settles:
                    self._kept(node, None, True)
            return
        self._why_not.pop(node, None)
        changed_s = max((time_ns for _, _, time_ns in trace), default=0) / 1e9
        if not 0 <= read_s - changed_s <= _SETTLED_S:
            self._seen[node] = trace
        age = record.age if record else (0, 0)
        if age != self._told.get(node, (0, 0)) or settles:
            self._told[node] = age
            self._kept(node, record, settles)

    def _keep(self, node: str, record: Record) -> None:
        incarnation, store = self._stores.get(node, (-1, None))
        if store is None or incarnation != record.incarnation:
            if store is not None:
                store.close()
            store = SqliteCheckpoints(self._files[node], self._run, record.incarnation)
            self._stores[node] = record.incarnation, store
        try:
            store.take(record)
        except SupersededError:
            pass  # there is a newer one
        except CheckpointError as error:
            self._problem(node, f"a state of another host is not kept: {error}")
        if trouble := store.trouble():
            self._problem(node, trouble)


def _trace(file: Path) -> _Trace:
    """Return by what one knows that a file has changed, or its log."""
    found = []
    for path in (file, beside(file, "-wal")):
        try:
            stat = path.lstat()
        except OSError:
            continue
        found.append((stat.st_ino, stat.st_size, stat.st_mtime_ns))
    return tuple(found)
