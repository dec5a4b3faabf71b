import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.osmosis.control.following.escape import Escape, EscapeLimits
from rampart.actors.osmosis.control.following.path_follower import PathFollower
from rampart.actors.osmosis.control.following.potential_field import clusters, field, repulsion
from rampart.actors.osmosis.control.pilot.swept_path import StoppingRoom, limited
from rampart.actors.osmosis.control.polyline import Polyline, wrap_angle
from tests.actors.osmosis.control.world import HULL, Circle, World, drive

LINE = [(0.0, 0.0), (20.0, 0.0)]
BENT = [(0.0, 0.0), (8.0, 0.0), (14.0, 6.0), (20.0, 6.0), (20.0, -2.0), (12.0, -6.0)]


def gate(linear, angular, points):
    return limited(linear, angular, points, StoppingRoom())


@pytest.mark.parametrize("route", [LINE, [(0, 0), (10, 0), (10, 10)], BENT])
def test_a_route_is_followed_within_0_3_m(route):
    world = World()
    motion = drive(world, PathFollower(tuple(route)), 60)
    assert motion.arrived
    assert world.deviation(route) < 0.3


def test_a_robot_that_looks_the_wrong_way_turns_before_it_goes():
    world = World(yaw_rad=3.1)
    assert drive(world, PathFollower(tuple(LINE)), 40).arrived
    assert world.deviation(LINE) < 0.3


@pytest.mark.parametrize("radius_m", [0.2, 0.35, 0.5, 0.65])
def test_an_obstacle_exactly_on_the_line_is_passed(radius_m):
    world = World(circles=[Circle(10.0, 0.0, radius_m)])
    motion = drive(world, PathFollower(tuple(LINE)), 60, gate)
    assert motion.arrived
    assert world.least_clearance_m >= 0.25
    assert world.deviation(LINE) <= 1.4
    y = world.track[-1][1]
    assert abs(y) < 0.05, "and the robot is back on the line"


@pytest.mark.parametrize("offset_m", [-0.9, -0.4, -0.1, 0.1, 0.4, 0.9])
def test_an_obstacle_beside_the_line_is_passed_on_the_other_side(offset_m):
    world = World(circles=[Circle(10.0, offset_m, 0.4)])
    assert drive(world, PathFollower(tuple(LINE)), 60, gate).arrived
    assert world.least_clearance_m >= 0.25
    beside = [y for x, y in world.track if abs(x - 10.0) < 0.3]
    assert all(y * offset_m < 0 for y in beside)


@pytest.mark.parametrize("circles", [
    [Circle(7.0, 0.0, 0.4), Circle(12.0, 0.0, 0.4)],
    [Circle(7.0, 0.2, 0.4), Circle(10.0, -0.2, 0.4)],
    [Circle(7.0, 0.5, 0.4), Circle(9.5, -0.5, 0.4)],
    [Circle(7.0, 0.4, 0.3), Circle(7.0, -0.4, 0.3)],
], ids=["in line", "close in line", "slalom", "abreast"])
def test_two_obstacles_are_passed(circles):
    world = World(circles=circles)
    assert drive(world, PathFollower(tuple(LINE)), 60, gate).arrived
    assert world.least_clearance_m >= 0.25
    assert world.deviation(LINE) <= 1.4


@pytest.mark.parametrize("seed", range(8))
def test_random_obstacles_on_a_bent_route_are_passed(seed):
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-1.2, 1.2)
    route = [(0.0, 0.0), (12.0, 0.0), (12.0 + 14 * math.cos(angle), 14 * math.sin(angle))]
    line = Polyline(route)
    circles = []
    for i in range(3):
        x, y = line.point_at(4 + 6.5 * i + rng.uniform(0, 2))
        circles.append(Circle(x + rng.uniform(-0.8, 0.8), y + rng.uniform(-0.8, 0.8),
                              rng.uniform(0.2, 0.6)))
    world = World(circles=circles)
    assert drive(world, PathFollower(tuple(route)), 90, gate).arrived
    assert world.least_clearance_m >= 0.2
    assert world.deviation(route) <= 1.6


@pytest.mark.parametrize("distance_m", [0.5, 0.7, 0.9, 1.2])
def test_an_obstacle_that_is_close_from_the_start_is_still_passed(distance_m):
    world = World(circles=[Circle(0.36 + distance_m + 0.4, 0.0, 0.4)])
    assert drive(world, PathFollower(tuple(LINE)), 60, gate).arrived
    assert world.least_clearance_m >= 0.25


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


def test_the_side_is_kept_although_the_other_looks_better_now():
    escape = Escape(HULL, EscapeLimits())
    ahead = np.array(((2.0, -0.05), (2.0, 0.0), (2.0, 0.05)))
    first = escape.update(ahead, 0.0, 0.0)
    assert first.offset_m < 0.0, "the right, when both are equal"
    second = escape.update(ahead + np.array((0.0, -0.1)), 0.2, -0.1)
    assert second.offset_m < 0.0
    fresh = Escape(HULL, EscapeLimits())
    assert fresh.update(ahead + np.array((0.0, -0.3)), 0.2, 0.0).offset_m > 0.0


def test_behind_the_obstacle_the_offset_shrinks_with_the_way_gone():
    escape = Escape(HULL, EscapeLimits())
    escape.update(np.array(((2.0, 0.0),)), 0.0, 0.0)
    gone = np.zeros((0, 2))
    offsets = [escape.update(gone, s, -0.7).offset_m for s in (2.6, 2.8, 3.0, 4.0, 6.0)]
    assert offsets == sorted(offsets)
    assert offsets[-1] == 0.0


def test_repulsion_pushes_away_and_only_within_its_influence():
    near_left = repulsion(np.array(((0.0, 0.6),)), HULL)
    assert near_left[1] < 0.0 == near_left[0]
    assert repulsion(np.array(((0.0, 0.307 + 0.91),)), HULL) == (0.0, 0.0)
    nearer = repulsion(np.array(((0.0, 0.4),)), HULL)
    assert nearer[1] < near_left[1]


def test_repulsion_does_not_depend_on_the_number_of_echoes():
    one = np.array(((0.0, 0.6),))
    many = np.column_stack((np.zeros(30), 0.6 + np.linspace(0.0, 0.3, 30)))
    assert repulsion(one, HULL) == pytest.approx(
        repulsion(many, HULL))
    assert len(clusters(np.array(((0, 1), (0, 1.1), (3, 1), (3, 1.2))))) == 2


@given(st.floats(-0.3, 0.3), st.floats(0.4, 2.0))
def test_the_field_never_turns_the_robot_about(y_m, x_m):
    x, _ = field(1.0, 0.0, np.array(((x_m, y_m),)), HULL)
    assert x > 0.0


@given(st.floats(-50.0, 50.0))
def test_a_wrapped_angle_is_the_same_direction(angle):
    wrapped = wrap_angle(angle)
    assert -math.pi < wrapped <= math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)


def test_lateral_offset_is_positive_to_the_left():
    line = Polyline([(0.0, 0.0), (10.0, 0.0), (10.0, 10.0)])
    assert line.project(4.0, 0.5).n_m == pytest.approx(0.5)
    assert line.project(10.5, 4.0).n_m == pytest.approx(-0.5)
    assert line.project(10.5, 4.0).s_m == pytest.approx(14.0)
    with pytest.raises(ValueError, match="at least one"):
        Polyline([])
