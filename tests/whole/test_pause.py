"""Everybody pauses, as in a container that is paused: what did not run was not missing."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import time

import pytest

from rampart.actors.supervision.process_title import find_processes
from rampart.testing import RealRun
from tests.whole.checkpoint_runs import write_short_mission

pytestmark = [pytest.mark.processes, pytest.mark.alone, pytest.mark.slow]

SHUFFLED_STEP_S = 0.002


def order_of(name: str, pids: list[int], supervisor: int) -> list[int]:
    """Return in which order the processes go on."""
    if name == "reversed":
        return pids[::-1]
    if name == "random":
        return random.Random(7).sample(pids, len(pids))
    if name == "supervisor first":
        return sorted(pids, key=lambda pid: pid != supervisor)
    if name == "supervisor last":
        return sorted(pids, key=lambda pid: pid == supervisor)
    return pids


def pause_everybody(run: RealRun, seconds: float, order: str) -> None:
    """Stop all processes of a run, its launcher first, and have them go on in some order."""
    supervisor = run.pid("supervisor")
    assert supervisor is not None
    pids = [run.process.pid, *(p.pid for p in find_processes(run.port)
                               if p.pid != run.process.pid)]
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    time.sleep(seconds)
    for pid in order_of(order, pids, supervisor):
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)
        time.sleep(SHUFFLED_STEP_S)


def restarted_by(run: RealRun, seconds: float, order: str) -> set[tuple[str, ...]]:
    """Return the nodes of which a process was replaced because of a pause."""
    before = {(p.names, p.incarnation) for p in find_processes(run.port)}
    pause_everybody(run, seconds, order)
    time.sleep(4.0)
    after = {(p.names, p.incarnation) for p in find_processes(run.port)}
    return {names for names, incarnation in after - before if incarnation > 1}


@pytest.mark.parametrize(("seconds", "order"), [
    (3.0, "supervisor first"), (1.0, "random"), (3.0, "as started"), (3.0, "reversed"),
    (3.0, "supervisor last"), (12.0, "random"), (30.0, "reversed")])
def test_after_a_pause_of_everybody_nothing_is_restarted_and_the_mission_goes_on(
        tmp_path, seconds, order):
    mission = write_short_mission(tmp_path)
    with RealRun(tmp_path, "osmosis", "--mission", str(mission), "--rate", "2") as run:
        run.sleep_until(8.0)
        restarted = restarted_by(run, seconds, order)
        assert restarted == set(), run.story
        _, result = run.result()
        assert (result["mission"], result["safety"]) == ("success", "safe"), run.story
        assert "latched" not in run.story
