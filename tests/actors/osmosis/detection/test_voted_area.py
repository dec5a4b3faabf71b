"""The voted DM1: one wrong receiver neither trips it nor blinds it."""

from __future__ import annotations

import asyncio
import math

import pytest
from shapely.geometry import box

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.model import Airport, StartPose
from rampart.actors.osmosis.detection.area.position_vote import GPS, WHEELS, PositionVote
from rampart.actors.osmosis.detection.area.voted_area import VotedArea, VotedPosition
from rampart.actors.runtime.actor import Actor
from rampart.testing import Ear
from tests.actors.osmosis.control.localization_drive import (
    END_S,
    SOURCES,
    STAMPED,
    WRONG_STAMPS,
    Reading,
    Truth,
    disturbed,
    fault,
    mis_stamped,
    sensor_faults,
)
from tests.osmosis_system import in_system, shipped_system

FROM_S = 4.0


def follow(*faults, seed=1, blind_s=10.0, blind_m=5.0):
    """Drive with faults; return the worst error beyond its bound, and how long it knew nothing."""
    return follow_all(disturbed(faults, seed), blind_s, blind_m)


def follow_all(items, blind_s=10.0, blind_m=5.0):
    where = VotedPosition(0.05, blind_s, blind_m)
    worst_m, unknown, seen_s, looked_s = 0.0, 0.0, 0.0, 0.0
    truth = None
    for now_s, item in items:
        if isinstance(item, Truth):
            truth = item
            unknown = max(unknown, now_s - seen_s)
            continue
        feed(where, item, now_s)
        if item.topic is not topics.GPS and now_s - looked_s < 0.1:
            continue
        looked_s, found = now_s, where.look(now_s)
        if found is None or truth is None:
            continue
        fix, stamp_s = found
        seen_s = now_s
        x_m, y_m, _ = truth.at(stamp_s)
        off_m = math.dist((fix.x_m, fix.y_m), (x_m, y_m))
        worst_m = max(worst_m, off_m - fix.accuracy_m)
    return worst_m, unknown


def feed(where: VotedPosition, item: Reading, now_s: float) -> None:
    body, stamp_s = item.body, item.stamp_s
    if item.topic is topics.IMU:
        where.vote.track.imu(body, stamp_s, now_s)
    elif item.topic is topics.ODOMETRY:
        where.odometry(body, stamp_s, now_s)
    elif item.topic is topics.GPS:
        where.gps(body, stamp_s, now_s)
    elif item.topic is topics.BASE_STATUS:
        where.vote.see_encoders(body, stamp_s, now_s)
    else:
        where.vote.see_position(stamp_s, (body.x_m, body.y_m), now_s, body.yaw_rad)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_without_a_fault_it_is_the_gps_fix(seed):
    worst_m, unknown_s = follow(seed=seed)
    assert worst_m < 0.06
    assert unknown_s < 0.15


@pytest.mark.parametrize("name", sensor_faults(*SOURCES))
@pytest.mark.parametrize("how", ["permanent", "intermittent"])
def test_any_single_fault_leaves_it_a_position_that_is_right_to_decimetres(name, how):
    what = fault(name) if how == "permanent" else fault(name, on_s=0.7, off_s=1.6)
    worst_m, unknown_s = follow((what, FROM_S, math.inf))
    assert worst_m < 0.4
    assert unknown_s < 0.45  # shorter than the module's patience


@pytest.mark.parametrize("wrong", WRONG_STAMPS)
@pytest.mark.parametrize("topic", STAMPED, ids=lambda topic: topic.key)
def test_a_source_whose_stamps_are_wrong_is_as_good_as_silent(topic, wrong):
    worst_m, unknown_s = follow_all(mis_stamped(disturbed([]), topic, wrong, FROM_S, once=False))
    assert worst_m < 0.4
    assert unknown_s < 0.45


