"""DM8: a localization that lies is found out, and nobody else's fault is taken for its."""

from __future__ import annotations

import asyncio
import math

import pytest

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.detection.area.estimation_error import (
    EstimationError,
    EstimationMonitor,
)
from rampart.actors.runtime.actor import Actor
from rampart.actors.system.members import Member, heard
from rampart.sim.osmosis.trial.faults import SENSOR_FAULTS
from rampart.testing import Ear, run
from tests.actors.osmosis.control.localization_drive import (
    LEGS,
    WRONG_STAMPS,
    Reading,
    Truth,
    disturbed,
    drive,
    fault,
    mis_stamped,
)
from tests.osmosis_system import System, shipped_system

END_S = sum(leg[0] for leg in LEGS)
FROM_S = 4.0
KEYS = [topic.key for topic in (topics.GPS, topics.IMU, topics.ODOMETRY, topics.BASE_STATUS)]
NAMES = [name for name in SENSOR_FAULTS if name.startswith(("gps", "imu", "odom", "encoders"))]
NAMES += [f"{mode}:{key}" for mode in ("drop", "freeze", "delay", "corrupt") for key in KEYS]


def honest(truth: Truth, _now_s: float) -> m.Pose:
    return m.Pose(truth.x_m, truth.y_m, truth.yaw_rad)


def watch(lie=honest, faults=(), to_s=END_S, monitor=None, seed=1):
    """Return when the monitor was active: list of (since s, to s)."""
    return watch_all(disturbed(faults, seed), lie, to_s, monitor)


def watch_all(items, lie=honest, to_s=END_S, monitor=None):
    monitor = monitor or EstimationMonitor(-math.inf)
    spans: list[list[float]] = []
    for now_s, item in items:
        if now_s > to_s:
            break
        if isinstance(item, Truth):
            said = lie(item, now_s)
            if said is not None:
                monitor.pose(said, now_s, now_s, "localization#1")
        else:
            feed(monitor, item, now_s)
        if monitor.active and (not spans or spans[-1][1] < math.inf):
            spans.append([now_s, math.inf])
        elif not monitor.active and spans and spans[-1][1] == math.inf:
            spans[-1][1] = now_s
    return [tuple(span) for span in spans]


def feed(monitor: EstimationMonitor, item: Reading, now_s: float) -> None:
    body, track = item.body, monitor.vote.track
    if item.topic is topics.IMU:
        track.imu(body, item.stamp_s, now_s)
    elif item.topic is topics.ODOMETRY:
        track.odometry(body, item.stamp_s, now_s)
    elif item.topic is topics.BASE_STATUS:
        monitor.vote.see_encoders(body, item.stamp_s, now_s)
    elif item.topic is topics.GPS:
        monitor.gps(body, item.stamp_s, now_s)


def lying(x_m=0.0, y_m=0.0, yaw_rad=0.0, *, per_s=False, to_s=math.inf):
    def lie(truth: Truth, now_s: float) -> m.Pose:
        share = 0.0
        if FROM_S <= now_s < to_s:
            share = now_s - FROM_S if per_s else 1.0
        return m.Pose(truth.x_m + share * x_m, truth.y_m + share * y_m,
                      truth.yaw_rad + share * yaw_rad)

    return lie


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_an_honest_localization_is_never_accused(seed):
    assert watch(seed=seed) == []


@pytest.mark.parametrize(("lie", "within_s"), [
    pytest.param(lying(0.7, 0.7), 0.25, id="a metre aside"),
    pytest.param(lying(0.0, 0.25, per_s=True), 1.6, id="prohibited-area: drifting north"),
    pytest.param(lying(-0.1, 0.1, per_s=True), 2.6, id="drifting slowly"),
    pytest.param(lying(0.0, 0.0, 0.5), 0.8, id="turned on the spot"),
    pytest.param(lying(2.0, 0.0, 1.0), 0.25, id="wrong in all"),
])
def test_a_lie_is_found_out_in_time_and_forgiven_when_it_ends(lie, within_s):
    (since_s, until_s), *more = watch(lie)
    assert FROM_S < since_s <= FROM_S + within_s
    assert (until_s, more) == (math.inf, [])


def test_it_is_forgiven_within_half_a_second_of_honesty():
    ((_, until_s),) = watch(lying(0.7, 0.7, to_s=8.0))
    assert 8.0 < until_s <= 8.6


