"""Checkpoints on disk: each process of a node appends its states to a file of its own.

`NODE.INCARNATION.GENERATION` holds the states from that generation on, one frame each: a mark, the
length, a checksum, and run, node and `Record` in msgpack. A save is one `write`. When it returns
the kernel has the state, and the death of the process does not undo it. A thread then has the disk
confirm it, so a loss of power costs what was saved in the last tenth of a second and one sync; the
actor's loop waits for no disk. (To write beside, sync and rename would hold it up for 6 ms at the
median and 25 ms in one save of a hundred, where a `write` takes 0.03.)

Each file begins with the generations before its first. So when a file is full, or the node has
another process, the thread removes the older files as soon as the new one is on the disk.

No two processes write one file, and what counts as newer is decided by incarnation and generation
alone. A process makes its file when it loads: from then on a state of a lower incarnation counts
only if its generation is lower than that of the file. So a process that was superseded and still
runs can overwrite nothing, and nothing needs a lock.

A reader believes nothing: no file that is not a regular one or is too large, no frame without its
checksum. After damage it looks for the next mark, so that damage costs one generation.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
import stat
import struct
import threading
from pathlib import Path
from typing import NamedTuple

import msgspec

from rampart.actors.ftm.messages import LARGEST_STATE_BYTES
from rampart.actors.runtime.checkpoint import (
    GENERATIONS,
    CheckpointError,
    CheckpointStore,
    Loaded,
    Record,
    SupersededError,
    newest_first,
)

_MARK = b"\x00RPCK\x031\n"
_HEAD = struct.Struct(">8sI16s")

_FULL_BYTES = 128 << 10
"""A file that is longer is followed by another one."""

LARGEST_FILE_BYTES = _FULL_BYTES + (GENERATIONS + 2) * LARGEST_STATE_BYTES
"""More is not read."""

_SYNC_S = 0.1
"""Real seconds between two syncs."""

_END_S = 0.5


class _Frame(msgspec.Struct, frozen=True, array_like=True):
    run: str
    node: str
    record: Record


def _framed(run: str, node: str, record: Record) -> bytes:
    payload = msgspec.msgpack.encode(_Frame(run, node, record))
    return _HEAD.pack(_MARK, len(payload), _checksum(payload)) + payload


def _checksum(payload: bytes) -> bytes:
    return hashlib.blake2b(payload, digest_size=16).digest()


def _frames(data: bytes) -> tuple[list[_Frame], str]:
    """Return the sound frames, and where the first damage is, "" if there is none."""
    found: list[_Frame] = []
    damage, end, start = "", 0, data.find(_MARK)
    while start >= 0:
        frame, after = _frame_at(data, start)
        if frame is None:
            start = data.find(_MARK, start + 1)
            continue
        found.append(frame)
        damage = damage or ("" if start == end else f"damaged at byte {end}")
        end, start = after, data.find(_MARK, after)
    return found, damage or ("" if end == len(data) else f"damaged at byte {end}")


def _frame_at(data: bytes, start: int) -> tuple[_Frame | None, int]:
    begin = start + _HEAD.size
    if begin > len(data):
        return None, start
    _, length, checksum = _HEAD.unpack_from(data, start)
    payload = data[begin:begin + length]
    if len(payload) != length or _checksum(payload) != checksum:
        return None, start
    try:
        return msgspec.msgpack.decode(payload, type=_Frame), begin + length
    except msgspec.DecodeError:
        return None, start


def files_of(folder: Path, node: str) -> dict[tuple[int, int], Path]:
    """Return the files of a node by incarnation and first generation.

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
    """Return what is sound of a node's states of a run, and what is not, one line each.

    Raises:
        OSError: the folder cannot be read.
    """
    records, problems = list[Record](), list[str]()
    old = folder / f"{node}.sqlite"
    if os.path.lexists(old):
        problems.append(f"{old}: a checkpoint of version 0.7 is not read")
    files = files_of(folder, node)
    for _, file in sorted(files.items(), reverse=True):
        try:
            frames, damage = _frames(_content(file))
        except FileNotFoundError:  # a newer one has just replaced it
            return read(folder, node, run)
        except OSError as error:
            problems.append(f"{file}: {error.strerror}")
            continue
        if damage:
            problems.append(f"{file}: {damage}")
        ours = [frame.record for frame in frames if (frame.run, frame.node) == (run, node)]
        if len(ours) < len(frames):
            problems.append(f"{file}: states of another run or node are not taken")
        records += (record for record in ours if not any(
            incarnation > record.incarnation and first <= record.generation
            for incarnation, first in files))
    return Loaded(tuple(newest_first(records)), tuple(problems))


def _content(file: Path) -> bytes:
    descriptor = os.open(file, os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode):
            raise OSError(0, "is not a regular file")
        if found.st_size > LARGEST_FILE_BYTES:
            raise OSError(0, f"{found.st_size} bytes, at most {LARGEST_FILE_BYTES} are read")
        return os.read(descriptor, LARGEST_FILE_BYTES)
    finally:
        os.close(descriptor)


def put(folder: Path, node: str, run: str, record: Record) -> None:
    """Keep a state that a process of the node has kept elsewhere; waits for the disk.

    Raises:
        OSError: it could not be kept.
    """
    folder.mkdir(parents=True, exist_ok=True)
    before = reversed(read(folder, node, run).records[:GENERATIONS - 1])
    file = folder / f"{node}.{record.incarnation}.{record.generation}"
    beside = file.with_name(f"{file.name}~")
    with beside.open("wb") as writing:
        writing.writelines(_framed(run, node, one) for one in (*before, record))
        writing.flush()
        os.fsync(writing.fileno())
    beside.replace(file)
    _sync_folder(folder)
    _remove_older(folder, node, record.age)


