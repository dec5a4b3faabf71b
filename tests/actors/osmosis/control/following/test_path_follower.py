"""A path is followed past obstacles, with a dragging wheel, and for a while without a pose."""

from __future__ import annotations

import asyncio
import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.control.following.dead_reckoning import DeadReckoning
from rampart.actors.osmosis.control.following.motion_loop import (
    DEAD_BAND_RADPS,
    MOST_RADPS,
    MotionLoop,
)
from rampart.actors.osmosis.control.following.osmosis_control import OsmosisControl
from rampart.actors.osmosis.control.following.path_follower import PathFollower, field, repulsion
from rampart.actors.osmosis.control.pilot.swept_path import StoppingRoom, limited
from rampart.actors.osmosis.control.polyline import Polyline
from tests.actors.osmosis.control.world import HULL, Circle, World, drive, full_sweep
from tests.osmosis_system import in_system, shipped_system

LINE = [(0.0, 0.0), (20.0, 0.0)]
BENT = [(0.0, 0.0), (8.0, 0.0), (14.0, 6.0), (20.0, 6.0), (20.0, -2.0), (12.0, -6.0)]


def gate(linear, angular, points):
    return limited(linear, angular, points, StoppingRoom())


@pytest.mark.parametrize(("route", "yaw_rad"), [
    (LINE, 0.0), (LINE, 3.1), ([(0, 0), (10, 0), (10, 10)], 0.0), (BENT, 0.0)])
def test_a_route_is_followed_within_0_3_m(route, yaw_rad):
    world = World(yaw_rad=yaw_rad)
    motion = drive(world, PathFollower(tuple(route)), 60)
    assert motion.arrived
    assert world.deviation(route) < 0.3


@pytest.mark.parametrize("circles", [
    [Circle(10.0, 0.0, 0.2)], [Circle(10.0, 0.0, 0.65)], [Circle(1.26, 0.0, 0.4)],
    [Circle(10.0, -0.4, 0.4)], [Circle(10.0, 0.9, 0.4)],
    [Circle(7.0, 0.0, 0.4), Circle(12.0, 0.0, 0.4)],
    [Circle(7.0, 0.5, 0.4), Circle(9.5, -0.5, 0.4)],
    [Circle(7.0, 0.4, 0.3), Circle(7.0, -0.4, 0.3)],
], ids=["small", "large", "close from the start", "right", "left", "two", "slalom", "abreast"])
def test_obstacles_are_passed_and_the_robot_is_back_on_the_line(circles):
    world = World(circles=circles)
    assert drive(world, PathFollower(tuple(LINE)), 60, gate).arrived
    assert world.least_clearance_m >= 0.25
    assert world.deviation(LINE) <= 1.4
    assert abs(world.track[-1][1]) < 0.05
    if len(circles) == 1 and circles[0].y_m:
        beside = [y for x, y in world.track if abs(x - 10.0) < 0.3]
        assert all(y * circles[0].y_m < 0 for y in beside), "on the other side"


def test_a_closed_corridor_is_waited_for_and_gone_through_when_it_opens():
    wall = [Circle(7.0, y, 0.4) for y in (-0.9, 0.0, 0.9)]
    world = World(circles=list(wall))
    follower = PathFollower(tuple(LINE))
    motion = drive(world, follower, 20, gate)
    assert motion.waiting
    assert world.linear_mps == 0.0
    assert world.deviation(LINE) < 0.3
    world.circles.clear()
    assert drive(world, follower, 40, gate).arrived


def test_a_respawned_follower_resumes_in_the_middle():
    world = World()
    drive(world, PathFollower(tuple(BENT)), 15)
    middle = world.x_m, world.y_m
    fresh = PathFollower(tuple(BENT))
    first = fresh.step(*middle, world.yaw_rad, world.scan(), 0.05)
    assert first.waypoint > 0
    assert first.distance_to_go_m < Polyline(BENT).length_m - 8.0
    assert drive(world, fresh, 60).arrived
    assert world.deviation(BENT) < 0.3


def test_a_follower_respawned_beside_an_obstacle_stays_on_its_side():
    for side in (-1.0, 1.0):
        world = World(x_m=9.5, y_m=1.2 * side, circles=[Circle(10.0, 0.0, 0.5)])
        assert drive(world, PathFollower(tuple(LINE)), 30, gate).arrived
        assert world.least_clearance_m >= 0.25
        assert all(y * side > -0.1 for _, y in world.track)


