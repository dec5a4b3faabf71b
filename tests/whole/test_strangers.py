"""Another user of the machine: nothing in, nothing out, on every port and socket of a run."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import psutil
import pytest

from rampart.actors.bus.run_folder import ROUTERS
from rampart.actors.supervision.process_title import find_processes
from rampart.testing import RealRun
from tests import ROOT
from tests.whole.checkpoint_runs import write_near_mission

pytestmark = [pytest.mark.processes, pytest.mark.alone, pytest.mark.skipif(
    os.getuid() != 0, reason="only root can become another user")]


def test_a_stranger_hears_nothing_and_is_not_heard(tmp_path):
    mission = str(write_near_mission(tmp_path))
    with RealRun(tmp_path, "paper", "--mission", mission) as run:
        run.wait_for("goal 1/3")
        info = run.info
        names = ",".join((*info.nodes, *ROUTERS))
        done = subprocess.run(
            [sys.executable, str(ROOT / "tests/whole/stranger.py"), info.folder, names],
            env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True,
            timeout=60, check=False)
        assert done.returncode == 0, done.stderr
        found = json.loads(done.stdout)
        assert found["user"] == 65534
        assert found["heard"] == 0
        assert found["squatted"] == "PermissionError"
        assert not found["listing"]
        assert set(found["named"].values()) == {" ".join(["PermissionError"] * 3)}
        assert any(str(run.port) in address for address in found["knocked"])
        assert "answered" not in found["knocked"].values()
        pids = [run.process.pid, *(p.pid for p in find_processes(run.port))]
        assert [c for pid in pids for c in psutil.Process(pid).net_connections("inet")] == []
        assert run.process.poll() is None
        assert "payload rejected" not in run.story
        assert "crashed" not in run.story
