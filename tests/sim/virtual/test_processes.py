"""The processes of a virtual run, as faults see them."""

from __future__ import annotations

from rampart.actors.runtime.actor import Actor
from rampart.testing import virtual_run
from tests import CELL


def test_a_slow_node_is_slow_after_a_restart_too_until_the_fault_ends(monkeypatch):
    paces: list[float] = []
    slow_down = Actor.slow_down

    def noted(self: Actor, pace_s: float) -> None:
        paces.append(pace_s)
        slow_down(self, pace_s)

    monkeypatch.setattr(Actor, "slow_down", noted)
    done = virtual_run(CELL, "slow:gripper:0.02@1+3", "kill:gripper@2", seconds=5.0)
    assert done.record.restarts["gripper"] == 1
    assert paces == [0.02, 0.02, 0.0]