@pytest.mark.parametrize("wrong", WRONG_STAMPS)
@pytest.mark.parametrize("topic", STAMPED, ids=lambda topic: topic.key)
@pytest.mark.parametrize("later", ["gps-bias", "absolute-pose-bias"])
def test_one_wrong_stamp_is_over_when_another_source_fails_later(topic, wrong, later):
    items = disturbed([(fault(later), FROM_S + 4.0, math.inf)])
    worst_m, unknown_s = follow_all(mis_stamped(items, topic, wrong, FROM_S, once=True))
    assert worst_m < 0.4
    assert unknown_s < 0.45


@pytest.mark.parametrize("topic", STAMPED, ids=lambda topic: topic.key)
def test_one_absurd_number_is_over_too(topic):
    """Finite, and too large for a square: it neither ends the module nor stays in its sums."""

    def items():
        at_s = FROM_S
        for now_s, item in disturbed([(fault("absolute-pose-dropout"), FROM_S + 4.0, math.inf)]):
            for sign in (1e300, -1e300) if now_s >= at_s and isinstance(item, Reading) \
                    and item.topic is topic else ():
                at_s = math.inf
                yield now_s, Reading(topic, now_s - 0.001 - (sign > 0) * 0.001, {
                    topics.GPS: m.GpsFix(sign, sign, sign, sign, abs(sign)),
                    topics.IMU: m.Imu(sign, sign, sign, sign),
                    topics.ODOMETRY: m.Odometry(m.Pose(sign, sign, sign), m.Twist(sign, sign)),
                    topics.ABSOLUTE_POSE: m.Pose(sign, sign, sign)}[topic])
            yield now_s, item

    worst_m, unknown_s = follow_all(items())
    assert worst_m < 0.4
    assert unknown_s < 0.45


@pytest.mark.parametrize(("names", "apart_s", "least_unknown_s"), [
    (("gps-dropout", "absolute-pose-dropout"), 3.0, 3.0),
    (("gps-stuck", "absolute-pose-dropout"), 3.0, 3.0),
    (("gps-bias", "absolute-pose-bias"), 3.0, 3.0), (("gps-dropout", "odom-dropout"), 3.0, 3.0),
    (("absolute-pose-dropout", "odom-dropout"), 3.0, 3.0),
    *(((f"gps-{way}", f"absolute-pose-{way}"), 0.0, 10.0)  # wrong alike
      for way in ("stuck", "stuck-noise", "drift", "slow-drift"))])
def test_after_two_faults_it_knows_nothing_beyond_the_bound_rather_than_something_wrong(
        names, apart_s, least_unknown_s):
    worst_m, unknown_s = follow(*((fault(name), FROM_S + apart_s * i, math.inf)
                                  for i, name in enumerate(names)))
    assert worst_m < 0.6
    assert unknown_s > least_unknown_s


def test_how_long_and_how_far_it_goes_on_blind_is_bounded():
    both = [(fault(name), FROM_S, math.inf) for name in ("gps-dropout", "absolute-pose-dropout")]
    by_way = follow(*both, blind_s=1000.0, blind_m=2.0)[1]
    by_time = follow(*both, blind_s=1.0, blind_m=1000.0)[1]
    never = follow(*both, blind_s=1000.0, blind_m=1000.0)[1]
    assert END_S - FROM_S - 4.0 < by_way < by_time
    assert by_time == pytest.approx(END_S - FROM_S - 1.0, abs=0.5)
    assert never < 0.3


