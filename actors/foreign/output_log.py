"""The log of a program's output: a file of bounded size and rate, and the file before it."""

from __future__ import annotations

import contextlib
import os
import time
from pathlib import Path

LOG_BYTES = 5_000_000
LOG_BYTES_PER_S = 1_000_000
BURST_BYTES = 2_000_000
"""Bytes that may come at once, before `LOG_BYTES_PER_S` applies."""

_NOTE_BYTES = 2000


class OutputLog:
    """A file of bounded size, and the file before it as `FILE.1`. A failing disk raises nothing.

    Args:
        path: Of the file.
        most: Bytes in it.
    """

    def __init__(self, path: Path, most: int = LOG_BYTES) -> None:
        self._path = path
        self._most = most
        self._file = -1
        self._size = 0
        self._left_out = 0
        self._room = float(BURST_BYTES)
        self._at_s = time.monotonic()

    def write(self, data: bytes) -> None:
        """Write output; count it instead if there is too much."""
        now_s = time.monotonic()
        self._room = min(self._room + (now_s - self._at_s) * LOG_BYTES_PER_S, float(BURST_BYTES))
        self._at_s = now_s
        if len(data) > self._room:
            self._left_out += len(data)
            return
        self._room -= len(data)
        if self._left_out and self._put(f"\n--- {self._left_out} bytes are left out\n".encode()):
            self._left_out = 0
        if not self._put(data):
            self._left_out += len(data)

    def note(self, text: str) -> None:
        """Write a line that the program has not printed, at any rate."""
        self._room = max(self._room, float(_NOTE_BYTES))
        when = time.strftime("%Y-%m-%d %H:%M:%S")
        self.write(f"--- {when} {text}\n".encode(errors="replace")[:_NOTE_BYTES])

    def close(self) -> None:
        """Close the file."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def _put(self, data: bytes) -> bool:
        try:
            if self._file < 0 or self._size + len(data) > self._most:
                self._open()
            self._size += os.write(self._file, data)
        except OSError:
            return False
        return True

    def _open(self) -> None:
        """Open the file, or the next one. A reader finds a file of that name at any time."""
        is_full = self._file >= 0
        self.close()
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC
        self._file = os.open(self._path, flags, 0o600)
        self._size = os.fstat(self._file).st_size
        if not is_full and self._size <= self._most // 2:
            return
        self.close()
        fresh, before = Path(f"{self._path}~"), Path(f"{self._path}.1")
        self._file = os.open(fresh, flags | os.O_TRUNC, 0o600)
        self._size = 0
        before.unlink(missing_ok=True)
        with contextlib.suppress(FileNotFoundError):
            before.hardlink_to(self._path)
        fresh.replace(self._path)
