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


@pytest.mark.parametrize(("shape", "x_m", "y_m", "radius_m", "yaw_rad"), [
    ("cylinder", 3.0, 0.0, 0.4, 1.0), ("cylinder", -1.0, 2.0, 0.3, 0.0),
    ("box", 2.0, -2.0, 0.5, 0.0), ("box", 2.0, -2.0, 0.5, -2.5)])
def test_the_laser_measures_the_distance_to_an_obstacle_from_the_robots_centre(
        shape, x_m, y_m, radius_m, yaw_rad):
    preset = ObstaclePreset("o", shape, x_m, y_m, radius_m)
    sim = world(field(yaw_rad, obstacles=(preset,)), obstacles=1, laser=LaserSpec(noise_m=0.0))
    # The ray nearest to the bearing, cut with the outline by GEOS.
    bearing = wrap(math.atan2(y_m, x_m) - yaw_rad)
    index = round((bearing - sim.laser.angle_min_rad) / sim.laser.angle_increment_rad)
    angle = sim.laser.angle_min_rad + index * sim.laser.angle_increment_rad + yaw_rad
    ray = shapely.LineString([(0, 0), (8 * math.cos(angle), 8 * math.sin(angle))])
    expected = shapely.Point(0, 0).distance(ray.intersection(sim.obstacles[0].outline))
    assert sim.scan()[index] == pytest.approx(expected, abs=0.005)


def test_laser_and_gps_have_the_stated_noise_and_no_bias():
    sim = world(field(buildings=(Building("Wall", 3.1, 0.0, 0.2, 4.0, 3.0),)))
    for errors, sigma_m in (
            ([towards(sim, sim.scan(), 0.0) - 3.0 for _ in range(400)], sim.laser.noise_m),
            ([sim.gps().x_m for _ in range(500)], 0.02)):
        assert abs(np.mean(errors)) < 0.2 * sigma_m
        assert np.std(errors) == pytest.approx(sigma_m, rel=0.15)


# ---- GPS, IMU, odometry -------------------------------------------------------------


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


def test_illuminance_is_the_sum_of_the_real_lights_seen_from_the_bracket():
    truth = WorldTruth({"L1": 0.5})
    sensor = LightSensor(field(lights=ROW), truth, np.random.default_rng(0))
    pose = (2.0 - SENSOR_FORWARD_M - 0.3, 0.0, 0.0)
    expected = 100 * illuminance_per_candela(0.3) + 200 * illuminance_per_candela(4.3)
    assert sensor.illuminance_lux(pose) == pytest.approx(expected)
    readings = [sensor.read(pose) for _ in range(500)]
    assert np.std(readings) / np.mean(readings) == pytest.approx(0.01, rel=0.15)
    assert min(sensor.read((50.0, 50.0, 0.0)) for _ in range(500)) >= 0.0
