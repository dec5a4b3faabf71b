"""What takes the processor away from a running system for a while."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from rampart.testing import RealRun

MANY = 64
_SPIN = "while True: pass"
_BEGUN_S = 3.0


class Load(NamedTuple):
    """A kind of overload: what comes beside a system, and the rate at which that is driven."""

    beside: Callable[[Path], AbstractContextManager[None]]
    rate: float


@contextmanager
def busy_processes(*, in_sessions: bool = False) -> Iterator[None]:
    """Keep many processes busy.

    Args:
        in_sessions: each in a session of its own, as those of other users are. Where the kernel
            shares the processors between sessions (`sched_autogroup_enabled`, sched(7)), many of
            them leave hardly anything; in one session with the system its processes compete with
            each one by itself, and those that sleep a lot run soon when they wake.
    """
    busy = [subprocess.Popen([sys.executable, "-c", _SPIN], start_new_session=in_sessions)
            for _ in range(MANY)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
        for process in busy:
            process.wait()


@contextmanager
def second_system(folder: Path, rate: float) -> Iterator[None]:
    """Drive another mission on the same machine."""
    folder.mkdir()
    with RealRun(folder, "osmosis", "--rate", f"{rate:g}"):
        yield


LOADS: Mapping[str, Load] = {
    "busy": Load(lambda _folder: busy_processes(), 1.0),
    "sessions": Load(lambda _folder: busy_processes(in_sessions=True), 1.0),
    "rate": Load(lambda _folder: busy_processes(), 2.0),
    "second": Load(lambda folder: second_system(folder / "second", 2.0), 2.0),
}


class Outcome(NamedTuple):
    """What became of a mission that had an overload on the way.

    Attributes:
        mission: "success" or "fail".
        safety: "safe" or "unsafe".
        decisions: How many the manager took.
        stopped: Whether it took the load for an overload.
        restarts: Of processes.
        late_s: How late a loop was at most, simulated seconds.
        duration_s: Of the mission, simulated seconds.
        reasons: Why it failed.
    """

    mission: str
    safety: str
    decisions: int
    stopped: bool
    restarts: int
    late_s: float
    duration_s: float
    reasons: tuple[str, ...]


def drive(folder: Path, kind: str, lasts_s: float) -> tuple[Outcome, str]:
    """Drive to the first goal of mission A under an overload of so many wall seconds.

    Returns:
        What became of it, and what it told.
    """
    load = LOADS[kind]
    mission = folder / "TAXI.miss"
    mission.write_text("x=-22,y=-18.5,taxi=1\n", encoding="utf-8")
    with RealRun(folder, "osmosis", "--mission", str(mission), "--rate", f"{load.rate:g}",
                 "--patience", "90") as run:
        run.wait_for("goal 1/")
        time.sleep(_BEGUN_S / load.rate)
        with load.beside(folder):
            time.sleep(lasts_s)
        _, result = run.result(300)
        return outcome(result), run.story


def outcome(result: Mapping[str, Any]) -> Outcome:
    """Read the result of a run."""
    return Outcome(
        result["mission"], result["safety"], len(result["decisions"]),
        any("FTM14" in decision["active"] for decision in result["decisions"]),
        sum(result["restarts"].values()), result["keeping_up"]["late_s"], result["duration_s"],
        tuple(result["reasons"]))
