"""The voted DM1: one wrong receiver neither trips it nor blinds it."""

from __future__ import annotations

import asyncio
import math

import pytest

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.detection.area.position_vote import GPS, WHEELS, PositionVote
from rampart.actors.osmosis.detection.area.voted_area import VotedArea, VotedPosition
from rampart.testing import Ear, table
from tests.actors.osmosis.control.localization_drive import (
    END_S,
    STAMPED,
    Voted,
    disturbed,
    fault,
    mis_stamped,
    watch,
)
from tests.actors.osmosis.detection.lane import LANE
from tests.osmosis_system import in_system, shipped_system

FROM_S = 4.0


def follow(*faults, blind_s=10.0, blind_m=5.0) -> Voted:
    voted = Voted(VotedPosition(0.05, blind_s, blind_m))
    watch(disturbed(faults), voted)
    return voted


@pytest.mark.parametrize("topic", STAMPED, ids=lambda topic: topic.key)
def test_one_wrong_stamp_is_over_when_another_source_fails_later(topic):
    later = "absolute-pose-bias" if topic is topics.GPS else "gps-bias"
    items, voted = disturbed([(fault(later), FROM_S + 4.0, math.inf)]), Voted()
    watch(mis_stamped(items, topic, "far ahead", FROM_S, once=True), voted, to_s=FROM_S + 10.0)
    assert voted.worst_m < 0.4
    assert voted.unknown_s < 0.45


@pytest.mark.parametrize("names", [
    ("gps-stuck", "absolute-pose-dropout"), ("gps-bias", "absolute-pose-bias"),
    ("gps-dropout", "odom-dropout"), ("absolute-pose-dropout", "odom-dropout")])
def test_after_two_faults_it_knows_nothing_beyond_the_bound_rather_than_something_wrong(names):
    voted = follow(*((fault(name), FROM_S + 3.0 * i, math.inf) for i, name in enumerate(names)))
    assert voted.worst_m < 0.6
    assert voted.unknown_s > 3.0


def test_how_long_and_how_far_it_goes_on_blind_is_bounded():
    both = [(fault(name), FROM_S, math.inf) for name in ("gps-dropout", "absolute-pose-dropout")]
    by_way = follow(*both, blind_s=1000.0, blind_m=2.0).unknown_s
    by_time = follow(*both, blind_s=1.0, blind_m=1000.0).unknown_s
    never = follow(*both, blind_s=1000.0, blind_m=1000.0)
    assert END_S - FROM_S - 4.0 < by_way < by_time
    assert by_time == pytest.approx(END_S - FROM_S - 1.0, abs=0.5)
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
