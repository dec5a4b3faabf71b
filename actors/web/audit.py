"""Who did what on a page: lines of JSON in a file, for the report of the run.

The process that serves a page may be killed at any moment: each line is written by one call, and is
then the kernel's. (A machine that loses its power may lose the last ones.) Tokens are not in it.

A line that cannot be written prevents no request: an emergency stop must be releasable on a full
disk. The next line counts the missing ones. So it does for visitors without a token, of whom one
line a second is kept. The last line of a full file says that it is full.
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
"""Real seconds between two lines of visitors without a token."""

MAX_BYTES = 4_000_000
"""Of a file; some ten thousand lines."""

_LINE_BYTES = 4000
_SELF = "page"
_FULL = "full: what follows is not kept"

Outcome = Literal["accepted", "refused"]


class AuditLine(msgspec.Struct, frozen=True, omit_defaults=True, kw_only=True):
    """Something that somebody did, or tried.

    Attributes:
        utc: when, by the machine's wall clock, ISO 8601.
        t_s: when, in simulated seconds.
        who: the visitor's name; "" of one who is not known.
        address: where from.
        role: of the visitor, then.
        page: number of the page, in one incarnation of its node; 0 for none.
        what: the kind of request; or log in, log out, open, close, take the stick, let go.
        asked: what else the request said.
        outcome: accepted or refused.
        why: it was refused, or what was answered.
        left_out: how many lines between this one and the one before were not written.
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
    """Appends to the file of a run.

    Args:
        file: where to; None keeps nothing. It may be there: of a former incarnation.
        now: simulated seconds.
        complain: is told why lines are lost, once for each reason in a row.
        real_s: real seconds.
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
            trouble = f"cannot be written ({error.strerror or error}): who does what is not kept"
        if not trouble:
            self._left_out = 0
        elif trouble != self._trouble:
            self._complain(f"{self._file}: {trouble}")
        self._trouble = trouble

    def _append(self, file: Path, line: AuditLine) -> str:
        """Append a line by one call; return why it is not kept, "" if it is."""
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
            if size and os.pread(handle, 1, size - 1) != b"\n":  # a full disk cut a line in two
                encoded = b"\n" + encoded
            if os.write(handle, encoded) < len(encoded):
                return "the disk is full: who does what is not kept"
            return _FULL if is_last else ""
        finally:
            os.close(handle)


def read_audit(file: Path) -> tuple[AuditLine, ...]:
    """Return the lines of a file, one that is broken as one that says so; none without a file."""
    with contextlib.suppress(OSError), file.open("rb") as opened:
        return tuple(_read(line) for line in opened.read(MAX_BYTES + _LINE_BYTES).splitlines()
                     if line.strip())
    return ()


def _read(line: bytes) -> AuditLine:
    try:
        return msgspec.json.decode(line, type=AuditLine)
    except (msgspec.DecodeError, ValueError):
        return AuditLine(utc="", t_s=0.0, who=_SELF, what="audit", outcome="refused",
                         why="a line that cannot be read")