def test_speed_turn_and_accelerations_stay_within_limits():
    world = World(circles=[Circle(6.0, 0.0, 0.4)], yaw_rad=1.0)
    follower = PathFollower(tuple(BENT))
    last = (0.0, 0.0)
    for _ in range(900):
        motion = follower.step(world.x_m, world.y_m, world.yaw_rad, world.scan(), 0.05)
        if motion.arrived:
            break
        now = (motion.linear_mps, motion.angular_radps)
        assert 0.0 <= now[0] <= 1.0
        assert abs(now[1]) <= 2.0
        assert now[0] - last[0] <= 0.8 * 0.05 + 1e-9
        assert abs(now[1] - last[1]) <= 4.0 * 0.05 + 1e-9
        last = now
        world.move(*now)
    assert motion.arrived


@pytest.mark.parametrize("along", [0, 1])
def test_repulsion_pushes_away_the_more_the_nearer_and_only_within_its_influence(along):
    def push(distance_m):
        echo = np.zeros((1, 2))
        echo[0, along] = distance_m + (HULL.half_length_m, HULL.half_width_m)[along]
        return repulsion(echo, HULL)

    near, nearer = push(0.3), push(0.1)
    assert nearer[along] < near[along] < 0.0 == near[1 - along]
    assert push(0.91) == (0.0, 0.0)


@given(st.floats(-0.3, 0.3), st.floats(0.4, 2.0))
def test_the_field_never_turns_the_robot_about(y_m, x_m):
    x, _ = field(1.0, 0.0, np.array(((x_m, y_m),)), HULL)
    assert x > 0.0


# ---- the yaw loop, at the robot and at its standby -----------------------------------------------

PERIOD_S = 0.05


def turned(loop, drag_radps, seconds, meant=lambda _t: 0.2, speed_mps=0.8):
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
    rates, _ = turned(MotionLoop(2.0), drag_radps, 8.0)
    assert rates[-1] == pytest.approx(0.2, abs=DEAD_BAND_RADPS + 0.05)


@pytest.mark.parametrize("meant", [
    lambda _t: 0.2, math.sin, lambda t: min(max(4 * (t - 1), 0), 1.5)],
    ids=["constant", "weaving", "into a turn"])
def test_with_a_healthy_base_next_to_nothing_is_added(meant):
    loop = MotionLoop(2.0)
    _, commands = turned(loop, 0.0, 6.0, meant)
    assert max(abs(c - meant(i * PERIOD_S)) for i, c in enumerate(commands)) < 0.05


def test_a_robot_that_stands_winds_nothing_up_and_a_drag_that_is_over_is_unlearnt():
    loop = MotionLoop(2.0)
    for tick in range(100):
        loop.pose(tick * PERIOD_S, 1.0, 2.0, 0.5)
        loop.turn(0.8, 1.0, PERIOD_S)
    assert loop.added_radps == 0.0
    turned(loop, -0.7, 6.0)
    assert loop.turn(0.0, 0.0, PERIOD_S) == 0.0, "standstill is commanded as standstill"
    rates, _ = turned(loop, 0.0, 8.0)
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
    turned(loop, -0.7, 0.9)
    assert loop.added_radps == pytest.approx(0.3, abs=0.02)
    drive_on = [loop.pose(1.0 + i * PERIOD_S, i * 0.04, 0.0, 0.0) or loop.turn(0.8, 0.5, PERIOD_S)
                for i in range(40)]
    assert drive_on[-1] > 0.5 + 0.3


# ---- a stale pose is bridged by odometry ---------------------------------------------------------

ODOMETRY_S = 0.02


def straight(it: DeadReckoning, from_s: float, to_s: float, speed_mps: float = 1.0) -> None:
    for i in range(round(from_s / ODOMETRY_S), round(to_s / ODOMETRY_S) + 1):
        it.odometry(i * ODOMETRY_S, (speed_mps * i * ODOMETRY_S, 0.0, 0.0), i * ODOMETRY_S)


def test_a_stale_pose_is_carried_on_from_its_stamp_not_from_its_arrival():
    it = DeadReckoning(3.0)
    straight(it, 0.0, 2.0)
    assert it.estimate(2.0) is None
    it.pose(0.5, (5.0, 6.0, math.pi / 2), 2.0)  # it arrives 1.5 s late
    assert it.estimate(2.0) == pytest.approx((5.0, 7.5, math.pi / 2))


def test_beyond_the_bound_there_is_no_pose_and_a_fresh_one_helps():
    it = DeadReckoning(2.0)
    straight(it, 0.0, 1.0)
    it.pose(1.0, (0.0, 0.0, 0.0), 1.0)
    straight(it, 1.0, 2.9)
    assert it.estimate(2.9) == pytest.approx((1.9, 0.0, 0.0))
    straight(it, 2.92, 3.1)
    assert it.estimate(3.1) is None
    it.pose(3.1, (9.0, 0.0, 0.0), 3.1)
    assert it.estimate(3.1) == (9.0, 0.0, 0.0)


