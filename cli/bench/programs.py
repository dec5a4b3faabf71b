"""Programs that a benchmark starts: their lines with the time of each, bounded waits, a clean end.

Each runs in a session of its own, so ctrl-C reaches the benchmark alone, which ends them. What a
program has started itself is found by a variable of its environment, whatever group it is in.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, Self, TypeVar

from rampart.actors.foreign.descendants import kill_all
from rampart.files import working_folder

T = TypeVar("T")

END_S = 5.0
"""Wall seconds that a program has to end by itself."""

_LOOK_S = 0.25
_LAST_CHARS = 200
_MARK = "RAMPART_BENCH_OF"
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")


class BenchError(Exception):
    """Something that is measured does not do what it should; one line."""


class Line(NamedTuple):
    """What a program printed, and when it arrived by the monotonic clock."""

    at_s: float
    text: str


class Program:
    """A running program. A context manager, at whose end it is gone, with all that it started.

    Args:
        name: In messages.
        command: That starts it.
        folder: In which it runs.
        path: Folder that comes first in its PATH; None for the present one.

    Raises:
        BenchError: It cannot be started.
    """

    def __init__(self, name: str, command: Sequence[str | Path], folder: Path,
                 path: Path | None = None) -> None:
        self.name = name
        self.lines: list[Line] = []
        self._mark = f"{_MARK}={os.getpid()}.{time.monotonic_ns()}".encode()
        key, _, value = self._mark.decode().partition("=")
        environment = working_folder.environment() | {key: value, "PYTHONUNBUFFERED": "1"}
        if path is not None:
            environment["PATH"] = f"{path}{os.pathsep}{environment.get('PATH', '')}"
        self._news = threading.Condition()
        try:
            self._process = subprocess.Popen(  # noqa: S603 what is measured
                list(map(str, command)), cwd=folder, env=environment, stdin=subprocess.PIPE,
                stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True,
                text=True, errors="replace", bufsize=1)
        except OSError as error:
            raise BenchError(f"{name}: {command[0]}: {error.strerror}") from None
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        """Its process."""
        return self._process.pid

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def _read(self) -> None:
        for text in self._process.stdout or ():
            line = Line(time.monotonic(), _COLOUR.sub("", text.rstrip("\n")))
            with self._news:
                self.lines.append(line)
                self._news.notify_all()
        with self._news:
            self._news.notify_all()

    @property
    def has_ended(self) -> bool:
        """Whether it runs no more."""
        return self._process.poll() is not None

    def wait_for(self, find: Callable[[Line], T | None], timeout_s: float, what: str,
                 start: int = 0, while_runs: Program | None = None) -> T:
        """Return what is found first in the lines from number `start` on.

        Args:
            find: returns what is found in a line, None for nothing.
            timeout_s: wall seconds that it may take.
            what: is waited for, in the message.
            start: number of the first line that counts.
            while_runs: another program without which it will not come.

        Raises:
            BenchError: it was not found in time, or one of the programs has ended.
        """
        until_s = time.monotonic() + timeout_s
        with self._news:
            while True:
                while start < len(self.lines):
                    found = find(self.lines[start])
                    start += 1
                    if found is not None:
                        return found
                left_s = until_s - time.monotonic()
                needed = while_runs or self
                gone = next((one for one in (self, needed) if one.has_ended
                             and not one._reader.is_alive()), None)
                if gone is not None:
                    raise BenchError(f"{gone.name} has ended before {what} came{gone.last()}")
                if left_s <= 0:
                    raise BenchError(f"{what} did not come within {timeout_s:g} s{needed.last()}")
                self._news.wait(min(left_s, _LOOK_S))

    def last(self) -> str:
        """Return what it printed last, for a message; "" if it printed nothing."""
        return (f"; the last line of {self.name}: {self.lines[-1].text[:_LAST_CHARS]}"
                if self.lines else "")

    def end(self) -> None:
        """End it: SIGTERM, then SIGKILL to all that it has started. Harmless when it is gone."""
        with contextlib.suppress(OSError):
            if self._process.stdin is not None:
                self._process.stdin.close()
            self._process.send_signal(signal.SIGTERM)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(END_S)
        kill_all(lambda: marked(self._mark), END_S)
        self._process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(END_S)
        self._reader.join(END_S)
        if self._process.stdout is not None and not self._reader.is_alive():
            self._process.stdout.close()


def of_ours(program: str, *arguments: str) -> list[str]:
    """Return the command of one of the benchmark's own programs (`rampart.cli.bench.processes`)."""
    return [sys.executable, "-P", "-m", f"rampart.cli.bench.processes.{program}", *arguments]


def marked(mark: bytes) -> list[int]:
    """Return the processes whose environment has a variable with this value, `NAME=VALUE`."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            with contextlib.suppress(OSError):
                if mark in (entry / "environ").read_bytes().split(b"\0"):
                    found.append(int(entry.name))
    return found
