"""Sensor models against geometry and data sheets, and the simulator that publishes them."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import shapely

from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport import model
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.airport.photometry import SENSOR_FORWARD_M, illuminance_per_candela
from rampart.actors.runtime.actor import Header
from rampart.sim.osmosis.sensors import LaserSpec, LightSensor, wrap
from rampart.sim.osmosis.simulator import Simulator
from rampart.sim.osmosis.world import World
from tests.sim.osmosis.bench import FIELD, Bench, world


def field(yaw_rad: float = 0.0, **changes) -> model.Airport:
    return replace(FIELD, start=model.StartPose(0, 0, yaw_rad), **changes)


def towards(sim: World, ranges: np.ndarray, bearing_rad: float) -> float:
    index = (bearing_rad - sim.laser.angle_min_rad) / sim.laser.angle_increment_rad
    return float(ranges[round(index)])


# ---- laser --------------------------------------------------------------------------


@pytest.mark.parametrize(("shape", "x_m", "y_m", "radius_m", "yaw_rad"), [
    ("cylinder", 3.0, 0.0, 0.4, 1.0), ("cylinder", -1.0, 2.0, 0.3, 0.0),
    ("box", 2.0, -2.0, 0.5, 0.0), ("box", 2.0, -2.0, 0.5, -2.5)])
def test_the_laser_measures_the_distance_to_an_obstacle_from_the_robots_centre(
        shape, x_m, y_m, radius_m, yaw_rad):
    preset = model.ObstaclePreset("o", shape, x_m, y_m, radius_m)
    sim = world(field(yaw_rad, obstacles=(preset,)), obstacles=1, laser=LaserSpec(noise_m=0.0))
    # The ray nearest to the bearing, cut with the outline by GEOS.
    bearing = wrap(math.atan2(y_m, x_m) - yaw_rad)
    index = round((bearing - sim.laser.angle_min_rad) / sim.laser.angle_increment_rad)
    angle = sim.laser.angle_min_rad + index * sim.laser.angle_increment_rad + yaw_rad
    ray = shapely.LineString([(0, 0), (8 * math.cos(angle), 8 * math.sin(angle))])
    expected = shapely.Point(0, 0).distance(ray.intersection(sim.obstacles[0].outline))
    assert sim.scan()[index] == pytest.approx(expected, abs=0.005)


def test_laser_and_gps_have_the_stated_noise_and_no_bias():
    sim = world(field(buildings=(model.Building("Wall", 3.1, 0.0, 0.2, 4.0, 3.0),)))
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

ROW = (model.Light("L1", "L", 2.0, 0.0, 200), model.Light("L2", "L", 6.0, 0.0, 200))


def test_illuminance_is_the_sum_of_the_real_lights_seen_from_the_bracket():
    truth = model.WorldTruth({"L1": 0.5})
    sensor = LightSensor(field(lights=ROW), truth, np.random.default_rng(0))
    pose = (2.0 - SENSOR_FORWARD_M - 0.3, 0.0, 0.0)
    expected = 100 * illuminance_per_candela(0.3) + 200 * illuminance_per_candela(4.3)
    assert sensor.illuminance_lux(pose) == pytest.approx(expected)
    readings = [sensor.read(pose) for _ in range(500)]
    assert np.std(readings) / np.mean(readings) == pytest.approx(0.01, rel=0.15)
    assert min(sensor.read((50.0, 50.0, 0.0)) for _ in range(500)) >= 0.0


# ---- the actor: topics, rates, stamps, and what it does with its inputs --------------------------

bench_at = partial(Bench, load_airport("vallombre"))


def test_every_topic_of_the_summit_xl_layer_and_the_world_comes_at_its_rate():
    bench = bench_at(upper_laser=True)
    bench.run(2.0)
    counts = Counter(key for key, _, _ in bench.sent)
    readings = [topic for topic in Simulator.outputs if topic is not ftm_topics.HOLDS]
    assert set(counts) == {topic.key for topic in readings}
    for topic in readings:
        assert counts[topic.key] == pytest.approx(2 * topic.rate_hz, abs=1)


def test_a_robot_with_one_laser_has_one_and_with_two_both_see_the_same_with_noise_of_their_own():
    one, two = bench_at(), bench_at(upper_laser=True)
    for bench in (one, two):
        bench.run(1.0)
    assert topics.UPPER_SCAN.key not in {key for key, _, _ in one.sent}
    assert one.last(topics.SCAN) == two.last(topics.SCAN)  # the second disturbs nothing
    lower, upper = (np.frombuffer(two.last(topic).ranges_f32, "<f4")
                    for topic in (topics.SCAN, topics.UPPER_SCAN))
    assert two.last(topics.SCAN).reference_m != two.last(topics.UPPER_SCAN).reference_m
    assert upper == pytest.approx(lower, abs=0.15)
    assert np.array_equal(upper >= 8.0, lower >= 8.0)


def test_commands_move_the_robot_and_the_brake_holds_it_until_the_last_who_holds_it_lets_go():
    bench = bench_at()
    start = bench.actor._world.pose
    bench.run(2.0, m.BaseCommand(0.5, 0.0))
    assert bench.last(topics.TRUTH).twist.linear_mps == pytest.approx(0.5, abs=0.02)
    assert bench.last(topics.ABSOLUTE_POSE).y_m < start[1] - 0.5  # it faces south
    for source, engaged, brakes in (
            ("RM1", True, True), ("RM7", False, True), ("RM7", True, True), ("RM1", False, True),
            ("RM1", False, True), ("RM7", False, False)):
        bench.actor.brake(m.BrakeCommand(engaged, "test"), Header(source, 1, 1, bench.now_s))
        bench.run(1.0, m.BaseCommand(0.5, 0.0))
        assert bench.last(topics.BASE_STATUS).brake_engaged is brakes
        assert (bench.last(topics.TRUTH).twist.linear_mps < 0.01) is brakes


def test_an_old_command_does_not_keep_the_dead_man_quiet():
    bench = bench_at()
    for _ in range(50):
        bench.run(0.02)
        bench.actor.command(m.BaseCommand(0.5, 0.0), bench.header(age_s=2.0))
    assert bench.last(topics.BASE_STATUS).dead_man_tripped


def test_obstacles_come_and_go_by_message_and_are_published_at_once():
    bench = bench_at(obstacles=2)
    bench.run(1.0)
    assert {o.name for o in bench.last(topics.OBSTACLES).obstacles} == {"crate", "drum"}
    order = m.ObstacleCommand("box", True, -27.0, 8.0, 0.3)
    bench.actor.obstacle(order, bench.header())
    assert order in bench.last(topics.OBSTACLES).obstacles
    bench.run(0.2)
    ranges = np.frombuffer(bench.last(topics.SCAN).ranges_f32, dtype="<f4")
    assert ranges.min() == pytest.approx(2.7, abs=0.1)
    bench.actor.obstacle(m.ObstacleCommand("box", False, 0, 0, 0), bench.header())
    assert "box" not in {o.name for o in bench.last(topics.OBSTACLES).obstacles}


def test_an_impossible_order_is_reported_and_changes_nothing():
    bench = bench_at()
    bench.actor.obstacle(m.ObstacleCommand("x", True, -27.0, 11.0, 0.3), bench.header())
    bench.actor.command(m.BaseCommand(float("nan"), 0.0), bench.header())
    assert [what for what, *_ in bench.complaints] == ["obstacle", "velocity command"]
    assert "on the robot" in bench.complaints[0][1]
    assert bench.actor._world.obstacles == ()


def test_held_up_it_publishes_fresh_readings_and_owns_up_to_the_loss():
    bench = bench_at()
    bench.run(1.1)
    assert bench.last(topics.TRUTH).real_time_factor == 1.0
    bench.sent.clear()
    bench.now_s += 30.0
    bench.actor.tick()
    assert min(stamp for _, _, stamp in bench.sent) > bench.now_s - 1.1
    bench.run(1.1)
    assert bench.last(topics.TRUTH).real_time_factor < 1.0 + 1e-9
    assert any(b.real_time_factor < 0.2 for k, b, _ in bench.sent if k == topics.TRUTH.key)
