"""Bridging a stale pose by odometry, at the one who needs it."""

from __future__ import annotations

import asyncio
import math

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.control.following.dead_reckoning import DeadReckoning
from rampart.actors.osmosis.control.following.osmosis_control import OsmosisControl
from tests.actors.osmosis.control.world import World, full_sweep
from tests.osmosis_system import in_system, shipped_system

PERIOD_S = 0.02


def straight(it: DeadReckoning, from_s: float, to_s: float, speed_mps: float = 1.0) -> None:
    for i in range(round(from_s / PERIOD_S), round(to_s / PERIOD_S) + 1):
        it.odometry(i * PERIOD_S, (speed_mps * i * PERIOD_S, 0.0, 0.0), i * PERIOD_S)


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
        it.odometry(i * PERIOD_S, odom, i * PERIOD_S)
    found = it.estimate(len(moves) * PERIOD_S)
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
