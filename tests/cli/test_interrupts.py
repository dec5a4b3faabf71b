"""Ctrl-C while a run loads."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from tests import ROOT
from tests.actors.ros2.test_gateway import SYSTEM

pytestmark = pytest.mark.processes

SWALLOWING = """
import os, signal
try:
    os.kill(os.getpid(), signal.SIGINT)
    sum(range(1000))
except BaseException:
    pass
from tests.actors.ros2.robot import Base
"""


@pytest.mark.parametrize("start", [[str(ROOT / "launch.py")], ["-m", "rampart.cli.main", "run"]],
                         ids=["launch", "rampart-run"])
def test_a_module_that_swallows_an_interrupt_does_not_keep_the_run_from_ending(
        tmp_path, monkeypatch, start):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    (tmp_path / "own_base.py").write_text(SWALLOWING)
    (tmp_path / "own.toml").write_text(SYSTEM.replace("tests.actors.ros2.robot:Base",
                                                      "own_base:Base"))
    done = subprocess.run([sys.executable, *start, "--system", "own.toml", "--virtual",
                           "--duration", "1"], cwd=tmp_path, capture_output=True, text=True,
                          timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (1, "", "")


def test_a_world_is_loaded_without_glfw_which_would_start_a_process_in_the_middle_of_the_start():
    code = ("import os, sys, rampart.sim.osmosis.world; "
            "print('glfw' in sys.modules, 'MUJOCO_GL' in os.environ)")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True,
                          env={k: v for k, v in os.environ.items() if k != "MUJOCO_GL"})
    assert done.stdout == "False False\n"
