"""The drive's electronics, and how the Summit XL moves in MuJoCo, as bounds with a meaning."""

from __future__ import annotations

import math

import pytest

from rampart.sim.osmosis.robot import Drive, DriveLimits, twist_from_wheels
from rampart.sim.osmosis.world import World
from tests.sim.osmosis.bench import run, world


def steady_rates(sim: World, seconds: float = 1.0) -> tuple[float, float]:
    """Mean forward speed and turning rate over a while, from poses."""
    turned, last, way = 0.0, sim.pose[2], 0.0
    for _ in range(round(seconds / 0.05)):
        px, py, _ = sim.pose
        sim.step_to(sim.time_s + 0.05)
        x, y, yaw = sim.pose
        turned += math.remainder(yaw - last, math.tau)
        way += math.dist((x, y), (px, py))
        last = yaw
    return way / seconds, turned / seconds


# ---- drive --------------------------------------------------------------------------


def test_commands_beyond_the_hardware_are_clipped_and_those_not_finite_refused():
    drive = Drive(DriveLimits(), None)
    assert drive.command(99.0, -99.0, 0.0)
    assert not drive.command(math.nan, 0.0, 5.0)
    assert not drive.command(0.0, math.inf, 5.0)
    for _ in range(500):
        speeds = drive.update(0.0, 0.01)
    assert twist_from_wheels(speeds) == pytest.approx((3.0, -3.0))
    assert drive.command_age_s(6.0) == 6.0  # those refused have refreshed nothing


def test_dead_man_timeline():
    drive = Drive(DriveLimits(), 0.4)
    assert drive.dead_man_tripped(0.0)  # nothing has ever been commanded
    drive.command(1.0, 0.0, 1.0)
    assert not drive.dead_man_tripped(1.4)
    assert drive.dead_man_tripped(1.41)
    drive.update(1.41, 0.01)
    assert drive.braking
    drive.command(1.0, 0.0, 1.5)  # commands are back: it lets go by itself
    drive.update(1.5, 0.01)
    assert not drive.braking


# ---- in MuJoCo ----------------------------------------------------------------------


def test_a_straight_line_is_straight_and_as_fast_as_commanded():
    sim = run(world(), 1.0, 0.0, 2)
    x0 = sim.pose[0]
    sim.step_to(sim.time_s + 10)
    x, y, yaw = sim.pose
    assert x - x0 == pytest.approx(10.0, rel=0.01)
    assert abs(y) < 0.01
    assert abs(yaw) < 0.002


@pytest.mark.parametrize("rate", [-1.0, 0.2, 0.5, 1.0, 2.0])
def test_turning_in_place_follows_the_commanded_rate_and_stays_in_place(rate):
    sim = run(world(), 0.0, rate, 2)
    assert steady_rates(sim)[1] == pytest.approx(rate, rel=0.05)
    assert math.hypot(*sim.pose[:2]) < 0.02


@pytest.mark.parametrize(("linear", "angular"), [(1.0, 0.3), (1.0, 1.0), (0.5, -0.8), (-0.5, 0.5)])
def test_curves_follow_the_commanded_speed_and_rate(linear, angular):
    speed, rate = steady_rates(run(world(), linear, angular, 3))
    assert speed == pytest.approx(abs(linear), rel=0.05)
    assert rate == pytest.approx(angular, rel=0.05)


def test_a_controlled_stop_from_1_mps_takes_less_than_25_cm():
    sim = run(world(), 1.0, 0.0, 3)
    x0 = sim.pose[0]
    run(sim, 0.0, 0.0, 2)
    assert 0.1 < sim.pose[0] - x0 < 0.25
    assert abs(sim.truth().twist.linear_mps) < 0.005


def test_a_braked_robot_stands_still_and_drives_again_when_released():
    sim = world()
    sim.brake(True)
    run(sim, 1.0, 0.5, 3)
    assert math.hypot(*sim.pose[:2]) < 0.002
    sim.brake(False)
    sim.step_to(sim.time_s + 3)
    assert sim.pose[0] > 0.5


def test_it_stays_on_its_wheels_whatever_is_commanded():
    sim = world()
    for linear, angular in [(3, 3), (-3, 3), (3, -3), (0, 3), (-3, 0), (3, 0)] * 2:
        run(sim, linear, angular, 1.5)
        # Hub height: neither dug in, nor off the ground, nor on its back.
        assert sim._data.qpos[2] == pytest.approx(0.1175, abs=0.02)
        _, qx, qy, _ = sim._data.qpos[3:7]
        assert 1 - 2 * (qx * qx + qy * qy) > 0.98
