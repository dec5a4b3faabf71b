"""DM13: wheels or a brake that do not follow the commands."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.osmosis.detection.actuator_failure import ActuatorMonitor, MotionLimits

LIMITS = MotionLimits(hold_s=5.0)
RADIUS_M = LIMITS.wheel_radius_m
STATUS_S = 0.1


class Bench:
    def __init__(self) -> None:
        self.monitor = ActuatorMonitor(LIMITS)
        self.now = 0.0

    def run(self, seconds, treads=(0.8, 0.8, 0.8, 0.8), command=(0.8, 0.0), ground=None,
            braking=False):
        """Let time pass with the same wheels, command, speed over ground and brake."""
        for _ in range(round(seconds / STATUS_S)):
            self.now += STATUS_S
            self.monitor.commanded(*command, self.now)
            if ground is not None:
                self.monitor.moved(ground, 0.0, self.now)
            self.monitor.status(tuple(t / RADIUS_M for t in treads), braking=braking,
                                now_s=self.now)
            while self.monitor.due_s <= self.now:
                self.monitor.expire(self.monitor.due_s)
        return self.monitor.active


@pytest.mark.parametrize("kept", [
    {"ground": 0.8}, {"treads": (0.0,) * 4, "braking": True},
    *({"treads": treads, "command": (0.6, 0.9), "ground": 0.6}  # its two sides differ rightly
      for treads in ((0.2, 1.0, 0.2, 1.0), (-0.5, 0.5, -0.5, 0.5))),
    *({"treads": (nonsense, 0.8, 0.8, 0.8)} for nonsense in (math.nan, math.inf))])
def test_a_sound_base_is_left_alone(kept):
    assert not Bench().run(10, **kept)


@pytest.mark.parametrize(("treads", "wheel"), [
    ((0.0, 0.8, 0.8, 0.8), "front left"), ((0.8, 0.0, 0.8, 0.8), "front right"),
    ((0.8, 0.8, 0.5, 0.8), "rear left"), ((-0.6, 0.6, -0.6, 0.3), "rear right")])
def test_a_wheel_that_does_not_keep_up_is_named_within_a_second(treads, wheel):
    bench = Bench()
    assert bench.run(0.9, treads)
    assert bench.monitor.reason == f"the {wheel} wheel lags behind its neighbour"


def test_a_jolt_is_no_failure():
    bench = Bench()
    for _ in range(10):
        bench.run(0.3, (0.2, 0.8, 0.8, 0.8))
        assert not bench.run(0.2)


def test_a_speed_over_ground_that_is_not_the_one_commanded_is_seen():
    bench = Bench()
    assert not bench.run(1.5, ground=0.3), "the wheels turn"
    assert bench.run(1.0, ground=0.3)
    other = Bench()
    other.run(3, ground=0.8)
    assert other.run(3, command=(0.0, 0.0), ground=0.8), "it goes on when it should stand"


def test_while_the_command_changes_the_speed_is_the_ramps_business():
    bench = Bench()
    for step in range(30):
        assert not bench.run(0.1, command=(0.03 * step, 0.0), ground=max(0.0, 0.03 * step - 0.3))


@pytest.mark.parametrize(("deceleration", "found"), [(2.0, False), (5.0, False), (0.4, True)])
def test_a_brake_is_judged_while_it_is_on(deceleration, found):
    bench = Bench()
    bench.run(1.0)
    for tick in range(8):
        speed = max(0.0, 0.8 - deceleration * tick * STATUS_S)
        bench.run(STATUS_S, (speed,) * 4, braking=True)
    assert bench.monitor.active is found
    assert ("brake" in bench.monitor.reason) is found


def test_a_finding_stays_a_while_after_the_last_evidence():
    bench = Bench()
    bench.run(1.0, (0.0, 0.8, 0.8, 0.8))
    assert bench.run(4.5)
    assert not bench.run(1.0)


@given(st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1)), min_size=1, max_size=30))
def test_neighbours_that_turn_alike_are_never_accused(sides):
    bench = Bench()
    for left, right in sides:
        assert not bench.run(STATUS_S, (left, right, left, right), (left, right - left))