def test_without_fresh_odometry_a_stale_pose_is_not_bridged():
    it = DeadReckoning(3.0)
    straight(it, 0.0, 1.0)
    it.pose(1.0, (0.0, 0.0, 0.0), 1.0)
    assert it.estimate(1.19) is not None
    assert it.estimate(1.3) is None


@pytest.mark.parametrize(("stamp_s", "pose"), [
    (None, (math.nan, 0.0, 0.0)), (None, (1e160, 1e160, -1e160)),
    *((stamp_s, (50.0, 60.0, 0.0)) for stamp_s in (1e9, 1.3, math.nan))])
def test_an_impossible_reading_changes_nothing_and_shuts_out_none(stamp_s, pose):
    it = DeadReckoning(3.0)
    it.odometry(0.0 if stamp_s is None else stamp_s, pose, 0.0)
    straight(it, 0.0, 1.0)
    it.pose(0.9, (1.0, 2.0, 0.0), 1.0)
    it.pose(1.0 if stamp_s is None else stamp_s, pose, 1.0)
    it.odometry(1.02 if stamp_s is None else stamp_s, pose, 1.02)
    straight(it, 1.04, 1.1)
    assert it.estimate(1.1) == pytest.approx((1.2, 2.0, 0.0))
    it.pose(1.1, (1.3, 2.0, 0.0), 1.1)
    assert it.estimate(1.1) == (1.3, 2.0, 0.0)


moves = st.lists(st.tuples(st.floats(-0.02, 0.02), st.floats(-0.05, 0.05)), min_size=1,
                 max_size=60)


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])  # a busy machine
@given(moves, st.floats(-3, 3), st.floats(-3.1, 3.1), st.floats(-3.1, 3.1))
def test_it_moves_the_pose_as_the_wheels_moved_whatever_the_frame_of_odom(moves, x_m, yaw, start):
    it = DeadReckoning(100.0, after_s=0.0)
    odom, truth = (1.0, -2.0, start), (x_m, 0.5, yaw)
    it.odometry(0.0, odom, 0.0)
    it.pose(0.0, truth, 0.0)
    for i, (forward, turn) in enumerate(moves, start=1):
        odom, truth = ((x + forward * math.cos(w + turn / 2), y + forward * math.sin(w + turn / 2),
                        w + turn) for x, y, w in (odom, truth))
        it.odometry(i * ODOMETRY_S, odom, i * ODOMETRY_S)
    found = it.estimate(len(moves) * ODOMETRY_S)
    assert found is not None
    assert found[:2] == pytest.approx(truth[:2], abs=1e-9)
    assert math.remainder(found[2] - truth[2], math.tau) == pytest.approx(0.0, abs=1e-9)


# ---- in Osmosis Control --------------------------------------------------------------------------


@pytest.mark.parametrize("mis_stamped", [None, topics.ODOMETRY, topics.POSE],
                         ids=["nothing", "odometry", "a pose"])
@in_system(system=shipped_system(), airport=load_airport("vallombre"))
async def test_osmosis_control_drives_on_for_the_bound_and_then_stops(system, mis_stamped):
    """Also after a message from the future."""
    commands = system.hear(topics.COMMAND)
    system.start("control", OsmosisControl, bridge_m=2.0)
    await system.settle()
    world, seen = World(), []
    system.say(topics.ROUTE, m.Route("m", 0, m.Mode.TAXI, True, ((0.0, 0.0), (30.0, 0.0)), ""))
    for i in range(250):
        pose = m.Pose(world.x_m, world.y_m, world.yaw_rad)
        said = {topics.ODOMETRY: m.Odometry(pose, m.Twist(world.linear_mps, 0.0)),
                topics.POSE: pose}
        system.say(topics.ODOMETRY, said[topics.ODOMETRY])
        system.say(topics.SCAN, full_sweep(number=i))
        if world.x_m < 3.0:
            system.say(topics.POSE, pose)
            lost_at_m = world.x_m
        if i == 60 and mis_stamped is not None:
            system.say(mis_stamped, said[mis_stamped], stamp_s=1e9)
        await asyncio.sleep(0.05)
        speed_mps = commands[-1].message.linear_mps
        world.move(speed_mps, 0.0)
        seen.append((world.x_m - lost_at_m, speed_mps))
    assert all(speed > 0.4 for gone_m, speed in seen if 0.3 < gone_m < 1.9)
    assert seen[-1][1] == 0.0
    assert 2.0 < seen[-1][0] < 2.8
