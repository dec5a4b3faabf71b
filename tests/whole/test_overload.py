"""A machine without processor time for a while."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from rampart.testing import RealRun
from tests.whole.missions import write_taxi_mission

MANY = 64


@contextlib.contextmanager
def busy_processes(*, in_sessions: bool) -> Iterator[None]:
    """Keep many processes busy.

    Args:
        in_sessions: each in a session of its own, as those of other users are. Where the kernel
            shares the processors between sessions (`sched_autogroup_enabled`, sched(7)), many of
            them leave hardly anything; in one session with the system its processes compete with
            each one by itself, and those that sleep a lot run soon when they wake.
    """
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"],
                             start_new_session=in_sessions) for _ in range(MANY)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
        for process in busy:
            process.wait()


@contextlib.contextmanager
def second_system(folder: Path) -> Iterator[None]:
    """Drive another mission on the same machine."""
    folder.mkdir()
    with RealRun(folder, "osmosis", "--rate", "2"):
        yield


@pytest.mark.slow
@pytest.mark.processes
@pytest.mark.alone
@pytest.mark.timeout(400)
@pytest.mark.parametrize(("kind", "rate"), [("busy", 2), ("sessions", 1), ("second", 2)])
def test_the_mission_goes_on_after_an_overload(tmp_path, kind, rate):
    with RealRun(tmp_path, "osmosis", "--mission", str(write_taxi_mission(tmp_path)), "--rate",
                 str(rate), "--patience", "90") as run:
        run.wait_for("goal 1/")
        run.sleep_until(3.0)
        with (second_system(tmp_path / "second") if kind == "second"
              else busy_processes(in_sessions=kind == "sessions")):
            time.sleep(15.0)
        _, result = run.result(300)
    assert (result["mission"], result["safety"]) == ("success", "safe"), run.story
