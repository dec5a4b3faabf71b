"""DM1: the robot that would not stop before the grass, also voted; DM8: a wrong localization."""

from __future__ import annotations

import asyncio
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from shapely.geometry import box

from rampart.actors.detection.freshness import FreshnessMonitor
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.model import Airport, StartPose
from rampart.actors.osmosis.detection.area.estimation_error import EstimationMonitor
from rampart.actors.osmosis.detection.area.position_vote import GPS, WHEELS, PositionVote
from rampart.actors.osmosis.detection.area.prohibited_area import (
    FenceLimits,
    FenceMonitor,
    ProhibitedArea,
    half_diagonal_m,
    intrusion,
)
from rampart.actors.osmosis.detection.area.voted_area import VotedArea, VotedPosition
from rampart.actors.osmosis.messages import GpsFix
from rampart.testing import Ear, play, table
from tests.actors.osmosis.control import localization_drive as trip
from tests.osmosis_system import in_system, shipped_system

LANE = Airport("lane", {"a": (0.0, 0.0), "b": (40.0, 0.0)}, (("a", "b"),),
               box(-5.0, -2.5, 45.0, 2.5), StartPose(0.0, 0.0, 0.0))


LIMITS = FenceLimits(half_diagonal_m=0.473, reaction_s=0.3, braking_mps2=2.0)
ACCURACY_M = 0.05
HALF_LANE_M = 2.5


def lane(_x_m: float, y_m: float) -> float:
    """Signed distance to the grass on both sides of a lane along x, 5 m wide."""
    return HALF_LANE_M - abs(y_m)


def fix(y_m: float, speed_mps: float, course_deg: float, x_m: float = 0.0) -> GpsFix:
    course = math.radians(course_deg)
    return GpsFix(x_m, y_m, speed_mps * math.cos(course), speed_mps * math.sin(course), ACCURACY_M)


@pytest.mark.parametrize(("y_m", "speed_mps", "course_deg", "alarm"), **table({
    "skirting it, nearly parallel, outward": (1.5, 1.0, 20.0, False),
    "straight at the edge, no room left": (1.5, 1.0, 90.0, True),
    "straight at the edge from 1 m aside": (1.0, 1.0, 90.0, False),
    "standing with a corner nearly on the grass": (2.0, 0.0, 0.0, True),
    "the same, driving away from it": (2.0, 0.5, -90.0, True),
    "standing as near as is allowed": (1.95, 0.0, 0.0, False),
}))
def test_alarm_in_a_lane_of_5_m(y_m, speed_mps, course_deg, alarm):
    assert bool(intrusion(fix(y_m, speed_mps, course_deg), lane, LIMITS)) is alarm


def test_a_corner_in_the_way_is_found_though_both_ends_of_the_path_are_clear():
    def post(x_m: float, y_m: float) -> float:
        return math.hypot(x_m - 0.6, y_m - 0.5) - 0.05

    assert "would touch" in intrusion(fix(0.0, 2.0, 0.0), post, LIMITS)
    assert intrusion(fix(0.0, 2.0, 180.0), post, LIMITS) == ""


@given(y_m=st.floats(-2.4, 2.4), speed_mps=st.floats(0.0, 3.0), course_deg=st.floats(-180, 180))
def test_a_robot_that_brakes_at_the_alarm_never_touches_the_grass(y_m, speed_mps, course_deg):
    """Drive on in a straight line until the first alarm, react, brake: the footprint stays off."""
    course = math.radians(course_deg)
    step_s = 0.1
    position = y_m
    if intrusion(fix(position, speed_mps, course_deg), lane, LIMITS):
        return  # it starts too near; there is nothing to prevent any more
    for _ in range(200):
        position += speed_mps * math.sin(course) * step_s
        if intrusion(fix(position, speed_mps, course_deg), lane, LIMITS):
            break
    else:
        assert abs(math.sin(course)) * speed_mps < 0.2
        return
    # The alarm came with this fix; its reaction time includes the period since the last one.
    rest_s = LIMITS.reaction_s - step_s
    stop = position + math.sin(course) * (
        speed_mps * rest_s + speed_mps**2 / (2 * LIMITS.braking_mps2))
    assert lane(0.0, stop) >= LIMITS.half_diagonal_m


def fence() -> FenceMonitor:
    return FenceMonitor(lane, LIMITS, FreshnessMonitor("GPS", 0.3, 0.2, 0.0, 0.5), hold_s=0.3)