def vote(a, gps, wheels_mps, seconds=3.0, start=0.0, *, encoders_mps=None, drifted_rad=0.0,
         aligned=True):
    """A robot that drives along x with 1 m/s; a, gps: functions of time to an error along y.

    `encoders_mps` is what the base's status says of its wheels; None for no status. The gyro's
    heading is wrong by `drifted_rad`.
    """
    it = PositionVote("a", aligned=aligned)
    for i in range(round(seconds * 50)):
        t = start + 0.02 * i
        it.track.imu(m.Imu(drifted_rad, 0.0, 0.001 * i, 0.0), t, t)
        it.track.odometry(
            m.Odometry(m.Pose(wheels_mps * t, 0.0, 0.0), m.Twist(wheels_mps, 0.0)), t, t)
        if i % 5 == 0 and encoders_mps is not None:
            wheels = (encoders_mps / 0.1175,) * 4
            it.see_encoders(m.BaseStatus(False, False, 0.0, wheels), t, t)
        if i % 5 == 0 and a is not None:
            it.see_position(t, (t, a(t)), t)
        if i % 5 == 0 and gps is not None:
            it.see_gps(m.GpsFix(t, gps(t), 1.0, 0.0, 0.02), t, t)
    return it, start + 0.02 * (round(seconds * 50) - 1)


@pytest.mark.parametrize("drifted_rad", [0.0, 0.5, 3.0])
def test_a_module_that_joins_long_after_the_start_takes_its_heading_from_the_course(drifted_rad):
    it, now_s = vote(none, none, 1.0, 20.0, encoders_mps=1.0, drifted_rad=drifted_rad,
                     aligned=False)
    assert (it.contradicted, it.outlier, it.agreeing(now_s)) == (False, "", ("a", "GPS"))
    assert it.track.heading_rad == pytest.approx(0.0, abs=0.01)
    blind, now_s = vote(none, None, 1.0, 20.0, encoders_mps=1.0, drifted_rad=drifted_rad,
                        aligned=False)
    assert not blind.wheels_agree(now_s)  # no course, and no heading from the position


def none(_t):
    return 0.0


def jump(t):
    return 2.0 if t > 1.0 else 0.0


def drift(t):
    return 0.3 * max(0.0, t - 1.0)


@pytest.mark.parametrize(("a", "gps", "wheels_mps", "agreeing", "outlier"), [
    pytest.param(none, none, 1.0, ("a", GPS), "", id="all agree"),
    pytest.param(none, none, 0.5, ("a", GPS), "", id="the wheels are wrong"),
    pytest.param(jump, none, 1.0, (GPS, WHEELS), "a", id="a is wrong at once"),
    pytest.param(none, jump, 1.0, ("a", WHEELS), GPS, id="GPS is wrong at once"),
    pytest.param(drift, none, 1.0, (GPS, WHEELS), "a", id="a drifts"),
    pytest.param(none, drift, 1.0, ("a", WHEELS), GPS, id="GPS drifts"),
    pytest.param(None, none, 1.0, (GPS, WHEELS), "", id="a is missing"),
    pytest.param(none, None, 1.0, ("a", WHEELS), "", id="GPS is missing"),
    pytest.param(None, drift, 0.5, (), "", id="a is missing, GPS and the wheels differ"),
    pytest.param(None, None, 1.0, (), "", id="both are missing"),
    pytest.param(jump, drift, 0.0, (), "", id="three witnesses, three stories"),
    pytest.param(lambda t: 2.0 if 1.0 < t < 2.0 else 0.0, none, 1.0, ("a", GPS), "",
                 id="a was wrong and agrees again"),
])
def test_two_out_of_three(a, gps, wheels_mps, agreeing, outlier):
    it, now_s = vote(a, gps, wheels_mps)
    assert (it.agreeing(now_s), it.outlier) == (agreeing, outlier)


@pytest.mark.parametrize(("a", "gps", "wheels_mps", "encoders_mps", "agreeing"), [
    pytest.param(none, none, 1.0, 1.0, ("a", GPS), id="all agree"),
    pytest.param(none, none, 0.5, 1.0, ("a", GPS), id="odometry is wrong"),
    pytest.param(none, none, 1.0, 0.5, ("a", GPS), id="the encoders are wrong"),
    pytest.param(none, none, 0.5, 0.5, (), id="two against two"),
    pytest.param(jump, none, 1.0, 0.5, (), id="a is wrong, and nobody knows how it moves"),
    pytest.param(None, none, 1.0, 0.5, (), id="GPS alone, and nobody knows how it moves"),
])
def test_encoders_decide_whether_wheels_count(a, gps, wheels_mps, encoders_mps, agreeing):
    it, now_s = vote(a, gps, wheels_mps, encoders_mps=encoders_mps)
    assert it.agreeing(now_s) == agreeing


