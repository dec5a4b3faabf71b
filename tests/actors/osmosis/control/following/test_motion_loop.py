"""The yaw loop against a dragging wheel, at the robot and at its standby."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.osmosis.control.following.motion_loop import (
    DEAD_BAND_RADPS,
    MOST_RADPS,
    MotionLoop,
)

PERIOD_S = 0.05


def drive(loop, drag_radps, seconds, meant=lambda _t: 0.2, speed_mps=0.8):
    """A base that turns by `drag_radps` in addition to its command; returns the last yaw rates."""
    yaw = x = y = rate = 0.0
    rates, commands = [], []
    for tick in range(round(seconds / PERIOD_S)):
        now = tick * PERIOD_S
        loop.pose(now, x, y, yaw)
        command = loop.turn(speed_mps, meant(now), PERIOD_S)
        rate += (1 - math.exp(-PERIOD_S / 0.15)) * (command + drag_radps - rate)
        yaw += rate * PERIOD_S
        x += speed_mps * math.cos(yaw) * PERIOD_S
        y += speed_mps * math.sin(yaw) * PERIOD_S
        rates.append(rate)
        commands.append(command)
    return rates, commands


@pytest.mark.parametrize("drag_radps", [-0.7, 0.3])
def test_a_constant_drag_is_compensated_up_to_the_dead_band(drag_radps):
    rates, _ = drive(MotionLoop(2.0), drag_radps, 8.0)
    assert rates[-1] == pytest.approx(0.2, abs=DEAD_BAND_RADPS + 0.05)


@pytest.mark.parametrize("meant", [
    lambda _t: 0.2, math.sin, lambda t: min(max(4 * (t - 1), 0), 1.5)],
    ids=["constant", "weaving", "into a turn"])
def test_with_a_healthy_base_next_to_nothing_is_added(meant):
    loop = MotionLoop(2.0)
    _, commands = drive(loop, 0.0, 6.0, meant)
    assert max(abs(c - meant(i * PERIOD_S)) for i, c in enumerate(commands)) < 0.05


def test_a_robot_that_stands_winds_nothing_up_and_a_drag_that_is_over_is_unlearnt():
    loop = MotionLoop(2.0)
    for tick in range(100):
        loop.pose(tick * PERIOD_S, 1.0, 2.0, 0.5)
        loop.turn(0.8, 1.0, PERIOD_S)
    assert loop.added_radps == 0.0
    drive(loop, -0.7, 6.0)
    assert loop.turn(0.0, 0.0, PERIOD_S) == 0.0, "standstill is commanded as standstill"
    rates, _ = drive(loop, 0.0, 8.0)
    assert rates[-1] == pytest.approx(0.2, abs=DEAD_BAND_RADPS + 0.05)


@given(st.lists(st.tuples(st.floats(-2, 2), st.floats(-3, 3), st.floats(-9, 9)), max_size=40))
def test_whatever_the_poses_say_the_sum_keeps_its_bound_and_so_does_what_is_added(steps):
    loop = MotionLoop(2.0)
    for tick, (meant, yaw, place) in enumerate(steps):
        loop.pose(tick * PERIOD_S, place, -place, yaw)
        turn = loop.turn(0.5, meant, PERIOD_S)
        assert abs(turn) <= 2.0
        assert abs(loop.added_radps) <= MOST_RADPS
        assert abs(turn - meant) <= MOST_RADPS + 1e-9


def test_a_loop_that_only_listens_adds_what_the_other_does_until_that_is_silent():
    loop = MotionLoop(2.0)
    loop.adopt(0.3, until_s=1.0)
    drive(loop, -0.7, 0.9)
    assert loop.added_radps == pytest.approx(0.3, abs=0.02)
    drive_on = [loop.pose(1.0 + i * PERIOD_S, i * 0.04, 0.0, 0.0) or loop.turn(0.8, 0.5, PERIOD_S)
                for i in range(40)]
    assert drive_on[-1] > 0.5 + 0.3
