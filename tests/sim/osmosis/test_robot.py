"""The drive's electronics, and how the Summit XL moves in MuJoCo, as bounds with a meaning."""

import math

import pytest

from rampart.sim.osmosis.robot import Drive, DriveLimits, twist_from_wheels
from tests.sim.osmosis.bench import run, world

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


@pytest.mark.parametrize(("linear", "angular"), [
    (1.0, 0.0), (1.0, 0.3), (0.5, -0.8), (-0.5, 0.5), (0.0, -1.0), (0.0, 2.0)])
def test_it_drives_as_it_is_commanded(linear, angular):
    sim = run(world(), linear, angular, 3)
    way_m, turned_rad = 0.0, 0.0
    for _ in range(20):
        x_m, y_m, yaw_rad = sim.pose
        sim.step_to(sim.time_s + 0.05)
        way_m += math.dist(sim.pose[:2], (x_m, y_m))
        turned_rad += math.remainder(sim.pose[2] - yaw_rad, math.tau)
    assert way_m == pytest.approx(abs(linear), rel=0.05, abs=0.02)
    assert turned_rad == pytest.approx(angular, rel=0.05, abs=0.002)


@pytest.mark.parametrize(("brakes", "least_m", "most_m"), [(False, 0.1, 0.25), (True, 0.05, 0.18)])
def test_a_controlled_stop_takes_less_than_25_cm_and_the_brake_less(brakes, least_m, most_m):
    sim = run(world(), 1.0, 0.0, 3)
    x_m = sim.pose[0]
    sim.brake(brakes)
    run(sim, 1.0 if brakes else 0.0, 0.0, 2)
    assert least_m < sim.pose[0] - x_m < most_m
    assert abs(sim.truth().twist.linear_mps) < 0.005
    assert sim.base_status().brake_engaged is brakes


def test_it_stays_on_its_wheels_whatever_is_commanded():
    sim = world()
    for linear, angular in [(3, 3), (-3, 3), (3, -3), (0, 3), (-3, 0), (3, 0)] * 2:
        run(sim, linear, angular, 1.5)
        # Hub height: neither dug in, nor off the ground, nor on its back.
        assert sim._data.qpos[2] == pytest.approx(0.1175, abs=0.02)
        _, qx, qy, _ = sim._data.qpos[3:7]
        assert 1 - 2 * (qx * qx + qy * qy) > 0.98
