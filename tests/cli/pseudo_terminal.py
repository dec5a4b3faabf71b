"""A program on a pseudo-terminal of its own, as in a terminal window; a context manager."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import struct
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Callable

from tests import ROOT

_ESCAPE = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


class PseudoTerminal:
    """`rampart` with these arguments on a terminal of `columns` and `rows`."""

    def __init__(self, *arguments: str, columns: int = 80, rows: int = 24, **environment: str
                 ) -> None:
        self._master, self.slave = pty.openpty()
        fcntl.ioctl(self.slave, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
        self.before = termios.tcgetattr(self.slave)
        self._arguments = [sys.executable, "-m", "rampart.cli.main", *arguments]
        self._environment = {
            **{k: v for k, v in os.environ.items()
               if k not in {"NO_COLOR", "COLUMNS", "LINES", "FORCE_COLOR"}},
            "TERM": "xterm-256color", **environment}
        self._output = bytearray()

    def __enter__(self) -> PseudoTerminal:
        def own_terminal() -> None:
            fcntl.ioctl(0, termios.TIOCSCTTY, 0)

        self.process = subprocess.Popen(
            self._arguments, stdin=self.slave, stdout=self.slave, stderr=self.slave, cwd=ROOT,
            env=self._environment, start_new_session=True,
            preexec_fn=own_terminal)  # noqa: PLW1509 it is one system call
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        os.close(self.slave)
        self._reader.join(5)
        os.close(self._master)

    def _read(self) -> None:
        while True:
            try:
                self._output += os.read(self._master, 65536)
            except OSError:  # the last one who had the terminal open has ended
                return

    @property
    def raw(self) -> str:
        """Everything that was written, with all that moves the cursor."""
        return self._output.decode(errors="replace")

    @property
    def text(self) -> str:
        """Everything that was written, words only."""
        return _ESCAPE.sub("", self.raw)

    def press(self, keys: str) -> None:
        os.write(self._master, keys.encode())

    def wait_for(self, condition: str | Callable[[], bool], timeout_s: float = 30) -> None:
        """Wait for a text, or until something holds."""
        holds = condition if callable(condition) else (lambda: condition in self.text)
        deadline = time.monotonic() + timeout_s
        while not holds():
            assert time.monotonic() < deadline, f"{condition} did not come\n{self.text[-3000:]}"
            time.sleep(0.02)

    def end(self, timeout_s: float = 15) -> int:
        """Wait for the program's end and return its exit code."""
        return self.process.wait(timeout_s)

    @property
    def is_as_before(self) -> bool:
        """Whether the terminal's mode is what it was before the program was started."""
        return termios.tcgetattr(self.slave) == self.before