def test_a_pose_that_is_stuck_with_fresh_stamps_is_found_out_within_half_a_metre():
    kept: list[m.Pose] = []

    def stuck(truth: Truth, now_s: float) -> m.Pose:
        if now_s < FROM_S:
            return honest(truth, now_s)
        kept.append(honest(truth, now_s))
        return kept[0]

    ((since_s, _),) = watch(stuck)
    truth = next(t for t in drive() if isinstance(t, Truth) and t.stamp_s >= since_s)
    assert math.dist((truth.x_m, truth.y_m), (kept[0].x_m, kept[0].y_m)) < 0.55


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("how", ["permanent", "intermittent"])
def test_the_fault_of_a_sensor_is_not_taken_for_localizations(name, how):
    what = fault(name) if how == "permanent" else fault(name, on_s=0.7, off_s=1.6)
    assert watch(faults=[(what, FROM_S, math.inf)]) == []


@pytest.mark.parametrize("wrong", WRONG_STAMPS)
@pytest.mark.parametrize("topic", [topics.GPS, topics.IMU, topics.ODOMETRY],
                         ids=lambda topic: topic.key)
def test_wrong_stamps_of_a_sensor_are_not_taken_for_localizations(topic, wrong):
    assert watch_all(mis_stamped(disturbed([]), topic, wrong, FROM_S, once=False)) == []


@pytest.mark.parametrize("wrong", WRONG_STAMPS)
@pytest.mark.parametrize("topic", [topics.GPS, topics.IMU, topics.ODOMETRY],
                         ids=lambda topic: topic.key)
def test_after_one_wrong_stamp_a_lie_is_found_out_as_ever(topic, wrong):
    items = mis_stamped(disturbed([]), topic, wrong, FROM_S - 2.0, once=True)
    (since_s, _), *_ = watch_all(items, lying(0.7, 0.7))
    assert FROM_S < since_s <= FROM_S + 0.25


@pytest.mark.parametrize("stamp_s", [1e9, 1.25, math.inf, math.nan])
def test_a_pose_with_a_wrong_stamp_does_not_hide_those_after_it(stamp_s):
    monitor = EstimationMonitor(-math.inf)
    monitor.pose(m.Pose(0.0, 0.0, 0.0), stamp_s, 1.0, "localization#1")
    monitor.pose(m.Pose(1.0, 0.0, 0.0), 1.05, 1.05, "localization#1")
    assert monitor.vote.position.stamp_s == 1.05


def test_a_localization_that_is_silent_is_not_its_business():
    assert watch(lambda t, now_s: honest(t, now_s) if now_s < FROM_S else None) == []


def test_a_respawned_module_claims_nothing_before_it_has_compared_or_waited():
    monitor = EstimationMonitor(1.0)
    assert (monitor.known, monitor.due_s) == (False, 1.0)
    monitor.expire(0.5)
    assert not monitor.known
    watch(to_s=0.3, monitor=monitor)
    assert monitor.known
    waiting = EstimationMonitor(1.0)
    waiting.expire(1.0)
    assert (waiting.known, waiting.active) == (True, False)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_what_is_no_number_is_not_heard(bad):
    monitor = EstimationMonitor(-math.inf)
    monitor.pose(m.Pose(bad, 0.0, 0.0), 1.0, 1.0, "localization#1")
    monitor.pose(m.Pose(0.0, 0.0, bad), 1.0, 1.0, "localization#1")
    monitor.gps(m.GpsFix(bad, 0.0, 0.0, 0.0, 0.1), 1.0, 1.0)
    assert not monitor.vote.compared
    assert monitor.vote.position.stamp_s == monitor.vote.gps.stamp_s == -math.inf


class Robot(Actor):
    outputs = (topics.POSE, topics.GPS, topics.IMU, topics.ODOMETRY)


def test_the_actor_names_the_life_that_lied():
    async def scenario() -> None:
        async with System(system=shipped_system()) as system:
            ear = system.start("ear", Ear)
            robot = system.start("localization", Robot)
            system.start("DM8", EstimationError)
            await system.settle()
            for i in range(40):
                x_m = 0.1 * i
                robot.publish(topics.IMU, m.Imu(0.0, 0.001 * i, 0.0, 0.0))
                robot.publish(topics.ODOMETRY, m.Odometry(m.Pose(x_m, 0.0, 0.0), m.Twist(1.0, 0.0)))
                robot.publish(topics.POSE, m.Pose(x_m, 0.0 if i < 20 else 2.0, 0.0))
                robot.publish(topics.GPS, m.GpsFix(x_m, 0.0, 1.0, 0.0, 0.02))
                await asyncio.sleep(0.1)
            assert ear.states == ["idle", "active"]
            report = ear.heard[-1][1]
            assert report.nodes == ("localization#1",)
            assert report.reason == "the pose is 2.0 m from GPS, which moves as the wheels do"

    run(scenario)


def test_the_actor_does_not_hear_the_absolute_pose_that_localization_lives_on():
    assert set(heard(Member("DM8", EstimationError, EstimationError.Parameters()))) == {
        "summit_xl/gps", "summit_xl/imu", "summit_xl/odom", "summit_xl/status", "localization/pose"}
