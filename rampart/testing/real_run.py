"""A real run, started, watched and disturbed from outside as by a user."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar, Self

from rampart.actors.bus.run_info import RunInfo, find_runs
from rampart.actors.supervision.process_title import find_processes
from rampart.testing.ports import free_base_port
from rampart.testing.waiting import wait_until

HEEDS_SIGNALS = ("env", "--default-signal=HUP,INT")
"""Prefix of a command: restores signals that nohup and shells ignore in background commands."""


class RealRun:
    """A run on real processes with a free base port; a context manager.

    The exit ends the run and checks that no process of it is left. There is no black box, unless
    the arguments contain `--black-box`.

    Args:
        directory: Existing folder for output and report. It is the run's working directory, so
            custom modules may be there.
        system: Path, or name of a shipped system.
        arguments: Further arguments of the command line.
        hmi: Whether the run serves the operator's page.

    Class attributes:
        command: Command that starts a run.
    """

    command: ClassVar[Sequence[str]] = (sys.executable, "-P", "-m", "rampart.cli.run")

    def __init__(self, directory: Path, system: str | Path, *arguments: str,
                 hmi: bool = False) -> None:
        self.port = free_base_port()
        self.directory = directory
        self._stderr = directory / "stderr.txt"
        self._stdout = directory / "stdout.txt"
        self._command = [
            *self.command, "--system", str(system), "--json", "--port", str(self.port),
            "--report", str(directory / "report"), "--no-black-box",
            *([] if hmi else ["--no-hmi"]), *arguments]

    def __enter__(self) -> Self:
        with self._stdout.open("w") as out, self._stderr.open("w") as err:
            self.process = subprocess.Popen(  # noqa: S603 the command is ours
                self._command, stdout=out, stderr=err, cwd=self.directory, stdin=subprocess.DEVNULL)
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            try:
                self.process.wait(10)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        self.wait_until(lambda: find_processes(self.port) == [], 3, "processes were left")

    @property
    def story(self) -> str:
        """Its output on stderr so far."""
        return self._stderr.read_text()

    def story_from(self, byte: int) -> str:
        """Return its output on stderr from a byte on, to read a long output once."""
        with self._stderr.open("rb") as file:
            file.seek(byte)
            return file.read().decode(errors="replace")

    def wait_until(self, condition: Callable[[], bool], timeout_s: float, what: str) -> None:
        """Wait until a condition holds.

        Raises:
            AssertionError: It does not within `timeout_s`; the text is `what` and the run's output.
        """
        wait_until(condition, timeout_s, lambda: f"{what}\n{self.story}")

    def wait_for(self, text: str, timeout_s: float = 30) -> None:
        """Wait until a text appears on stderr.

        Raises:
            AssertionError: It does not within `timeout_s`, or the run ends before.
        """
        self.wait_until(lambda: text in self.story or self.process.poll() is not None,
                        timeout_s, f"{text!r} did not appear")
        if text not in self.story:
            raise AssertionError(f"{text!r} did not appear before the end\n{self.story}")

    @property
    def info(self) -> RunInfo:
        """The run as tools see it; waits until it is up."""
        self.wait_until(lambda: any(r.base_port == self.port for r in find_runs()), 30,
                        "the run did not come up")
        return next(r for r in find_runs() if r.base_port == self.port)

    def sleep_until(self, simulated_s: float) -> None:
        """Sleep until a simulated time of the run, or its end."""
        info = self.info
        due = info.origin_s + simulated_s / info.rate
        while time.monotonic() < due and self.process.poll() is None:
            time.sleep(0.01)

    def pid(self, node: str) -> int | None:
        """Return the pid of the last incarnation of a node; None if it has no process."""
        found = [p for p in find_processes(self.port) if node in p.names]
        return max(found, key=lambda p: p.incarnation).pid if found else None

    def kill(self, node: str, number: signal.Signals = signal.SIGKILL) -> int:
        """Signal a node and return the pid it had: SIGSTOP stops it, SIGUSR2 makes it hang.

        Raises:
            AssertionError: The node has no process for 5 s.
        """
        self.wait_until(lambda: self.pid(node) is not None, 5, f"{node} has no process")
        pid = self.pid(node)
        if pid is None:
            raise AssertionError(f"{node} has no process any more")
        os.kill(pid, number)
        return pid

    def tool(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run a verb of `rampart` on this run, such as `inject`, in the folder of the run."""
        return subprocess.run(  # noqa: S603 the command is ours
            [sys.executable, "-P", "-m", "rampart.cli.main", *arguments, "--port", str(self.port)],
            check=False, capture_output=True, text=True, cwd=self.directory, timeout=60)

    def result(self, timeout_s: float = 200) -> tuple[int, dict[str, Any]]:
        """Wait for the end and return exit code and result.

        Raises:
            AssertionError: The run prints no result.
            subprocess.TimeoutExpired: The run does not end within `timeout_s`.
        """
        code = self.process.wait(timeout_s)
        lines = self._stdout.read_text().splitlines()
        if not lines:
            raise AssertionError(f"nothing on stdout, exit code {code}\n{self.story}")
        return code, json.loads(lines[-1])
