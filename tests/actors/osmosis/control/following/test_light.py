import math

import numpy as np
import pytest

from rampart.actors.osmosis.airport.model import Light
from rampart.actors.osmosis.airport.photometry import illuminance_per_candela, sensor_position
from rampart.actors.osmosis.control.following.light_ledger import LightInspection
from rampart.actors.osmosis.control.following.light_row import LightRow, RowLimits
from rampart.actors.osmosis.control.polyline import NO_POINTS
from tests.actors.osmosis.control.world import DT_S, Circle, World, drive

ROW = ((0.0, 0.0), (20.0, 0.0))


def light_row(count=6, spacing_m=3.0):
    return [Light(f"L{i}", "L", 2.0 + spacing_m * i, 0.0, 200.0) for i in range(count)]


def inspect(lights, factors, *, seed=0, pose_delay_s=0.0, blind=(), inspection=None):
    """Drive along the lights; `blind` is an interval of x in which the sensor is silent."""
    rng = np.random.default_rng(seed)
    row = LightRow(((0.0, 0.0), (lights[-1].x_m, 0.0)))
    inspection = inspection or LightInspection(lights)
    world = World(y_m=float(rng.uniform(-0.2, 0.2)))
    found = []
    for tick in range(4000):
        now = tick * DT_S
        motion = row.step(world.x_m, world.y_m, world.yaw_rad, world.scan(), DT_S)
        world.move(motion.linear_mps, motion.angular_radps)
        jitter = rng.normal(0.0, 0.01, 2)
        inspection.pose(now + pose_delay_s, world.x_m + jitter[0], world.y_m + jitter[1],
                        world.yaw_rad)
        if not (blind and blind[0] < world.x_m < blind[1]):
            sensor = sensor_position(world.x_m, world.y_m, world.yaw_rad)
            lux = sum(factors[li.name] * li.nominal_cd * illuminance_per_candela(
                math.dist(sensor, (li.x_m, li.y_m))) for li in lights)
            inspection.sample(now, lux * (1 + rng.normal(0, 0.03)) + rng.normal(0, 5.0))
        found += inspection.take(ended=motion.arrived)
        if motion.arrived:
            return found
    raise AssertionError("the row's end was not reached")


def test_the_robot_waits_for_an_obstacle_and_resumes_a_moment_after_it_is_gone():
    world = World(circles=[Circle(10.0, 0.0, 0.4)])
    row = LightRow(ROW)
    waiting = drive(world, row, 20)
    assert waiting.waiting
    assert world.linear_mps == 0.0
    assert world.clearance() == pytest.approx(1.0, abs=0.1)
    assert world.deviation(list(ROW)) < 0.05, "it never leaves the row"
    world.circles.clear()
    assert drive(world, row, 0.9).linear_mps == 0.0, "free for less than a second"
    assert drive(world, row, 0.5).linear_mps > 0.0
    assert drive(world, row, 40).arrived


def test_a_standby_goes_back_where_the_active_one_does_and_stops_when_it_does():
    row = LightRow(((0.0, 0.0), (40.0, 0.0)), limits=RowLimits(pass_after_s=5.0),
                   edge_m=lambda _x, _y: 9.0)
    row.step(20.0, 0.0, 0.0, NO_POINTS, DT_S)
    for at_m in (15.0, 15.1):
        row.adopt((at_m, 0.0), passing=False)
        assert row.back_to == pytest.approx((15.0, 0.0))
    row.adopt(None, passing=False)
    assert row.back_to is None


@pytest.mark.parametrize(("spacing_m", "pose_delay_s"), [(1.5, 0.12), (4.0, 0.0)])
def test_each_broken_light_is_found_and_no_good_one_accused(spacing_m, pose_delay_s):
    lights = light_row(8, spacing_m)
    factors = dict(zip((li.name for li in lights),
                       (1.0, 0.0, 0.8, 0.35, 0.6, 0.42, 1.0, 0.0), strict=True))
    found = inspect(lights, factors, pose_delay_s=pose_delay_s)
    assert sorted(m.light for m in found) == [li.name for li in lights], "each exactly once"
    for m in found:
        factor = factors[m.light]
        assert m.verdict == ("out" if factor < 0.05 else "dim" if factor < 0.5 else "ok")
        assert m.ratio == pytest.approx(factors[m.light], abs=0.06)
        assert m.intensity_cd == pytest.approx(m.ratio * 200.0)


def test_a_light_whose_samples_are_missing_is_not_judged_until_passed_again():
    lights = light_row(4)
    factors = dict.fromkeys((li.name for li in lights), 1.0)
    inspection = LightInspection(lights)
    first = inspect(lights, factors, blind=(4.3, 4.7), inspection=inspection)
    assert sorted(m.light for m in first) == ["L0", "L2", "L3"]
    again = LightInspection(lights, judged=(m.light for m in first))
    second = inspect(lights, factors, inspection=again)
    assert [(m.light, m.verdict) for m in second] == [("L1", "ok")]


def test_with_a_frozen_pose_nothing_is_judged():
    lights = light_row(3)
    inspection = LightInspection(lights)
    inspection.pose(0.0, 1.5, 0.0, 0.0)
    for tick in range(200):
        inspection.sample(tick * DT_S, 0.0)
        inspection.pose(0.0, 1.5, 0.0, 0.0)
        assert inspection.take() == []
    assert inspection.take(ended=True) == []