# ---- the actor -----------------------------------------------------------------------------------


class Robot(Actor):
    outputs = (topics.ABSOLUTE_POSE, topics.GPS, topics.IMU, topics.ODOMETRY)


LANE = Airport("lane", {"a": (0.0, 0.0), "b": (40.0, 0.0)}, (("a", "b"),),
               box(-5.0, -2.5, 45.0, 2.5), StartPose(0.0, 0.0, 0.0))


@pytest.mark.parametrize(("gps_y_m", "pose_y_m", "expected"), [
    pytest.param(0.0, 0.0, ["idle"], id="in the lane"),
    pytest.param(2.3, 0.0, ["idle"], id="GPS alone says it is on the grass"),
    pytest.param(0.0, 2.3, ["idle"], id="the absolute pose alone says so"),
    pytest.param(2.3, 2.3, ["idle", "active"], id="both say so"),
    pytest.param(None, 0.0, ["idle"], id="GPS is silent"),
    pytest.param(0.0, None, ["idle"], id="the absolute pose is silent"),
    pytest.param(None, None, ["idle", "active"], id="both are silent for 4 m"),
])
@in_system(system=shipped_system(), airport=LANE)
async def test_the_actor_needs_two(system, gps_y_m, pose_y_m, expected):
    """Along the lane with 1 m/s; after 2 s GPS or the absolute pose are wrong, or None: silent."""
    ear, robot = system.start("ear", Ear), system.start("robot", Robot)
    system.start("DM1", VotedArea, margin_m=0.6, blind_s=2.0, blind_m=2.0)
    await system.settle()
    for i in range(120):
        t = 0.05 * i
        gps, pose = (gps_y_m, pose_y_m) if t >= 2.0 else (0.0, 0.0)
        robot.publish(topics.IMU, m.Imu(0.0, 0.001 * i, 0.0, 0.0))
        robot.publish(topics.ODOMETRY, m.Odometry(m.Pose(t, 0.0, 0.0), m.Twist(1.0, 0.0)))
        if pose is not None:
            robot.publish(topics.ABSOLUTE_POSE, m.Pose(t, pose, 0.0))
        if i % 2 == 0 and gps is not None:
            robot.publish(topics.GPS, m.GpsFix(t, gps, 1.0, 0.0, 0.05))
        await asyncio.sleep(0.05)
    assert ear.states == expected


@in_system(system=shipped_system(), airport=LANE)
async def test_a_receiver_that_is_stuck_does_not_blind_it(system):
    """The robot leaves the lane while GPS repeats its last fix: the other two see it."""
    ear, robot = system.start("ear", Ear), system.start("robot", Robot)
    system.start("DM1", VotedArea, margin_m=0.6)
    await system.settle()
    x_m = y_m = 0.0
    for i in range(100):
        away = i >= 40
        x_m, y_m = (x_m, y_m + 0.05) if away else (x_m + 0.05, y_m)
        heading = math.pi / 2 if away else 0.0
        robot.publish(topics.IMU, m.Imu(heading, 0.001 * i, 0.0, 0.0))
        robot.publish(topics.ODOMETRY, m.Odometry(m.Pose(x_m, y_m, heading), m.Twist(1.0, 0.0)))
        robot.publish(topics.ABSOLUTE_POSE, m.Pose(x_m, y_m, heading))
        if i % 2 == 0:
            robot.publish(topics.GPS, m.GpsFix(x_m, 0.0, 0.0 if away else 1.0, 0.0, 0.05))
        await asyncio.sleep(0.05)
        if ear.states[-1:] == ["active"]:
            break
    assert ear.states[-1:] == ["active"]
    assert y_m < 2.5 - 0.5 - 0.25  # half the robot and its braking distance
