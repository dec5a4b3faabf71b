"""The newest messages of the nodes of a host, where others of that host look when they need them.

A message that is sent costs 0.2 to 0.3 ms of a processor for each reader, nearly all of it wake-ups
on the way: of the sender's Zenoh, the router's, the reader's, and of the reader. Most messages of a
robot that is well repeat the one before, to show that their sender works. Such a message is posted:
it is written to a file in the folder of the run, and a reader looks there before it draws a
conclusion from silence. To write and to read takes some microseconds and wakes no process.

A posting has a checksum. One that is damaged, cut short by the death of its writer, or not a file,
counts as none: its node is silent.
"""

from __future__ import annotations

import os
import struct
import zlib
from typing import Protocol

_HEAD = struct.Struct("<II")

MOST_BYTES = 60_000
"""A longer message is not posted, but sent."""

_READ = os.O_RDONLY | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC
_WRITE = os.O_WRONLY | os.O_CREAT | os.O_NONBLOCK | os.O_NOFOLLOW | os.O_CLOEXEC


class Board(Protocol):
    """Postings by key: of each the newest."""

    def post(self, key: str, payload: bytes) -> bool:
        """Post a message in the place of the one before; False if that cannot be done."""

    def read(self, key: str) -> bytes | None:
        """Return what is posted, None if nothing is, or nothing whole."""


class MemoryBoard:
    """The board of a system in one process."""

    def __init__(self) -> None:
        self._payloads: dict[str, bytes] = {}

    def post(self, key: str, payload: bytes) -> bool:
        """Post a message."""
        self._payloads[key] = payload
        return True

    def read(self, key: str) -> bytes | None:
        """Return what is posted."""
        return self._payloads.get(key)


class FileBoard:
    """One process's access to the board of a run.

    Args:
        folder: with a file for each posting. Only the user of the run can enter it.
    """

    def __init__(self, folder: str) -> None:
        self._folder = folder
        self._files: dict[str, int] = {}
        self._read: dict[str, int] = {}  # kept open: a reader without descriptors still reads

    def _path(self, key: str) -> str:
        return f"{self._folder}/{key.replace('/', ':')}"

    def post(self, key: str, payload: bytes) -> bool:
        """Post a message; False if it is too long, or its file cannot be written."""
        if len(payload) > MOST_BYTES:
            return False
        data = _HEAD.pack(len(payload), zlib.crc32(payload)) + payload
        try:
            file = self._files.get(key)
            if file is None:
                file = self._files[key] = os.open(self._path(key), _WRITE, 0o600)
            return os.pwrite(file, data, 0) == len(data)
        except OSError:  # the run is over, or there is no room
            return False

    def read(self, key: str) -> bytes | None:
        """Return what is posted, unless it is damaged or being written in this moment."""
        try:
            file = self._read.get(key)
            if file is None:
                file = self._read[key] = os.open(self._path(key), _READ)
            data = os.pread(file, _HEAD.size + MOST_BYTES, 0)
        except OSError:  # there is none yet, or it is nothing that is read
            return None
        if len(data) < _HEAD.size:
            return None
        length, checksum = _HEAD.unpack_from(data)
        payload = data[_HEAD.size:_HEAD.size + length]
        is_whole = 0 < len(payload) == length and zlib.crc32(payload) == checksum
        return payload if is_whole else None
