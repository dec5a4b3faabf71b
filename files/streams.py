"""stdout and stderr that may be closed: a program does not depend on the readers of its output.

A terminal closes, the reader of a pipe ends, the disk of a log is full, or a descriptor was never
open. Then Python raises at each print, and again at exit, where it changes the exit code. After
`secure` nothing is raised. Output that cannot be written is lost, and `lost` returns the reason. A
closed descriptor is opened on /dev/null, so that no file or socket gets its number and the output.

The program does not wait for a reader of stderr that stops reading: after `PATIENCE_S` lines are
lost until the reader continues. It waits for readers of stdout, which is the result.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import select
import sys
from typing import Any

from rampart.files.plain_text import one_line

PATIENCE_S = 0.5
"""Real seconds without a read from stderr until lines are lost."""


class _Unfailing(io.FileIO):
    """A file descriptor whose writes never fail; `failure` is the reason of lost output.

    Without patience a write waits until there is room.
    """

    def __init__(self, descriptor: int, patience_ms: float | None) -> None:
        super().__init__(descriptor, "wb", closefd=False)
        self.failure: OSError | None = None
        self._patience_ms = patience_ms
        self._stuck = False

    def write(self, data: Any, /) -> int:
        left = memoryview(data).cast("B")
        size = len(left)
        try:
            while left and self._takes():
                left = left[super().write(left[:select.PIPE_BUF]) or 0:]
        except OSError as error:
            self.failure = error
        return size

    def _takes(self) -> bool:
        poll = select.poll()
        poll.register(self.fileno(), select.POLLOUT)
        self._stuck = not poll.poll(0.0 if self._stuck else self._patience_ms)
        return not self._stuck


def secure() -> None:
    """Let no write to stdout or stderr raise, from now on and at exit.

    Replaced streams, such as those of a test, stay as they are.
    """
    for descriptor, flags in ((0, os.O_RDONLY), (1, os.O_WRONLY), (2, os.O_WRONLY)):
        try:
            os.fstat(descriptor)
        except OSError:  # lower ones are open, so it gets this number
            os.open(os.devnull, flags)
            os.set_inheritable(descriptor, True)
    for name, descriptor, patience_ms in (("stdout", 1, None), ("stderr", 2, 1000 * PATIENCE_S)):
        before = getattr(sys, name)
        if before is not getattr(sys, f"__{name}__") or _raw(before) is not None:
            continue
        with contextlib.suppress(OSError, AttributeError):
            before.flush()
        raw = _Unfailing(descriptor, patience_ms)
        made = io.TextIOWrapper(
            io.BufferedWriter(raw), encoding=getattr(before, "encoding", None) or "utf-8",
            errors="backslashreplace", line_buffering=name == "stderr" or raw.isatty())
        setattr(sys, name, made)
        setattr(sys, f"__{name}__", made)


def complain(text: str) -> None:
    """Print a text as one line on stderr."""
    print(f"rampart: {one_line(text)}", file=sys.stderr, flush=True)


def lost() -> OSError | None:
    """Return why output on stdout was lost; None if none was."""
    raw = _raw(sys.stdout)
    return raw.failure if raw else None


def lost_result() -> str:
    """Return in words why output on stdout was lost; "" if none was, or its reader ended."""
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.flush()
    failure = lost()
    if failure is None or failure.errno == errno.EPIPE:
        return ""
    return failure.strerror or str(failure)


def _raw(stream: Any) -> _Unfailing | None:
    raw = getattr(getattr(stream, "buffer", None), "raw", None)
    return raw if isinstance(raw, _Unfailing) else None