# m in the middle, e at the edge, c cleared by less than the hysteresis; n a fix of no numbers,
# o the first fix once more, b a fix with a bad accuracy, v one with a velocity that cannot be;
# in the middle with a wrong stamp: + far ahead, i infinite, t no number
FIXES = {
    "m": fix(0.0, 1.0, 0.0), "o": fix(0.0, 1.0, 0.0), "e": fix(2.0, 0.0, 0.0),
    "c": fix(1.95, 0.0, 0.0), "n": GpsFix(math.nan, 0.0, 0.0, 0.0, 0.05),
    "b": GpsFix(0.0, 0.0, 0.0, 0.0, 4.0), "w": GpsFix(0.0, 0.0, 0.0, 0.0, -1.0),
    "v": GpsFix(0.0, 0.0, 1.7e308, 1e155, 0.05),
}
STAMPS = {"o": 0.0, "+": 1e9, "i": math.inf, "t": math.nan}


@pytest.mark.parametrize(("events", "expected"), **table({
    "at the edge, at once": ("mmem", "--AA"),
    "back on the lane for long enough": ("memmmm", "-AAAA-"),
    "back by less than the hysteresis": ("mecccccc", "-AAAAAAA"),
    "no fix ever": ("......", "-----A"),
    "the fixes cease, and come again": ("mm.....mmm", "----AAAAA-"),
    "fixes without numbers are none, nor a negative accuracy": ("mnwnwn", "---AAA"),
    "a velocity that cannot be is none": ("mvvvvv", "---AAA"),
    "and does no harm to those after it": ("mvmmvm", "------"),
    "fixes from the future or of no time are none": ("m+iti+", "---AAA"),
    "and shut out none": ("+mm+mm", "------"),
    "a fix from the future does not say that it is safe again": ("me++++", "-AAAAA"),
    "a frozen receiver": ("moooooo", "---AAAA"),
    "a receiver that has lost its accuracy is no barrier": ("mb", "-A"),
    "at the edge, then blind": ("e.....", "AAAAAA"),
}))
def test_fence_timeline(events, expected):
    monitor = fence()

    def handle(event: str, now_s: float) -> None:
        monitor.fix(FIXES.get(event, FIXES["m"]), STAMPS.get(event, now_s), now_s)

    assert play(monitor, handle, events) == expected


@in_system(system=shipped_system(), airport=LANE)
async def test_the_actor_warns_in_time_by_the_margins_of_the_shipped_system(system):
    spec, ear = shipped_system(), system.start("ear", Ear)
    detection = next(d for d in spec.detections if d.name == "DM1")
    system.start("DM1", ProhibitedArea, **detection.parameters)
    y_m = 0.0
    for _ in range(20):  # along the lane, then straight at its edge with top speed
        system.say(topics.GPS, m.GpsFix(0.0, 0.0, 1.0, 0.0, 0.05))
        await asyncio.sleep(0.1)
    assert ear.states == ["idle"]
    while ear.states == ["idle"]:
        y_m += 0.1
        system.say(topics.GPS, m.GpsFix(20.0, y_m, 0.0, 1.0, 0.05))
        await asyncio.sleep(0.1)
    room_m = HALF_LANE_M - y_m - half_diagonal_m(spec.robot)
    brakes_m = 1.0 / (2 * spec.robot.braking_mps2)
    assert room_m >= spec.timing.arbitration_s + spec.timing.actuation_s + brakes_m
    assert room_m < 0.8


# ---- the voted DM1: one wrong receiver neither trips it nor blinds it ----------------------------

FROM_S = 4.0


def follow(*faults, blind_s=10.0, blind_m=5.0) -> trip.Voted:
    voted = trip.Voted(VotedPosition(0.05, blind_s, blind_m))
    trip.watch(trip.disturbed(faults), voted)
    return voted


@pytest.mark.parametrize("topic", trip.STAMPED, ids=lambda topic: topic.key)
def test_one_wrong_stamp_is_over_when_another_source_fails_later(topic):
    later = "absolute-pose-bias" if topic is topics.GPS else "gps-bias"
    items, voted = trip.disturbed([(trip.fault(later), FROM_S + 4.0, math.inf)]), trip.Voted()
    items = trip.mis_stamped(items, topic, "far ahead", FROM_S, once=True)
    trip.watch(items, voted, to_s=FROM_S + 10.0)
    assert voted.worst_m < 0.4
    assert voted.unknown_s < 0.45


