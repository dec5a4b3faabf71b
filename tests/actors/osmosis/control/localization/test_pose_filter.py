"""The fusion of odometry, IMU, GPS and absolute pose: no source alone can lead it astray."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.control.localization.planar_ekf import PlanarEkf
from rampart.actors.osmosis.control.localization.pose_filter import FilterLimits, PoseFilter
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
    with_absurd,
)

FOR_EVER = math.inf

BOUND_M = 0.15
"""Of the true error under any single fault of a source; docs/case-study/localization.md."""


@dataclass
class Outcome:
    worst_m: float = 0.0
    worst_rad: float = 0.0
    lost_s: float = 0.0
    bridged_m: float = 0.0
    told: int = 0
    owed_m: float = 0.0
    excluded: set[str] = field(default_factory=set)


def feed(pose_filter: PoseFilter, reading: Reading, now_s: float) -> None:
    take = {topics.IMU: pose_filter.imu, topics.ODOMETRY: pose_filter.odometry,
            topics.GPS: pose_filter.gps, topics.ABSOLUTE_POSE: pose_filter.absolute_pose,
            topics.BASE_STATUS: pose_filter.encoders}
    take[reading.topic](reading.stamp_s, reading.body, now_s)


def run(*faults, start_s=0.0, seed=1, limits=None, judge_to_s=FOR_EVER, owed_m=0.0):
    """Drive with faults, (name or fault, from s, to s); compare with the truth at 20 Hz."""
    found = [(fault(f) if isinstance(f, str) else f, a, b) for f, a, b in faults]
    return run_all(disturbed(found, seed), start_s, limits, judge_to_s, owed_m)


def run_all(items, start_s=0.0, limits=None, judge_to_s=FOR_EVER, owed_m=0.0):
    pose_filter, outcome = PoseFilter(limits, owed_m), Outcome()
    for now_s, item in items:
        if now_s < start_s:
            continue
        if isinstance(item, Reading):
            feed(pose_filter, item, now_s)
            continue
        if now_s < start_s + 0.4 or now_s > judge_to_s:
            continue
        compare(pose_filter, item, now_s, outcome)
    outcome.owed_m = pose_filter.owed_m
    return outcome


def compare(pose_filter: PoseFilter, truth: Truth, now_s: float, outcome: Outcome) -> None:
    status = pose_filter.status(now_s)
    outcome.excluded |= {name for name, _ in status.excluded}
    outcome.bridged_m = max(outcome.bridged_m, status.bridged_m)
    estimate = pose_filter.estimate()
    if estimate is None or now_s - estimate.stamp_s > 0.25:
        outcome.lost_s += 0.05
        return
    outcome.told += 1
    x_m, y_m, yaw_rad = truth.at(estimate.stamp_s)
    found = estimate.pose
    outcome.worst_m = max(outcome.worst_m, math.hypot(found.x_m - x_m, found.y_m - y_m))
    outcome.worst_rad = max(
        outcome.worst_rad, abs(math.remainder(found.yaw_rad - yaw_rad, math.tau)))


# ---- without a fault -----------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [
    1, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in (2, 3))])
def test_without_a_fault_it_is_right_to_a_few_centimetres_and_excludes_nobody(seed):
    outcome = run(seed=seed)
    assert outcome.excluded == set()
    assert outcome.worst_m < 0.03
    assert outcome.worst_rad < 0.02
    assert outcome.lost_s == 0.0
    assert outcome.told > 20 * (END_S - 1)


@pytest.mark.parametrize("start_s", [0.0, 3.3, 7.7, 12.1, 18.0, 27.05])
def test_a_fresh_life_knows_the_pose_within_a_tenth_of_a_second(start_s):
    pose_filter = PoseFilter()
    for now_s, item in disturbed([]):
        if now_s < start_s:
            continue
        if isinstance(item, Reading):
            feed(pose_filter, item, now_s)
        elif now_s >= start_s + 0.11:
            outcome = Outcome()
            compare(pose_filter, item, now_s, outcome)
            assert (outcome.lost_s, outcome.told) == (0.0, 1)
            assert outcome.worst_m < 0.05
            assert outcome.worst_rad < 0.02
            return


def test_a_fresh_life_that_hears_only_what_is_late_already_says_nothing_until_that_is_over():
    pose_filter = PoseFilter()
    for step in range(20):  # as on a machine that is busy with starting everybody
        now_s = 0.05 * step
        pose_filter.absolute_pose(now_s - 0.25, m.Pose(1.0, 2.0, 0.5), now_s)
        assert pose_filter.estimate() is None
    for step in range(20, 30):
        now_s = 0.05 * step
        pose_filter.absolute_pose(now_s, m.Pose(1.0, 2.0, 0.5), now_s)
        estimate = pose_filter.estimate()
        if estimate is not None:
            assert (estimate.pose.x_m, estimate.pose.y_m) == pytest.approx((1.0, 2.0), abs=0.01)
    assert estimate is not None


@pytest.mark.parametrize(("missing", "start_s", "judge_to_s", "off_rad"), [
    (("absolute-pose-dropout",), 0.0, FOR_EVER, 0.06),  # its heading is from the IMU
    (("absolute-pose-dropout",), 3.3, FOR_EVER, 0.06),
    (("absolute-pose-dropout",), 13.1, FOR_EVER, 0.06),
    (("absolute-pose-dropout", "imu-dropout"), 3.0, 8.0, 0.15)])  # from the course
def test_a_fresh_life_has_its_heading_from_what_is_there(missing, start_s, judge_to_s, off_rad):
    outcome = run(*((name, 0.0, FOR_EVER) for name in missing), start_s=start_s,
                  judge_to_s=judge_to_s)
    assert outcome.lost_s == 0.0
    assert outcome.worst_rad < off_rad
    assert outcome.worst_m < BOUND_M


def test_a_fresh_life_that_hears_two_positions_that_contradict_each_other_says_nothing():
    outcome = run(("gps-bias", 0.0, FOR_EVER), start_s=4.0)
    assert outcome.told == 0


# ---- any single fault ----------------------------------------------------------------------------


@pytest.mark.parametrize("name", sensor_faults(*SOURCES))
@pytest.mark.parametrize("how", ["permanent", *(
    pytest.param(how, marks=pytest.mark.nightly) for how in ("transient", "intermittent"))])
def test_any_single_fault_of_a_source_is_bridged(name, how):
    what, until_s = fault(name), FOR_EVER
    if how == "transient":
        until_s = 14.0
    elif how == "intermittent":
        what = fault(name, on_s=0.7, off_s=1.6)
    outcome = run((what, 4.0, until_s))
    assert outcome.worst_m < BOUND_M
    assert outcome.worst_rad < 0.1
    assert outcome.lost_s < 0.11


@pytest.mark.parametrize("wrong", WRONG_STAMPS)
@pytest.mark.parametrize("topic", STAMPED, ids=lambda topic: topic.key)
@pytest.mark.parametrize("once", [
    False, pytest.param(True, marks=pytest.mark.nightly)], ids=["permanent", "once"])
def test_stamps_of_no_possible_time_are_bridged_like_any_other_fault(topic, wrong, once):
    outcome = run_all(mis_stamped(disturbed([]), topic, wrong, 4.0, once=once))
    assert outcome.worst_m < BOUND_M
    assert outcome.worst_rad < 0.1
    assert outcome.lost_s < 0.11
    if once:
        assert outcome.excluded == set()


@pytest.mark.parametrize("wrong", WRONG_STAMPS)
@pytest.mark.parametrize("topic", STAMPED, ids=lambda topic: topic.key)
def test_a_source_is_silent_when_it_falls_silent_after_a_stamp_of_no_possible_time(topic, wrong):
    pose_filter, wrong_s = PoseFilter(), math.inf
    for now_s, item in mis_stamped(disturbed([]), topic, wrong, 4.0, once=True):
        if isinstance(item, Reading) and (item.topic is not topic or now_s <= wrong_s):
            wrong_s = now_s if item.topic is topic and now_s >= 4.0 else wrong_s
            feed(pose_filter, item, now_s)
        if now_s > 6.0:
            break
    assert [reason for _, reason in pose_filter.status(6.0).excluded] == ["silent or late"]


@pytest.mark.parametrize("topic", STAMPED, ids=lambda topic: topic.key)
def test_one_reading_beyond_all_measure_neither_ends_it_nor_stays_in_it(topic):
    outcome = run_all(with_absurd(disturbed([]), topic, 4.0))
    assert outcome.worst_m < 0.03
    assert outcome.excluded == set()


@pytest.mark.parametrize(("name", "excluded"), [
    ("gps-bias", "GPS"), ("gps-drift", "GPS"), ("gps-noise", "GPS"), ("gps-stuck", "GPS"),
    ("imu-bias", "IMU"), ("imu-drift", "IMU"), ("imu-noise", "IMU"), ("imu-stuck", "IMU"),
    ("odom-bias", "odometry"), ("odom-drift", "odometry"), ("odom-noise", "odometry"),
    ("odom-stuck", "odometry"), ("encoders-bias", "odometry"),
    ("absolute-pose-bias", "absolute pose"),
    ("absolute-pose-drift", "absolute pose"), ("absolute-pose-noise", "absolute pose"),
    ("absolute-pose-stuck", "absolute pose"), ("freeze:summit_xl/gps", "GPS"),
    ("delay:summit_xl/absolute_pose", "absolute pose"),
])
def test_the_source_that_is_wrong_is_the_one_that_is_excluded(name, excluded):
    assert run((name, 5.0, FOR_EVER)).excluded == {excluded}


@pytest.mark.parametrize("name", ["gps-bias", "imu-drift", "odom-stuck", "absolute-pose-drift"])
def test_a_source_that_has_recovered_is_used_again(name):
    pose_filter = PoseFilter()
    for now_s, item in disturbed([(fault(name), 3.0, 12.0)]):
        if isinstance(item, Reading):
            feed(pose_filter, item, now_s)
        elif 9.0 < now_s < 9.06:
            assert len(pose_filter.status(now_s).in_use) == 3
    assert len(pose_filter.status(END_S).in_use) == 4


# ---- two faults: it may not know, it must not be wrong -------------------------------------------


def test_without_both_positions_it_dead_reckons_with_growing_uncertainty_and_then_gives_up():
    lost = (("gps-dropout", 3.0, FOR_EVER), ("absolute-pose-dropout", 3.0, FOR_EVER))
    outcome = run(*lost)
    assert outcome.bridged_m > 10.0
    assert 4.0 < outcome.lost_s < END_S - 12.0
    assert outcome.worst_m < 0.5
    assert run(*lost, limits=FilterLimits(bridge_m=2.0)).lost_s > outcome.lost_s + 5.0
    back = [(name, since_s, 24.0) for name, since_s, _ in lost]
    assert 2.0 < run(*back).lost_s < run(*back, judge_to_s=24.0).lost_s + 1.5, "it comes back"


@pytest.mark.parametrize("names", [
    ("gps-dropout", "absolute-pose-drift"), ("gps-dropout", "absolute-pose-bias"),
    ("absolute-pose-dropout", "gps-bias"), ("absolute-pose-dropout", "gps-drift"),
    ("gps-bias", "absolute-pose-bias"), ("odom-dropout", "absolute-pose-dropout"),
    ("imu-dropout", "gps-dropout"), ("odom-stuck", "gps-dropout"), ("imu-stuck", "odom-bias"),
    ("gps-noise", "absolute-pose-noise"), ("imu-drift", "absolute-pose-stuck"),
    ("gps-drift", "odom-dropout"),
])
def test_after_two_faults_it_is_roughly_right_or_says_nothing(names):
    outcome = run(*((name, 5.0 + 4 * i, FOR_EVER) for i, name in enumerate(names)))
    assert outcome.worst_m < 1.0


ALIKE = ["stuck", "stuck-noise", "drift", "slow-drift"]


@pytest.mark.parametrize("way", ALIKE)
def test_two_positions_that_are_wrong_alike_leave_it_silent_and_its_successor_too(way):
    alike = ((f"gps-{way}", 4.0, FOR_EVER), (f"absolute-pose-{way}", 4.0, FOR_EVER))
    first = run(*alike)
    assert first.worst_m < 0.6
    assert first.lost_s > 5.0
    assert first.owed_m > 0.0
    second = run(*alike, start_s=5.0, owed_m=first.owed_m)
    assert (second.told, second.owed_m) == (0, FilterLimits().proof_m)


def test_a_successor_believes_positions_that_have_moved_as_the_wheels_do():
    limits = FilterLimits(proof_m=8.0)
    outcome = run(limits=limits, owed_m=limits.proof_m)
    assert outcome.owed_m == 0.0
    assert outcome.told > 200
    assert 8.0 < outcome.lost_s < 13.0


@pytest.mark.parametrize("name", ["odom-stuck", "odom-drift", "imu-stuck", "imu-slow-drift",
                                  "encoders-stuck", "encoders-drift", "encoders-dropout"])
def test_one_wrong_measurement_of_motion_does_not_silence_two_good_positions(name):
    outcome = run((name, 4.0, FOR_EVER))
    assert (outcome.owed_m, outcome.lost_s) == (0.0, 0.0)


# ---- its parts -----------------------------------------------------------------------------------

steps = st.tuples(st.floats(-0.1, 0.1), st.floats(-0.2, 0.2))
fixes = st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(0.001, 0.5))


@settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])  # a busy machine
@given(st.lists(st.tuples(steps, fixes, st.booleans()), max_size=12))
def test_the_filter_is_the_textbook_one(moves):
    """Against the matrix form with numpy."""
    ekf = PlanarEkf(0.3, -0.2, 1.0, 0.2, 0.1)
    state, p = np.array([0.3, -0.2, 1.0]), np.diag([0.04, 0.04, 0.01])
    for (forward, turn), (x, y, variance), by_heading in moves:
        ekf.predict(forward, turn, 1e-3, 1e-4)
        middle = state[2] + turn / 2
        dx, dy = forward * math.cos(middle), forward * math.sin(middle)
        f = np.array([[1, 0, -dy], [0, 1, dx], [0, 0, 1]])
        state = state + np.array([dx, dy, turn])
        p = f @ p @ f.T + np.diag([1e-3, 1e-3, 1e-4])
        h = np.array([[0, 0, 1.0]]) if by_heading else np.eye(3)[:2]
        z = np.array([state[2] + x / 2]) if by_heading else np.array([x, y])
        s = h @ p @ h.T + variance * np.eye(len(z))
        off = z - h @ state
        nis = float(off @ np.linalg.solve(s, off))
        if by_heading:
            assert ekf.heading_nis(float(z[0]), variance) == pytest.approx(nis, abs=1e-9)
            ekf.update_heading(float(z[0]), variance)
        else:
            assert ekf.position_nis(x, y, variance) == pytest.approx(nis, abs=1e-9)
            ekf.update_position(x, y, variance)
        gain = p @ h.T @ np.linalg.inv(s)
        state, p = state + gain @ off, (np.eye(3) - gain @ h) @ p
        assert (ekf.x_m, ekf.y_m) == pytest.approx(tuple(state[:2]), abs=1e-9)
        assert math.remainder(ekf.yaw_rad - state[2], math.tau) == pytest.approx(0.0, abs=1e-9)
        assert ekf.position_sd_m**2 == pytest.approx(np.linalg.eigvalsh(p[:2, :2])[1], abs=1e-9)
        assert ekf.heading_sd_rad**2 == pytest.approx(p[2, 2], abs=1e-9)
