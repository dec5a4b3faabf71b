"""Who did what on a page: lines of JSON in a file, for the report of the run.

The process that serves a page may be killed at any moment, so nothing is kept in it: each line is
written at once and whole, and is then the kernel's. (A machine that loses its power may lose the
last ones.) A line that a full disk cut in two stays readable as a line of its own. There is no
token in it, nor what was shown in the place of one.

Who has a role, or none, could fill a disk with what is refused. So everybody has so many lines at
once and so many a second; what is beyond is counted, and the next line says how many there were. A
file that is full says so in its last line. A line that cannot be written keeps nobody from acting:
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

from rampart.actors.bus.limits import Remembered
from rampart.actors.web.guests import Bucket

LINES_AT_ONCE = 200
LINES_PER_S = 2.0
"""Of one visitor; of all strangers together."""

MAX_BYTES = 4_000_000
"""Of a file; some ten thousand lines."""

_LINE_BYTES = 4000
_WRITERS = 64
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
        left_out: lines of the same visitor since the line before that were not written.
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
        self._writers: Remembered[str, tuple[Bucket, int]] = Remembered(_WRITERS)

    def write(self, what: str, *, who: str = "", address: str = "", role: str = "", page: int = 0,
              asked: dict[str, Any] | None = None, why: str = "", refused: bool = False) -> None:
        """Append a line; never raises."""
        if self._file is None:
            return
        left_out = self._counted(who)
        if left_out is None:
            return
        self._append(AuditLine(
            utc=datetime.now(UTC).isoformat(timespec="milliseconds"), t_s=round(self._now(), 3),
            who=who, address=address, role=role, page=page, what=what, asked=asked or {},
            outcome="refused" if refused else "accepted", why=why[:500], left_out=left_out))

    def close(self) -> None:
        """Close the file; the next line would open it again."""
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1

    def _counted(self, writer: str) -> int | None:
        """Return how many lines of somebody were left out before this one; None leaves it out."""
        now_s = self._real_s()
        bucket, left_out = self._writers.pop(
            writer, (Bucket(LINES_AT_ONCE, LINES_PER_S, now_s), 0))
        has_room = bucket.has(1, now_s)
        if has_room:
            bucket.take(1, now_s)
        self._writers[writer] = (bucket, 0 if has_room else left_out + 1)
        return left_out if has_room else None

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
