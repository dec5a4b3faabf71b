"""A robot's velocity becomes zero though nothing of Rampart is left, by `rampart-stop`."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from pathlib import Path

import pytest

from rampart.actors.supervision.process_title import find_processes
from rampart.testing import RealRun
from tests import ROOT
from tests.stop.stopper import TIMEOUT_MS, compiled, running

NODE = '''
[[node]]
name = "velocity_link"
actor = "rampart.actors.foreign.velocity_link:VelocityLink"
kind = "non-control"
respawn = "{respawn}"

[node.parameters]
socket = "{socket}"
linear = "summit_xl/command:linear_mps"
angular = "summit_xl/command:angular_radps"
'''


def everything(run, number):
    """Signal all processes of a run, the root first."""
    for process in sorted(find_processes(run.port), key=lambda p: p.names != ("root",)):
        with contextlib.suppress(ProcessLookupError):  # it ends of itself: its parent is gone
            os.kill(process.pid, number)


@pytest.mark.alone
def test_the_velocity_is_zero_after_the_timeout_though_all_are_killed_or_stopped(tmp_path, sockets):
    program = compiled(tmp_path)
    folder = Path(sockets)
    system = tmp_path / "linked.toml"
    text = (ROOT / "systems/osmosis.toml").read_text()
    system.write_text(text + NODE.format(socket=folder / "in", respawn="supervisor"))
    with running(program, folder) as stopper:
        for number in (signal.SIGSTOP, signal.SIGKILL):
            run_folder = tmp_path / number.name
            run_folder.mkdir()
            with RealRun(run_folder, system, "--mission", "A") as run:
                run.wait_for("goal 1")
                run.wait_until(lambda: stopper.speed > 0.3, 30, "it does not drive")
                everything(run, number)
                struck_ns = time.monotonic_ns()
                after = [stopper.next()]
                while after[-1].stamp_ns < struck_ns + 2 * TIMEOUT_MS * 1e6:
                    after.append(stopper.next())
                driving = [f.stamp_ns for f in after if any(f.velocity)]
                assert max(driving) - struck_ns <= TIMEOUT_MS * 1e6
                assert after[-1].velocity == (0.0, 0.0, 0.0)
                everything(run, signal.SIGKILL)
