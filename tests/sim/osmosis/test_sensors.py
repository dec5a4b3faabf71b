"""Sensor models against geometry, and their noise against their data sheets."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import shapely

from rampart.actors.osmosis.airport.model import (
    Airport,
    Building,
    Light,
    ObstaclePreset,
    StartPose,
    WorldTruth,
)
from rampart.actors.osmosis.airport.photometry import SENSOR_FORWARD_M, illuminance_per_candela
from rampart.sim.osmosis.sensors import LaserSpec, LightSensor, wrap
from rampart.sim.osmosis.world import World
from tests.sim.osmosis.bench import FIELD, world


def field(yaw_rad: float = 0.0, **changes) -> Airport:
    return replace(FIELD, start=StartPose(0, 0, yaw_rad), **changes)


def towards(sim: World, ranges: np.ndarray, bearing_rad: float) -> float:
    index = (bearing_rad - sim.laser.angle_min_rad) / sim.laser.angle_increment_rad
    return float(ranges[round(index)])


# ---- laser --------------------------------------------------------------------------


@pytest.mark.parametrize("yaw_rad", [0.0, 1.0, -2.5])
@pytest.mark.parametrize(
    ("shape", "x_m", "y_m", "radius_m"),
    [("cylinder", 3.0, 0.0, 0.4), ("cylinder", -1.0, 2.0, 0.3), ("box", 2.0, -2.0, 0.5)],
)
def test_the_laser_measures_the_distance_to_an_obstacle_from_the_robots_centre(
    yaw_rad, shape, x_m, y_m, radius_m
):
    preset = ObstaclePreset("o", shape, x_m, y_m, radius_m)
    sim = world(field(yaw_rad, obstacles=(preset,)), obstacles=1, laser=LaserSpec(noise_m=0.0))
    bearing = wrap(math.atan2(y_m, x_m) - yaw_rad)
    if abs(bearing) > math.radians(134):
        assert (sim.scan() == 8.0).all()
        return
    outline = sim.obstacles[0].outline
    # The ray nearest to the bearing, cut with the outline by GEOS.
    index = round((bearing - sim.laser.angle_min_rad) / sim.laser.angle_increment_rad)
    angle = sim.laser.angle_min_rad + index * sim.laser.angle_increment_rad + yaw_rad
    ray = shapely.LineString([(0, 0), (8 * math.cos(angle), 8 * math.sin(angle))])
    expected = shapely.Point(0, 0).distance(ray.intersection(outline))
    assert sim.scan()[index] == pytest.approx(expected, abs=0.005)


def test_the_laser_sees_buildings_and_obstacles_that_appear_move_and_go():
    wall = Building("Wall", 5.0, 0.0, 0.2, 20.0, 3.0)
    sim = world(field(buildings=(wall,)), laser=LaserSpec(noise_m=0.0))
    assert towards(sim, sim.scan(), 0.0) == pytest.approx(4.9)
    sim.add_obstacle("somebody", 3.0, 0.0, 0.5)
    assert towards(sim, sim.scan(), 0.0) == pytest.approx(2.5)
    sim.add_obstacle("somebody", 2.0, 0.0, 0.25)
    assert towards(sim, sim.scan(), 0.0) == pytest.approx(1.75)
    assert sim.remove_obstacle("somebody")
    assert towards(sim, sim.scan(), 0.0) == pytest.approx(4.9)


def test_laser_noise_has_the_stated_deviation_and_no_bias():
    sim = world(field(buildings=(Building("Wall", 3.1, 0.0, 0.2, 4.0, 3.0),)))
    errors = [towards(sim, sim.scan(), 0.0) - 3.0 for _ in range(400)]
    assert abs(np.mean(errors)) < 0.002
    assert np.std(errors) == pytest.approx(sim.laser.noise_m, rel=0.15)


# ---- GPS, IMU, odometry -------------------------------------------------------------


def test_gps_scatters_by_2_cm_round_the_truth():
    sim = world(field())
    fixes = [sim.gps() for _ in range(500)]
    x = [fix.x_m for fix in fixes]
    assert abs(np.mean(x)) < 0.004
    assert np.std(x) == pytest.approx(0.02, rel=0.15)


def test_gps_velocity_is_over_ground_in_the_map_frame():
    sim = world(field(yaw_rad=math.pi / 2))
    sim.command(1.0, 0.0)
    sim.step_to(3)
    fixes = [sim.gps() for _ in range(100)]
    assert np.mean([f.velocity_y_mps for f in fixes]) == pytest.approx(1.0, abs=0.03)
    assert np.mean([f.velocity_x_mps for f in fixes]) == pytest.approx(0.0, abs=0.03)


def test_imu_heading_follows_the_turn_with_a_small_drift():
    sim = world(field())
    sim.command(0.0, 0.5)
    rates = []
    for tick in range(1, 2001):
        sim.step_to(tick * 0.01)
        reading = sim.imu()
        rates.append(reading.yaw_rate_radps)
    assert abs(wrap(reading.yaw_rad - sim.pose[2])) < 0.03
    assert np.mean(rates[500:]) == pytest.approx(0.5, rel=0.05)


def test_odometry_is_good_on_the_straight_and_starts_at_its_own_origin():
    sim = world(field(yaw_rad=1.0))
    sim.command(1.0, 0.0)
    for tick in range(1, 501):
        sim.step_to(tick * 0.02)
        reading = sim.odometry()
    way = math.hypot(*sim.pose[:2])
    assert reading.pose.x_m == pytest.approx(way, rel=0.02)
    assert abs(reading.pose.y_m) < 0.02
    assert reading.twist.linear_mps == pytest.approx(1.0, abs=0.03)


# ---- light sensor -------------------------------------------------------------------

ROW = (Light("L1", "L", 2.0, 0.0, 200), Light("L2", "L", 6.0, 0.0, 200))


def test_illuminance_is_the_sum_over_the_lights_seen_from_the_bracket():
    sensor = LightSensor(field(lights=ROW), WorldTruth(), np.random.default_rng(0))
    pose = (2.0 - SENSOR_FORWARD_M - 0.3, 0.0, 0.0)
    expected = 200 * (illuminance_per_candela(0.3) + illuminance_per_candela(4.3))
    assert sensor.illuminance_lux(pose) == pytest.approx(expected)


def test_a_dark_light_gives_nothing_and_a_dim_one_its_share():
    truth = WorldTruth({"L1": 0.0, "L2": 0.3})
    sensor = LightSensor(field(lights=ROW), truth, np.random.default_rng(0))
    assert sensor.illuminance_lux((2.0 - SENSOR_FORWARD_M, 0.0, 0.0)) < 1.0
    over = sensor.illuminance_lux((6.0 - SENSOR_FORWARD_M, 0.0, 0.0))
    assert over == pytest.approx(60 * illuminance_per_candela(0.0))