class _Open(NamedTuple):
    """The file that is written to, and the age of its first state."""

    file: int
    first: tuple[int, int]


class FileCheckpoints(CheckpointStore):
    """The `CheckpointStore` of one process of a node.

    Args:
        folder: of the run's checkpoints; made when it is needed.
        node: name of the node.
        run: name of the run; states of another run are not taken.
        incarnation: which process of the node this is.
        syncs: whether the disk has to confirm what is saved.
    """

    def __init__(self, folder: Path, node: str, run: str, incarnation: int, *,
                 syncs: bool = True) -> None:
        self._folder = folder
        self._node = node
        self._run = run
        self._incarnation = incarnation
        self._syncs = syncs
        self._generation = 0
        self._before: list[Record] = []
        self._open: _Open | None = None
        self._written: _Open | None = None
        self._retired: list[int] = []
        self._trouble = ""
        self._is_lost = False
        self._wanted = threading.Event()
        self._over = threading.Event()
        self._thread: threading.Thread | None = None

    def load(self) -> Loaded:
        """Return what was kept; see `CheckpointStore`."""
        try:
            loaded = read(self._folder, self._node, self._run)
            newest, _ = max(files_of(self._folder, self._node), default=(0, 0))
        except OSError as error:
            raise CheckpointError(f"{self._folder}: {error.strerror}") from None
        if newest > self._incarnation:
            raise SupersededError(f"{self._folder / self._node}: incarnation "
                                  f"{self._incarnation} was superseded by {newest}")
        if loaded.records:
            self._generation = loaded.records[0].generation
            self._before = list(reversed(loaded.records))
        with contextlib.suppress(OSError):  # the first save reports it
            self._begin(self._generation + 1)
        return loaded

    def save(self, version: int, failures: int, state: bytes) -> None:
        """Keep a state; see `CheckpointStore`."""
        self._generation += 1
        record = Record(self._incarnation, self._generation, version, failures, state)
        try:
            file = self._writable()
            length = os.fstat(file).st_size
            records = [record] if length else [*self._before, record]
            frames = b"".join(_framed(self._run, self._node, one) for one in records)
            if os.write(file, frames) < len(frames):
                os.ftruncate(file, length)
                raise CheckpointError(f"{self._folder / self._node}: no space is left")
        except CheckpointError:
            raise
        except OSError as error:
            raise CheckpointError(f"{self._folder / self._node}: {error.strerror}") from None
        self._before = [*self._before, record][-GENERATIONS:]
        former, self._written = self._written, self._open
        if former is not None and former != self._written:
            self._retired.append(former.file)
        if self._thread is None and self._syncs:
            self._thread = threading.Thread(target=self._work, daemon=True,
                                            name=f"checkpoints {self._node}")
            self._thread.start()
        self._wanted.set()

    def trouble(self) -> str:
        """Return what the syncing thread could not do, or that a file has vanished."""
        trouble, self._trouble = self._trouble, ""
        return trouble

    def close(self) -> None:
        """End the thread and close the file."""
        self._over.set()
        self._wanted.set()
        if self._thread is not None:
            self._thread.join(_END_S)
            if self._thread.is_alive():  # the disk does not answer: the process ends without it
                return
        self._retired += {one.file for one in (self._open, self._written) if one is not None}
        self._open = self._written = None
        self._close_retired()

    def _writable(self) -> int:
        """Return the file for the next state: another one if there is none, or it is of no use.

        Raises:
            OSError: it cannot be made.
        """
        if self._open is not None:
            found = os.fstat(self._open.file)
            if found.st_nlink and found.st_size <= _FULL_BYTES and not self._is_lost:
                return self._open.file
            if not found.st_nlink:
                self._trouble = f"{self._folder / self._node}: the file has vanished; begun again"
        return self._begin(self._generation)

    def _begin(self, generation: int) -> int:
        """Begin the file of the states from a generation on, and return it."""
        self._folder.mkdir(parents=True, exist_ok=True)
        first = self._incarnation, generation
        path = self._folder / f"{self._node}.{first[0]}.{first[1]}"
        file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NONBLOCK
                       | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        if not stat.S_ISREG(os.fstat(file).st_mode):
            os.close(file)
            raise OSError(0, "is not a regular file")
        if self._open is not None and self._open != self._written:
            os.close(self._open.file)
        self._open, self._is_lost = _Open(file, first), False
        return file

    def _close_retired(self) -> None:
        while self._retired:
            os.close(self._retired.pop())

    # -- in the thread --------------------------------------------------------------------------

    def _work(self) -> None:
        synced: _Open | None = None
        while not self._over.is_set():
            self._wanted.wait()
            self._wanted.clear()
            newest = self._written  # not before: the states of the former are not in it yet
            if newest is None:
                continue
            try:
                os.fsync(newest.file)
                if newest != synced:
                    _sync_folder(self._folder)
                    _remove_older(self._folder, self._node, newest.first)
                    self._close_retired()
                    synced = newest
            except OSError as error:
                self._is_lost = True  # how much of the file is on the disk is not known any more
                self._trouble = (f"{self._folder / self._node}: not synced to the disk: "
                                 f"{error.strerror}")
            self._over.wait(_SYNC_S)


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _remove_older(folder: Path, node: str, first: tuple[int, int]) -> None:
    for age, file in files_of(folder, node).items():
        if age < first:
            with contextlib.suppress(OSError):  # what is in the way is not a file of a node
                file.unlink()
