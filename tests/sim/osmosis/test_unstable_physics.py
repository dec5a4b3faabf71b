"""A world that blows up, or dies, ends its run, which no judge has watched to its end."""

import pytest

from rampart.sim.osmosis.world import World
from rampart.testing import virtual_run

BLOWS_UP_S = 3.0


@pytest.fixture
def blowing_up(monkeypatch):
    tick = World._tick

    def blow_up(self):
        if self.time_s >= BLOWS_UP_S and not self.data.warning.number.any():
            self.data.qvel[0] = 1e12
        tick(self)

    monkeypatch.setattr(World, "_tick", blow_up)


@pytest.mark.usefixtures("blowing_up")
def test_a_run_whose_world_blows_up_ends_at_once_and_is_neither_safe_nor_a_success():
    done = virtual_run("paper", options={"mission": "A"})
    assert (done.record.mission, done.record.safety) == ("fail", "not known")
    assert (done.judgement.success, done.judgement.safe) == (False, None)
    assert done.record.duration_s < BLOWS_UP_S + 0.5
    assert done.record.reasons[0].startswith("physics unstable")


def test_a_run_whose_world_dies_is_neither_safe_nor_a_success(monkeypatch):
    tick = World._tick

    def die(self):
        if self.time_s >= BLOWS_UP_S:
            raise RuntimeError("died")
        tick(self)

    monkeypatch.setattr(World, "_tick", die)
    done = virtual_run("paper", options={"mission": "A"})
    assert (done.record.mission, done.record.safety) == ("fail", "not known")
