"""The last messages of a run, in files that a killed process and a loss of power leave readable.

A ring is a folder of segments. A segment is a sequence of blocks, each with its length, checksum,
and the times of its first and last message. `sync` writes one block and waits for the disk, so a
loss of power costs the messages since the last `sync`. Messages are kept as they were sent, which
is several times cheaper than to decode them for a recording.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import lz4.frame

from rampart.actors.bus.recorder_connection import frame, parse_frame

SEGMENT_S = 10.0
"""Simulated seconds of a segment."""

_HEAD = struct.Struct("<IIdd")
_LENGTH = struct.Struct("<I")
_SUFFIX = ".ring"
_LARGEST_BYTES = 64 << 20
"""Largest block that is read, compressed or not."""


class Segment(NamedTuple):
    """A file of a ring, and the time of its last message, simulated seconds."""

    path: Path
    last_s: float


class Ring:
    """Writes a ring, and continues the one in the folder.

    Args:
        folder: existing folder.
        segment_bytes: size at which a segment ends before its time.

    Raises:
        OSError: the folder cannot be read.
    """

    def __init__(self, folder: Path, segment_bytes: int) -> None:
        self._folder = folder
        self._segment_bytes = segment_bytes
        self._segments: deque[Segment] = deque(
            Segment(path, max((last_s for _, last_s, _ in _blocks(path)), default=-1e9))
            for path in segments(folder))
        self._file: BinaryIO | None = None
        self._first_s = 0.0
        self._waiting = bytearray()
        self._times: list[float] = []

    def add(self, at_s: float, key: str, payload: bytes) -> None:
        """Add a message that was sent at a simulated time."""
        data = frame(at_s, key, payload)
        self._waiting += _LENGTH.pack(len(data)) + data
        self._times.append(at_s)
        if len(self._waiting) > self._segment_bytes:
            self.sync()

    def sync(self) -> None:
        """Write the new messages and wait until they are on the disk.

        Raises:
            OSError: they cannot be written.
        """
        if not self._times:
            return
        first_s, last_s = min(self._times), max(self._times)
        packed = lz4.frame.compress(bytes(self._waiting))
        self._waiting.clear()
        self._times.clear()
        if self._file is None:
            number = int(self._segments[-1].path.stem) + 1 if self._segments else 1
            path = self._folder / f"{number:010d}{_SUFFIX}"
            self._file, self._first_s = path.open("xb"), first_s
            self._segments.append(Segment(path, last_s))
            _sync_folder(self._folder)
        self._file.write(_HEAD.pack(len(packed), zlib.crc32(packed), first_s, last_s) + packed)
        self._file.flush()
        os.fdatasync(self._file.fileno())
        self._segments[-1] = self._segments[-1]._replace(last_s=last_s)
        if last_s - self._first_s >= SEGMENT_S or self._file.tell() > self._segment_bytes:
            self.close()

    def drop(self, before_s: float) -> None:
        """Delete the segments whose messages are all before a time."""
        while self._segments and self._segments[0].last_s < before_s and (
                len(self._segments) > 1 or self._file is None):
            self._segments.popleft().path.unlink(missing_ok=True)

    def drop_oldest(self) -> bool:
        """Delete the oldest segment that is not being written; return whether there was one."""
        if len(self._segments) < (2 if self._file else 1):
            return False
        self._segments.popleft().path.unlink(missing_ok=True)
        return True

    def close(self) -> None:
        """Close the present segment."""
        if self._file is not None:
            self._file.close()
            self._file = None


def segments(folder: Path) -> list[Path]:
    """Return the segments of a ring, oldest first."""
    return sorted(path for path in folder.glob(f"*{_SUFFIX}") if path.stem.isdecimal())


def ends(folder: Path) -> tuple[float, float] | None:
    """Return the times of the first and last message, simulated seconds; None of an empty ring."""
    times = [(first_s, last_s) for path in segments(folder) for first_s, last_s, _ in _blocks(path)]
    return (min(first for first, _ in times), max(last for _, last in times)) if times else None


def read(folder: Path, from_s: float, to_s: float) -> Iterator[tuple[float, str, bytes]]:
    """Yield time, key and payload of the messages within a time; damaged blocks are left out."""
    for path in segments(folder):
        for first_s, last_s, packed in _blocks(path):
            if last_s < from_s or first_s > to_s:
                continue
            try:
                data = memoryview(lz4.frame.decompress(packed))
            except RuntimeError:
                continue
            at = 0
            while at + _LENGTH.size <= len(data):
                [length] = _LENGTH.unpack_from(data, at)
                at += _LENGTH.size + length
                found = parse_frame(data[at - length:at])
                if from_s <= found[0] <= to_s:
                    yield found


def _blocks(path: Path) -> Iterator[tuple[float, float, bytes]]:
    """Yield the times and the content of each sound block, up to the first that is cut off."""
    with path.open("rb") as file:
        while len(head := file.read(_HEAD.size)) == _HEAD.size:
            length, checksum, first_s, last_s = _HEAD.unpack(head)
            packed = file.read(min(length, _LARGEST_BYTES))
            if len(packed) != length:
                return
            if zlib.crc32(packed) == checksum:
                yield first_s, last_s, packed


def _sync_folder(folder: Path) -> None:
    opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)
