"""The last messages of a run, in files that a killed process and a loss of power leave readable.

A ring is a folder of segments. A segment is a sequence of blocks, each with its length, checksum,
the times of its first and last message, and the clock that gives them. `sync` writes one block and
waits for the disk, so a loss of power costs the messages since the last `sync`. Messages are kept
in the frames in which nodes hand them over, which costs little processor time; `read` parses them.
"""

from __future__ import annotations

import contextlib
import math
import os
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import lz4.frame

from rampart.actors.bus.recorder_connection import parse_frame
from rampart.files.writing import sync

SEGMENT_S = 10.0
"""Simulated seconds of a segment."""

_HEAD = struct.Struct("<IIdddd")
_LENGTH = struct.Struct("<I")
_SUFFIX = ".ring"
_LARGEST_BYTES = 64 << 20
"""Largest block that is read, compressed or not."""


class Span(NamedTuple):
    """Times of the first and last message, simulated seconds; reversed if there is none."""

    first_s: float = math.inf
    last_s: float = -math.inf

    def with_all(self, others: Iterator[Span]) -> Span:
        """Return the span that includes others."""
        spans = (self, *others)
        return Span(min(span.first_s for span in spans), max(span.last_s for span in spans))


class Ring:
    """Writes a ring, and continues the one in the folder.

    Args:
        folder: existing folder.
        segment_bytes: size at which a segment ends before its time.
        origin_s: start of simulated time, monotonic seconds.
        rate: simulated seconds per real second.

    Raises:
        OSError: the folder cannot be read.
    """

    def __init__(self, folder: Path, segment_bytes: int = 0, origin_s: float = 0.0,
                 rate: float = 1.0) -> None:
        self._folder = folder
        self._segment_bytes = segment_bytes
        self._clock = origin_s, rate
        self._spans = {path: _span(path) for path in segments(folder)}
        self._file: BinaryIO | None = None
        self._path = folder
        self._waiting = bytearray()
        self._now = Span()

    def add(self, at_s: float, frame: bytes) -> None:
        """Add the frame of a message that was sent at a simulated time."""
        self._waiting += _LENGTH.pack(len(frame)) + frame
        self._now = Span(min(self._now.first_s, at_s), max(self._now.last_s, at_s))
        if len(self._waiting) > self._segment_bytes:
            self.sync()

    def sync(self) -> None:
        """Write the new messages and wait until they are on the disk.

        Raises:
            OSError: they cannot be written.
        """
        if not self._waiting:
            return
        packed = lz4.frame.compress(self._waiting)
        self._waiting.clear()
        now, self._now = self._now, Span()
        if self._file is None:
            number = int(max(self._spans).stem) + 1 if self._spans else 1
            self._path = self._folder / f"{number:010d}{_SUFFIX}"
            self._file = self._path.open("xb")
            self._spans[self._path] = now
            sync(self._folder)
        self._file.write(_HEAD.pack(len(packed), zlib.crc32(packed), *now, *self._clock) + packed)
        self._file.flush()
        os.fdatasync(self._file.fileno())
        span = self._spans[self._path] = now.with_all(iter([self._spans[self._path]]))
        if span.last_s - span.first_s >= SEGMENT_S or self._file.tell() > self._segment_bytes:
            self.close()

    def keep(self, wanted: Callable[[Span], bool]) -> None:
        """Delete the segments that are not wanted, except the one that is being written."""
        for path, span in list(self._spans.items()):
            if not wanted(span) and (self._file is None or path != self._path):
                self._delete(path)

    def drop_oldest(self) -> bool:
        """Delete the oldest segment that is not being written; return whether there was one."""
        path = min(self._spans, default=None)
        if path is None or (self._file is not None and path == self._path):
            return False
        self._delete(path)
        return True

    def close(self) -> None:
        """Close the present segment."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _delete(self, path: Path) -> None:
        path.unlink(missing_ok=True)
        del self._spans[path]


def segments(folder: Path) -> list[Path]:
    """Return the segments of a ring, oldest first."""
    return sorted(path for path in folder.glob(f"*{_SUFFIX}") if path.stem.isdecimal())


def span_of(folder: Path) -> Span:
    """Return the times of the first and last message of a ring."""
    return Span().with_all(map(_span, segments(folder)))


def read(folder: Path, from_s: float, to_s: float) -> Iterator[tuple[float, str, bytes]]:
    """Yield time, key and payload of the messages within a time; damaged blocks are left out.

    The messages of a block are in the order of their times.
    """
    for path in segments(folder):
        for span, (origin_s, rate), packed in _blocks(path):
            if span.last_s < from_s or span.first_s > to_s:
                continue
            messages = [((sent_s - origin_s) * rate, key, payload)
                        for sent_s, key, payload in _frames(packed)]
            messages.sort(key=lambda message: message[0])
            yield from (message for message in messages if from_s <= message[0] <= to_s)


def _frames(packed: bytes) -> Iterator[tuple[float, str, bytes]]:
    try:
        data = memoryview(lz4.frame.decompress(packed))
    except RuntimeError:
        return
    at = 0
    while at + _LENGTH.size <= len(data):
        [length] = _LENGTH.unpack_from(data, at)
        at += _LENGTH.size + length
        with contextlib.suppress(ValueError):  # not from a node
            yield parse_frame(data[at - length:at])


def _span(path: Path) -> Span:
    return Span().with_all(span for span, _, _ in _blocks(path))


def _blocks(path: Path) -> Iterator[tuple[Span, tuple[float, float], bytes]]:
    """Yield span, clock and content of each sound block, up to the first that is cut off."""
    with path.open("rb") as file:
        while len(head := file.read(_HEAD.size)) == _HEAD.size:
            length, checksum, first_s, last_s, origin_s, rate = _HEAD.unpack(head)
            packed = file.read(min(length, _LARGEST_BYTES))
            if len(packed) != length:
                return
            if zlib.crc32(packed) == checksum:
                yield Span(first_s, last_s), (origin_s, rate), packed
