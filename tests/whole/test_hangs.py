"""A loop hangs in three ways; the supervisor finds it, and the node is respawned.

On real processes, with nodes of a custom robot.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rampart.testing import RealRun

pytestmark = [pytest.mark.processes, pytest.mark.alone]

NODES = '''
import ctypes
import time

import msgspec

from rampart.actors.bus.messages import Message
from rampart.actors.bus.topic import Qos, Topic
from rampart.actors.runtime.actor import Actor, every


class Count(Message, frozen=True):
    number: int


COUNT = Topic("count", Count, Qos.SENSOR, 50.0, "", "It counts.")


class Loop(Actor):
    """Counts until it hangs; its next incarnation does not."""

    class Parameters(Actor.Parameters, frozen=True):
        how: str = ""

    outputs = (COUNT,)

    def on_start(self) -> None:
        if self._incarnation == 1:
            self.call_later(1.0, self.hang)

    @every(0.02)
    def count(self) -> None:
        self.publish(COUNT, Count(1))

    def hang(self) -> None:
        match self.parameters.how:
            case "sleeps":
                time.sleep(1000)
            case "spins":
                while True:
                    pass
            case "holds the lock":
                ctypes.PyDLL(None).sleep(1000)

'''

SYSTEM = '''
name = "loops"
title = "A loop that hangs"

[timing]
heartbeat_period_s = 0.1
heartbeat_timeout_s = 0.5

[[node]]
name = "loop"
actor = "loops_nodes:Loop"
kind = "control"
respawn = "R"
parameters = {{ how = "{how}" }}

[[node]]
name = "ftm_manager"
actor = "rampart.manager.actor:FtmManager"
kind = "manager"

[[detection]]
name = "D"
title = "Crash"
actor = "rampart.actors.detection.watchdog:Watchdog"
parameters = {{ watch = ["loop"], timeout_s = "heartbeat_timeout_s" }}

[[recovery]]
name = "R"
title = "Respawn"
actor = "rampart.actors.recovery.respawn:Respawn"
kind = "masking"
claims = ["loop"]

[[mechanism]]
name = "M"
detect = "D"
recover = "R"
event = "crash"
against = {{ within_s = 5.0, hazard = "nothing" }}

[[event]]
name = "crash"
title = "Crash"

[orders.safer]
'''


@pytest.mark.parametrize("how", [
    "sleeps", pytest.param("spins", marks=pytest.mark.slow),
    pytest.param("holds the lock", marks=pytest.mark.slow)])
def test_a_loop_that_hangs_is_found_and_replaced(tmp_path: Path, how):
    (tmp_path / "loops_nodes.py").write_text(NODES)
    (tmp_path / "loops.toml").write_text(SYSTEM.format(how=how))
    with RealRun(tmp_path, tmp_path / "loops.toml", "--duration", "4") as run:
        run.wait_for("(D): loop: process of incarnation 1 is hung")
        run.wait_for("loop respawned")
        assert run.process.wait(30) == 0, run.story
    result = json.loads((tmp_path / "stdout.txt").read_text().splitlines()[-1])
    assert result["restarts"] == {"loop": 1}