@pytest.mark.parametrize("names", [
    ("gps-stuck", "absolute-pose-dropout"), ("gps-bias", "absolute-pose-bias"),
    ("gps-dropout", "odom-dropout"), ("absolute-pose-dropout", "odom-dropout")])
def test_after_two_faults_it_knows_nothing_beyond_the_bound_rather_than_something_wrong(names):
    voted = follow(*((trip.fault(name), FROM_S + 3.0 * i, math.inf)
                     for i, name in enumerate(names)))
    assert voted.worst_m < 0.6
    assert voted.unknown_s > 3.0


def test_how_long_and_how_far_it_goes_on_blind_is_bounded():
    both = [(trip.fault(f"{name}-dropout"), FROM_S, math.inf) for name in ("gps", "absolute-pose")]
    by_way = follow(*both, blind_s=1000.0, blind_m=2.0).unknown_s
    by_time = follow(*both, blind_s=1.0, blind_m=1000.0).unknown_s
    never = follow(*both, blind_s=1000.0, blind_m=1000.0)
    assert trip.END_S - FROM_S - 4.0 < by_way < by_time
    assert by_time == pytest.approx(trip.END_S - FROM_S - 1.0, abs=0.5)
    assert never.unknown_s < 0.3
    assert never.worst_m < 0.6


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


@pytest.mark.parametrize("drifted_rad", [0.0, 3.0])
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


@pytest.mark.parametrize(("witnesses", "agreeing", "outlier"), **table({
    "a is wrong at once": ((jump, none, 1.0, None), (GPS, WHEELS), "a"),
    "GPS is wrong at once": ((none, jump, 1.0, None), ("a", WHEELS), GPS),
    "GPS drifts": ((none, drift, 1.0, None), ("a", WHEELS), GPS),
    "a is missing": ((None, none, 1.0, None), (GPS, WHEELS), ""),
    "GPS is missing": ((none, None, 1.0, None), ("a", WHEELS), ""),
    "a is missing, GPS and the wheels differ": ((None, drift, 0.5, None), (), ""),
    "both are missing": ((None, None, 1.0, None), (), ""),
    "three witnesses, three stories": ((jump, drift, 0.0, None), (), ""),
    "a was wrong and agrees again": ((lambda t: 2.0 if 1.0 < t < 2.0 else 0.0, none, 1.0, None),
                                     ("a", GPS), ""),
    "all agree, with encoders": ((none, none, 1.0, 1.0), ("a", GPS), ""),
    "odometry is wrong": ((none, none, 0.5, 1.0), ("a", GPS), ""),
    "the encoders are wrong": ((none, none, 1.0, 0.5), ("a", GPS), ""),
    "two against two": ((none, none, 0.5, 0.5), (), ""),
    "a is wrong, and it is not known how it moves": ((jump, none, 1.0, 0.5), (), ""),
    "GPS alone, and it is not known how it moves": ((None, none, 1.0, 0.5), (), ""),
}))
def test_two_out_of_three_and_encoders_decide_whether_wheels_count(
        witnesses, agreeing, outlier):
    """The witnesses: a, GPS, odometry in m/s, and encoders in m/s or None."""
    *three, encoders_mps = witnesses
    it, now_s = vote(*three, encoders_mps=encoders_mps)
    assert (it.agreeing(now_s), it.outlier) == (agreeing, outlier)


