"""Runs `launch.py` as a user does, and disturbs it from outside."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rampart.actors.run.run_info import RunInfo, find_runs
from rampart.actors.supervision.process_title import find_processes
from tests import ROOT
from tests.stub_actors import free_base_port

HEEDS_SIGNALS = ("env", "--default-signal=HUP,INT")
"""Before a command: undoes what nohup, and shells with what they start in the background, do."""


class RealRun:
    """A `launch.py` process of its own ports and report directory; a context manager."""

    def __init__(self, directory: Path, *arguments: str, hmi: bool = False,
                 system: str = "paper") -> None:
        self.port = free_base_port()
        self.directory = directory
        self._stderr = directory / "stderr.txt"
        self._stdout = directory / "stdout.txt"
        self._arguments = [
            sys.executable, str(ROOT / "launch.py"), "--system", system, "--json",
            "--port", str(self.port), "--report", str(directory / "report"),
            *([] if hmi else ["--no-hmi"]), *arguments]

    def __enter__(self) -> RealRun:
        with self._stdout.open("w") as out, self._stderr.open("w") as err:
            self.process = subprocess.Popen(
                self._arguments, stdout=out, stderr=err, cwd=self.directory,
                stdin=subprocess.DEVNULL)
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
        """What it has told on stderr so far."""
        return self._stderr.read_text()

    def story_from(self, byte: int) -> str:
        """What it has told after so many bytes; a mission of many hits tells much."""
        with self._stderr.open("rb") as told:
            told.seek(byte)
            return told.read().decode(errors="replace")

    def wait_until(self, condition: Callable[[], bool], timeout_s: float, what: str) -> None:
        deadline = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < deadline, f"{what}\n{self.story}"
            time.sleep(0.02)

    def wait_for(self, text: str, timeout_s: float = 30) -> None:
        """Wait until a text appears on stderr."""
        self.wait_until(lambda: text in self.story or self.process.poll() is not None,
                        timeout_s, f"{text!r} did not appear")
        assert text in self.story, f"{text!r} did not appear before the end\n{self.story}"

    @property
    def info(self) -> RunInfo:
        self.wait_until(lambda: any(r.base_port == self.port for r in find_runs()), 30,
                        "the run did not come up")
        return next(r for r in find_runs() if r.base_port == self.port)

    def sleep_until(self, simulated_s: float) -> None:
        """Sleep until a simulated time of the run."""
        info = self.info
        due = info.origin_s + simulated_s / info.rate
        while time.monotonic() < due and self.process.poll() is None:
            time.sleep(0.01)

    def pid(self, node: str) -> int | None:
        found = [p for p in find_processes(self.port) if node in p.names]
        return max(found, key=lambda p: p.incarnation).pid if found else None

    def kill(self, node: str, number: signal.Signals = signal.SIGKILL) -> int:
        """Signal a node and return the pid it had."""
        self.wait_until(lambda: self.pid(node) is not None, 5, f"{node} is not there")
        pid = self.pid(node)
        assert pid is not None
        os.kill(pid, number)
        return pid

    def tool(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run `rampart` on this run."""
        return subprocess.run(
            [sys.executable, "-m", "rampart.cli.main", *arguments, "--port", str(self.port)],
            check=False, capture_output=True, text=True, cwd=ROOT, timeout=60)

    def result(self, timeout_s: float = 200) -> tuple[int, dict[str, Any]]:
        """Wait for the end and return exit code and result."""
        code = self.process.wait(timeout_s)
        lines = self._stdout.read_text().splitlines()
        assert lines, f"nothing on stdout, exit code {code}\n{self.story}"
        return code, json.loads(lines[-1])
