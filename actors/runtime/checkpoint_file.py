"""Checkpoints on disk: each state of a node is one small file.

`NODE.INCARNATION.GENERATION` holds a checksum, then run, node and `Record` in msgpack. A save
writes it beside its place and renames it. When `save` returns, the kernel has the state, so it
survives the process. A thread has the disk confirm the newest state, at most ten times a second,
and removes older ones. A loss of power costs the last tenth of a second and one sync. The actor's
loop does not wait for the disk: `fsync` takes 6 ms at the median, and a disk that hangs never
answers.

Incarnation, then generation, decides which state is newer. No two processes write one file, so
nothing needs a lock. A process that loads claims the next generation with a record without state.
From then on a state of a lower incarnation counts only if its generation is lower: a superseded
process that still runs overwrites nothing.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
import re
import threading
from pathlib import Path

import msgspec

from rampart.actors.ftm.messages import LARGEST_STATE_BYTES
from rampart.actors.runtime.checkpoint import (
    GENERATIONS,
    CheckpointError,
    CheckpointStore,
    Loaded,
    Record,
    SupersededError,
)
from rampart.files.writing import sync

_CHECKSUM_BYTES = 16
_LARGEST_FILE_BYTES = LARGEST_STATE_BYTES + 4096

_SYNC_S = 0.1
"""Real seconds between two syncs."""

_END_S = 0.5
"""Real seconds that `close` waits for a sync."""


def files_of(folder: Path, node: str) -> dict[tuple[int, int], Path]:
    """Return the files of a node by incarnation and generation.

    Raises:
        OSError: the folder cannot be read.
    """
    name = re.compile(re.escape(node) + r"\.(\d{1,18})\.(\d{1,18})")
    try:
        found = [name.fullmatch(entry) for entry in os.listdir(folder)]  # noqa: PTH208 names only
    except FileNotFoundError:
        return {}
    return {(int(match[1]), int(match[2])): folder / match[0] for match in found if match}


def read(folder: Path, node: str, run: str) -> Loaded:
    """Return the sound states of a node in a run, newest first, and one line for each damage.

    Raises:
        OSError: the folder cannot be read.
    """
    records, problems = _records(folder, node, run)
    return Loaded(_states(records), tuple(problems))


def put(folder: Path, node: str, run: str, record: Record) -> None:
    """Keep a state that another host has sent; waits for the disk.

    Raises:
        OSError: the state could not be kept.
    """
    _write(folder, node, run, record)
    _confirm(folder, node, run, record.age)


def _records(folder: Path, node: str, run: str) -> tuple[list[Record], list[str]]:
    """Return the newest states and the last claim of a run, newest first, and the damage."""
    records, problems, lowest = list[Record](), list[str](), math.inf
    for (_, generation), file in sorted(files_of(folder, node).items(), reverse=True):
        if generation >= lowest:  # saved by a process that was superseded
            continue
        try:
            owner, record = _content(file)
        except FileNotFoundError:  # a newer state has just replaced it
            return _records(folder, node, run)
        except OSError as error:
            problems.append(f"{file}: {error.strerror}")
            continue
        if owner != (run, node):
            problems.append(f"{file}: a state of another run or node is not taken")
            continue
        records.append(record)
        lowest = generation
        if len(records) > GENERATIONS:
            break
    return records, problems


def _states(records: list[Record]) -> tuple[Record, ...]:
    return tuple(record for record in records if record.state)[:GENERATIONS]


def _content(file: Path) -> tuple[tuple[str, str], Record]:
    """Return run and node of a file, and its record."""
    with open(file, "rb", opener=_open_at_once) as opened:
        data = opened.read(_LARGEST_FILE_BYTES)
    payload = data[_CHECKSUM_BYTES:]
    if data[:_CHECKSUM_BYTES] != _checksum(payload):
        raise OSError(0, "damaged")
    return msgspec.msgpack.decode(payload, type=tuple[tuple[str, str], Record])


def _open_at_once(path: str, flags: int) -> int:
    """Open a file, without waiting for the writer of a FIFO."""
    return os.open(path, flags | os.O_NONBLOCK | os.O_NOFOLLOW)


def _checksum(payload: bytes) -> bytes:
    return hashlib.blake2b(payload, digest_size=_CHECKSUM_BYTES).digest()


def _write(folder: Path, node: str, run: str, record: Record) -> None:
    payload = msgspec.msgpack.encode(((run, node), record))
    beside = folder / f"{node}.{record.incarnation}~"
    folder.mkdir(parents=True, exist_ok=True)
    beside.write_bytes(_checksum(payload) + payload)
    beside.replace(_place(folder, node, record.age))


def _place(folder: Path, node: str, age: tuple[int, int]) -> Path:
    return folder / f"{node}.{age[0]}.{age[1]}"


def _confirm(folder: Path, node: str, run: str, age: tuple[int, int]) -> None:
    """Have the disk confirm a state, then remove the older ones that are no longer needed."""
    for path in (_place(folder, node, age), folder):
        sync(path)
    kept = {record.age for record in read(folder, node, run).records}
    for other, file in files_of(folder, node).items():
        if other < age and other not in kept:
            with contextlib.suppress(OSError):  # a directory in the place of a file
                file.unlink()


class FileCheckpoints(CheckpointStore):
    """The `CheckpointStore` of one process of a node.

    Args:
        folder: directory of the run's checkpoints; made when it is needed.
        node: name of the node.
        run: name of the run; states of another run are not taken.
        incarnation: number of this process of the node.
        syncs: whether the disk confirms the states.
    """

    def __init__(self, folder: Path, node: str, run: str, incarnation: int, *,
                 syncs: bool = True) -> None:
        self._folder = folder
        self._node = node
        self._run = run
        self._incarnation = incarnation
        self._syncs = syncs
        self._generation = 0
        self._saved = 0
        self._trouble = ""
        self._wanted = threading.Event()
        self._over = threading.Event()
        self._thread: threading.Thread | None = None

    def load(self) -> Loaded:
        """Return the states that are there, and claim the next generation."""
        try:
            records, problems = _records(self._folder, self._node, self._run)
        except OSError as error:
            raise CheckpointError(f"{self._folder}: {error.strerror}") from None
        if records and records[0].incarnation > self._incarnation:
            raise SupersededError(f"{self._folder / self._node}: incarnation {self._incarnation} "
                                  f"was superseded by {records[0].incarnation}")
        states = _states(records)
        self._generation = states[0].generation if states else 0
        with contextlib.suppress(OSError):  # the first save reports it
            _write(self._folder, self._node, self._run,
                   Record(self._incarnation, self._generation + 1, 0, 0, b""))
        return Loaded(states, tuple(problems))

    def save(self, version: int, failures: int, state: bytes) -> None:
        """Keep a state; see `CheckpointStore`."""
        self._generation += 1
        try:
            _write(self._folder, self._node, self._run,
                   Record(self._incarnation, self._generation, version, failures, state))
        except OSError as error:
            raise CheckpointError(f"{self._folder / self._node}: {error.strerror}") from None
        self._saved = self._generation
        if self._thread is None and self._syncs:
            self._thread = threading.Thread(target=self._sync, daemon=True,
                                            name=f"checkpoints {self._node}")
            self._thread.start()
        self._wanted.set()

    def trouble(self) -> str:
        """Return why the disk did not confirm a state."""
        trouble, self._trouble = self._trouble, ""
        return trouble

    def close(self) -> None:
        """End the thread, or leave it behind if the disk does not answer."""
        self._over.set()
        self._wanted.set()
        if self._thread is not None:
            self._thread.join(_END_S)

    def _sync(self) -> None:
        """Runs in the thread."""
        while not self._over.is_set():
            self._wanted.wait()
            self._wanted.clear()
            try:
                _confirm(self._folder, self._node, self._run, (self._incarnation, self._saved))
            except OSError as error:
                self._trouble = (f"{self._folder / self._node}: not synced to the disk: "
                                 f"{error.strerror}")
            self._over.wait(_SYNC_S)