# ---- the actor -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("gps_y_m", "pose_y_m", "expected"), [
    pytest.param(2.3, 0.0, ["idle"], id="GPS alone says it is on the grass"),
    pytest.param(0.0, 2.3, ["idle"], id="the absolute pose alone says so"),
    pytest.param(2.3, 2.3, ["idle", "active"], id="both say so"),
    pytest.param(None, 0.0, ["idle"], id="GPS is silent"),
    pytest.param(None, None, ["idle", "active"], id="both are silent for 4 m"),
])
@in_system(system=shipped_system(), airport=LANE)
async def test_the_actor_needs_two(system, gps_y_m, pose_y_m, expected):
    """Along the lane with 1 m/s; after 2 s GPS or the absolute pose are wrong, or None: silent."""
    ear = system.start("ear", Ear)
    system.start("DM1", VotedArea, margin_m=0.6, blind_s=2.0, blind_m=2.0)
    await system.settle()
    for i in range(120):
        t = 0.05 * i
        gps, pose = (gps_y_m, pose_y_m) if t >= 2.0 else (0.0, 0.0)
        system.say(topics.IMU, m.Imu(0.0, 0.001 * i, 0.0, 0.0))
        system.say(topics.ODOMETRY, m.Odometry(m.Pose(t, 0.0, 0.0), m.Twist(1.0, 0.0)))
        if pose is not None:
            system.say(topics.ABSOLUTE_POSE, m.Pose(t, pose, 0.0))
        if i % 2 == 0 and gps is not None:
            system.say(topics.GPS, m.GpsFix(t, gps, 1.0, 0.0, 0.05))
        await asyncio.sleep(0.05)
    assert ear.states == expected


# ---- DM8: faults of other sources do not count as its own ----------------------------------------

def accusations(lie=trip.honest, to_s=trip.END_S, monitor=None) -> list[tuple[float, float]]:
    accused = trip.Accused(lie, monitor or EstimationMonitor(-math.inf))
    trip.watch(trip.disturbed([]), accused, to_s=to_s)
    return accused.spans


def lying(x_m=0.0, y_m=0.0, yaw_rad=0.0, *, per_s=False, to_s=math.inf):
    def lie(truth: trip.Truth, now_s: float) -> m.Pose:
        share = 0.0
        if FROM_S <= now_s < to_s:
            share = now_s - FROM_S if per_s else 1.0
        return m.Pose(truth.x_m + share * x_m, truth.y_m + share * y_m,
                      truth.yaw_rad + share * yaw_rad)

    return lie


def test_a_localization_that_is_silent_is_not_accused():
    assert accusations(lambda t, now_s: trip.honest(t, now_s) if now_s < FROM_S else None) == []


@pytest.mark.parametrize(("lie", "within_s"), [
    pytest.param(lying(0.7, 0.7), 0.25, id="a metre aside"),
    pytest.param(lying(0.0, 0.25, per_s=True), 1.6, id="prohibited-area: drifting north"),
    pytest.param(lying(-0.1, 0.1, per_s=True), 2.6, id="drifting slowly"),
    pytest.param(lying(0.0, 0.0, 0.5), 0.8, id="turned on the spot"),
    pytest.param(lying(2.0, 0.0, 1.0), 0.25, id="wrong in all"),
])
def test_a_lie_is_found_out_in_time_and_forgiven_when_it_ends(lie, within_s):
    ((since_s, until_s),) = accusations(lie)
    assert FROM_S < since_s <= FROM_S + within_s
    assert until_s == math.inf
    ((_, until_s),) = accusations(lying(0.7, 0.7, to_s=8.0), 9.0)
    assert 8.0 < until_s <= 8.6, "forgiven within half a second of honesty"


def test_a_pose_that_is_stuck_with_fresh_stamps_is_found_out_within_half_a_metre():
    kept: list[m.Pose] = []

    def stuck(truth: trip.Truth, now_s: float) -> m.Pose:
        if now_s < FROM_S:
            return trip.honest(truth, now_s)
        kept.append(trip.honest(truth, now_s))
        return kept[0]

    (since_s, _), *_ = accusations(stuck, FROM_S + 3.0)
    truth = next(t for t in trip.drive() if isinstance(t, trip.Truth) and t.stamp_s >= since_s)
    assert math.dist((truth.x_m, truth.y_m), (kept[0].x_m, kept[0].y_m)) < 0.55


def test_a_respawned_module_claims_nothing_before_it_has_compared_or_waited():
    monitor = EstimationMonitor(1.0)
    assert (monitor.known, monitor.due_s) == (False, 1.0)
    for x_m, stamp_s in ((0.0, 1e9), (0.0, math.nan), (math.nan, 0.0), (math.inf, 0.0)):
        monitor.pose(m.Pose(x_m, 0.0, 0.0), stamp_s, 0.0, "localization#1")
    monitor.expire(0.5)
    assert not monitor.known
    accusations(to_s=0.3, monitor=monitor)  # what cannot be does not hide what comes after it
    assert monitor.known
    waiting = EstimationMonitor(1.0)
    waiting.expire(1.0)
    assert (waiting.known, waiting.active) == (True, False)
