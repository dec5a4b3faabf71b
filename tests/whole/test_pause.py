"""Everybody pauses, as in a container that is paused: what did not run was not missing."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import time
from collections.abc import Sequence

import pytest

from rampart.actors.supervision.process_title import find_processes
from rampart.testing import RealRun
from tests.whole.missions import write_mission

pytestmark = [pytest.mark.processes, pytest.mark.alone]

SHUFFLED_STEP_S = 0.002


def restarted_by(run: RealRun, seconds: float, last: Sequence[str] = (), killed: str = "",
                 left: str = "") -> set[tuple[str, ...]]:
    """Return the nodes of which a process was replaced because everybody was stopped for a while.

    All processes of the run are stopped, its launcher first. One is killed meanwhile, one is left
    stopped, the others go on in a random order, but for those that are the last.
    """
    before = {(p.names, p.incarnation) for p in find_processes(run.port)}
    pids = [run.process.pid, *(p.pid for p in find_processes(run.port)
                               if p.pid != run.process.pid)]
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    time.sleep(seconds)
    random.Random(7).shuffle(pids)
    late = {run.pid(node) for node in last}
    going_on = [pid for pid in sorted(pids, key=late.__contains__) if pid != run.pid(left)]
    if killed:
        run.kill(killed)
    for pid in going_on:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGCONT)
        time.sleep(SHUFFLED_STEP_S)
    time.sleep(4.0)
    after = {(p.names, p.incarnation) for p in find_processes(run.port)}
    return {names for names, incarnation in after - before
            if incarnation > 1 and names != ("pool",)}


def test_after_pauses_of_everybody_only_what_died_or_hangs_is_restarted(tmp_path):
    mission = write_mission(tmp_path, "NEAR")
    with RealRun(tmp_path, "osmosis", "--mission", str(mission), "--rate", "2") as run:
        run.sleep_until(4.0)
        assert restarted_by(run, 3.0, ["supervisor"]) == set(), run.story
        died, hangs = "graph_planner", "DM5"
        pids = [run.pid(died), run.pid(hangs)]
        restarted = restarted_by(run, 3.0, killed=died, left=hangs)
        assert restarted == {(died,), (hangs,)}, run.story
        assert run.pid(died) not in pids
        assert run.pid(hangs) not in pids
        _, result = run.result()
        assert (result["mission"], result["safety"]) == ("success", "safe"), run.story
        assert "latched" not in run.story
