"""Who did what on a page: lines of JSON in a file, for the report of the run.

The process that serves a page may be killed at any moment, so nothing is kept in it: each line is
written at once and whole, and is then the kernel's. (A machine that loses its power may lose the
last ones.) A line that a full disk cut in two stays readable as a line of its own. There is no
token in it, nor what was shown in the place of one.

Of visitors without a token one line a second is kept, and the next one counts those between. A file
that is full says so in its last line. A line that cannot be written keeps nobody from acting:
an emergency stop must be releasable on a full disk; how many were lost is said when there is room.
"""

from __future__ import annotations

import contextlib
import errno
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
        left_out: lines of visitors without a token since the line before that were not written.
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
        self._handle = -1
        self._trouble = ""
        self._lost = 0
        self._is_full = False
        self._stranger_s = -STRANGERS_S
        self._left_out = 0

    def write(self, what: str, *, who: str = "", address: str = "", role: str = "", page: int = 0,
              asked: dict[str, Any] | None = None, why: str = "", refused: bool = False) -> None:
        """Append a line; never raises."""
        if self._file is None:
            return
        left_out = 0
        if not who:
            if self._real_s() < self._stranger_s + STRANGERS_S:
                self._left_out += 1
                return
            self._stranger_s = self._real_s()
            left_out, self._left_out = self._left_out, 0
        self._append(AuditLine(
            utc=datetime.now(UTC).isoformat(timespec="milliseconds"), t_s=round(self._now(), 3),
            who=who, address=address, role=role, page=page, what=what, asked=asked or {},
            outcome="refused" if refused else "accepted", why=why[:500], left_out=left_out))

    def close(self) -> None:
        """Close the file; the next line would open it again."""
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1

    def _append(self, line: AuditLine) -> None:
        encoded = msgspec.json.encode(line) + b"\n"
        if len(encoded) > _LINE_BYTES:
            encoded = msgspec.json.encode(msgspec.structs.replace(line, asked={})) + b"\n"
        try:
            handle, size = self._open()
            if self._lost and not self._is_full:
                encoded = self._own(line, f"{self._lost} lines were not written") + encoded
            if self._is_full or size + len(encoded) > MAX_BYTES:
                if not self._is_full and size < MAX_BYTES:
                    self._put(handle, self._own(line, "full: what follows is not kept"))
                self._is_full = True
                self._tell(f"full: {MAX_BYTES} bytes are the most; what follows is not kept")
                return
            self._put(handle, encoded)
        except OSError as error:
            self._lost += 1
            self.close()
            self._tell(f"cannot be written ({error.strerror or error}): who does what is not kept")
            return
        self._lost = 0
        self._trouble = ""

    @staticmethod
    def _put(handle: int, line: bytes) -> None:
        """Append a line by one call, as the kernel takes it whole or, on a full disk, in part."""
        if os.write(handle, line) < len(line):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # the rest begins a line

    def _own(self, line: AuditLine, why: str) -> bytes:
        own = AuditLine(utc=line.utc, t_s=line.t_s, who=_SELF, what="audit", outcome="refused",
                        why=why)
        return msgspec.json.encode(own) + b"\n"

    def _open(self) -> tuple[int, int]:
        """Return the file, open, and its size; it begins a line."""
        if self._handle < 0:
            if self._file is None:
                raise OSError(errno.ENOENT, "there is none")
            self._handle = os.open(self._file, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC
                                   | os.O_NOFOLLOW, 0o600)
            size = os.fstat(self._handle).st_size
            if size and os.pread(self._handle, 1, size - 1) != b"\n":
                os.write(self._handle, b"\n")
        return self._handle, os.fstat(self._handle).st_size

    def _tell(self, why: str) -> None:
        if why != self._trouble:
            self._trouble = why
            self._complain(f"{self._file}: {why}")


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
