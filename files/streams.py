"""stdout and stderr that may be gone: what a program decides never depends on who reads it.

A terminal is closed, a pipe's reader has seen enough, the disk under a log is full, a descriptor
was never open. Python raises then, wherever something is printed, and once more at exit, where that
changes the exit code. After `secure` nothing is raised: what cannot be written is lost, `lost` says
why, and the program goes on. A descriptor that is closed is opened on /dev/null, so that no file or
socket takes its number and gets the story written into it.

Nor does the loop of a program wait for a reader that does not read: stderr that takes nothing for
`PATIENCE_S` loses lines until it does again. stdout is waited for; it is the result.
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
"""Real seconds that stderr may take nothing, before lines are lost."""


class _Unfailing(io.FileIO):
    """A file descriptor that takes everything; `failure` says why something of it was lost.

    Without patience it waits until it is read.
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
    """Have nothing that is written to stdout or stderr raise, from now on and at exit.

    Streams that are not the process's own, a test's for example, stay as they are.
    """
    for descriptor, flags in ((0, os.O_RDONLY), (1, os.O_WRONLY), (2, os.O_WRONLY)):
        try:
            os.fstat(descriptor)
        except OSError:  # those below it are open, so it gets this number
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
    """Return why something of stdout was lost; None if nothing was."""
    raw = _raw(sys.stdout)
    return raw.failure if raw else None


def lost_result() -> str:
    """Return in words why stdout was lost; "" if it was not, or if its reader has seen enough."""
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.flush()
    failure = lost()
    if failure is None or failure.errno == errno.EPIPE:
        return ""
    return failure.strerror or str(failure)


def _raw(stream: Any) -> _Unfailing | None:
    raw = getattr(getattr(stream, "buffer", None), "raw", None)
    return raw if isinstance(raw, _Unfailing) else None
