"""What happens while a run loads: ctrl-C, the garbage collector, imports."""

import os
import subprocess
import sys

import pytest

from rampart.testing import free_base_port
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


def test_a_module_that_swallows_an_interrupt_does_not_keep_the_run_from_ending(
        tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    (tmp_path / "own_base.py").write_text(SWALLOWING)
    (tmp_path / "own.toml").write_text(SYSTEM.replace("tests.actors.ros2.robot:Base",
                                                      "own_base:Base"))
    done = subprocess.run([sys.executable, "-m", "rampart.cli.main", "run", "--system", "own.toml",
                           "--virtual", "--duration", "1"], cwd=tmp_path, capture_output=True,
                          text=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (1, "", "")


def test_a_world_is_loaded_without_glfw_which_would_start_a_process_in_the_middle_of_the_start():
    code = ("import os, sys, rampart.sim.osmosis.world; "
            "print('glfw' in sys.modules, 'MUJOCO_GL' in os.environ)")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True,
                          env={k: v for k, v in os.environ.items() if k != "MUJOCO_GL"})
    assert done.stdout == "False False\n"


def test_the_web_server_is_loaded_before_the_fork_and_only_for_a_page():
    code = ("import sys; from rampart.cli.run_options import parse, plan_of\n"
            f"for more in (['--no-hmi'], ['--hmi-port', '{free_base_port()}']):\n"
            "    plan_of(*parse(more, 'run')); print('uvicorn' in sys.modules)")
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True,
                          check=True)
    assert done.stdout == "False\nTrue\n"
