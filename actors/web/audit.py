"""The audit of a page: who did what, as lines of JSON in a file, for the report of the run.

Each line is written by one call, so the kernel has it even if the process is killed; a power cut
may lose the last lines. Tokens are not in the file.

A line that cannot be written prevents no request: an emergency stop has to be releasable on a full
disk. The next line counts the missing ones. It also counts those of visitors without a token, who
get one line per second. The last line of a full file reports that it is full.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import msgspec

STRANGERS_S = 1.0
"""Real seconds between two lines about visitors without a token."""

MAX_BYTES = 4_000_000
"""Size of a full file: some ten thousand lines."""

_LINE_BYTES = 4000
_SELF = "page"
_FULL = "full: later actions are not recorded"

Outcome = Literal["accepted", "refused"]


class AuditLine(msgspec.Struct, frozen=True, omit_defaults=True, kw_only=True):
    """An action of a visitor, or an attempt.

    Attributes:
        utc: wall time, ISO 8601.
        t_s: simulated seconds.
        who: the visitor's name; "" if unknown.
        address: of the visitor.
        role: of the visitor at that time.
        page: number of the page in one incarnation of its node; 0 for none.
        what: the kind of request; or log in, log out, open, close, take the stick, let go.
        asked: the other fields of the request.
        outcome: accepted or refused.
        why: reason of the refusal, or the answer.
        left_out: number of lines before this one that were not written.
    """

    utc: str
    t_s: float
    who: str = ""
    address: str = ""
    role: str = ""
    page: int = 0
    what: str
    asked: dict[str, Any] = {}
    outcome: Outcome
    why: str = ""
    left_out: int = 0


class AuditLog:
    """Appends to the audit file of a run.

    Args:
        file: path, where an earlier incarnation may have written; None keeps nothing.
        now: returns simulated seconds.
        complain: called with the reason when lines are lost, once until the reason changes.
        real_s: returns real seconds.
    """

    def __init__(self, file: Path | None, now: Callable[[], float],
                 complain: Callable[[str], None], real_s: Callable[[], float]) -> None:
        self._file = file
        self._now = now
        self._complain = complain
        self._real_s = real_s
        self._trouble = ""
        self._stranger_s = -math.inf
        self._left_out = 0

    def write(self, what: str, *, who: str = "", address: str = "", role: str = "", page: int = 0,
              asked: dict[str, Any] | None = None, why: str = "", refused: bool = False) -> None:
        """Append a line; never raises."""
        if self._file is None:
            return
        line = AuditLine(
            utc=datetime.now(UTC).isoformat(timespec="milliseconds"), t_s=round(self._now(), 3),
            who=who, address=address, role=role, page=page, what=what, asked=asked or {},
            outcome="refused" if refused else "accepted", why=why[:500], left_out=self._left_out)
        self._left_out += 1
        if not who:
            if self._real_s() < self._stranger_s + STRANGERS_S:
                return
            self._stranger_s = self._real_s()
        try:
            trouble = self._append(self._file, line)
        except OSError as error:
            trouble = f"cannot be written ({error.strerror or error}): actions are not recorded"
        if not trouble:
            self._left_out = 0
        elif trouble != self._trouble:
            self._complain(f"{self._file}: {trouble}")
        self._trouble = trouble

    def _append(self, file: Path, line: AuditLine) -> str:
        """Append a line by one call; return why it is lost, "" if it is not."""
        encoded = msgspec.json.encode(line) + b"\n"
        if len(encoded) > _LINE_BYTES:
            encoded = msgspec.json.encode(msgspec.structs.replace(line, asked={})) + b"\n"
        handle = os.open(
            file, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        try:
            size = os.fstat(handle).st_size
            if size > MAX_BYTES:
                return _FULL
            if is_last := size + len(encoded) > MAX_BYTES:
                full = AuditLine(utc=line.utc, t_s=line.t_s, who=_SELF, what="audit",
                                 outcome="refused", why=_FULL)
                encoded = msgspec.json.encode(full).ljust(MAX_BYTES - size) + b"\n"
            if size and os.pread(handle, 1, size - 1) != b"\n":  # a full disk has cut a line
                encoded = b"\n" + encoded
            if os.write(handle, encoded) < len(encoded):
                return "the disk is full: actions are not recorded"
            return _FULL if is_last else ""
        finally:
            os.close(handle)


def read_audit(file: Path) -> tuple[AuditLine, ...]:
    """Return the lines of a file, with a note in place of a damaged line; none without a file."""
    with contextlib.suppress(OSError), file.open("rb") as opened:
        return tuple(_read(line) for line in opened.read(MAX_BYTES + _LINE_BYTES).splitlines()
                     if line.strip())
    return ()


def _read(line: bytes) -> AuditLine:
    try:
        return msgspec.json.decode(line, type=AuditLine)
    except (msgspec.DecodeError, ValueError):
        return AuditLine(utc="", t_s=0.0, who=_SELF, what="audit", outcome="refused",
                         why="damaged line")
