"""Any single sensor may fail: localization, the voted DM1 and DM8 read one drive under faults."""

from __future__ import annotations

import asyncio
import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rampart.actors.bus import topics as bus_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.control.localization.fused_localization import FusedLocalization
from rampart.actors.osmosis.control.localization.localization import Localization
from rampart.actors.osmosis.control.localization.planar_ekf import PlanarEkf
from rampart.actors.osmosis.control.localization.pose_filter import FilterLimits, PoseFilter
from rampart.actors.osmosis.motion_check import TURNING_TRACK_M, WHEEL_RADIUS_M, MotionParity
from rampart.sim.osmosis.simulator import Simulator
from rampart.sim.osmosis.trial.faults import OsmosisFaults
from tests.actors.osmosis.control import localization_drive as trip
from tests.osmosis_system import in_system, shipped_system

FROM_S, FOR_EVER = 4.0, math.inf

BOUND_M = 0.15
"""Of the true error under any single fault of a source; docs/case-study/localization.md."""


def run(*faults, seed=1, limits=None, owed_m=0.0, **judged) -> trip.Located:
    """Drive with faults, (name, from s, to s)."""
    located = trip.Located(PoseFilter(limits, owed_m), **judged)
    trip.watch(trip.disturbed([(trip.fault(name), a, b) for name, a, b in faults], seed), located)
    return located


# ---- without a fault -----------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [
    1, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in (2, 3))])
def test_without_a_fault_all_are_right_to_a_few_centimetres_and_exclude_nobody(seed):
    located, voted, accused = trip.Located(), trip.Voted(), trip.Accused()
    trip.watch(trip.disturbed([], seed), located, voted, accused)
    assert (located.excluded, accused.spans, located.lost_s) == (set(), [], 0.0)
    assert located.worst_m < 0.03
    assert located.worst_rad < 0.02
    assert located.told > 20 * (trip.END_S - 1)
    assert voted.worst_m < 0.06
    assert voted.unknown_s < 0.15


@pytest.mark.parametrize("start_s", [0.0, 3.3, 12.1, 27.05])
def test_a_fresh_life_knows_the_pose_within_a_tenth_of_a_second(start_s):
    located = run(start_s=start_s, settle_s=0.11, judge_to_s=start_s + 0.2)
    assert located.lost_s == 0.0 < located.told
    assert located.worst_m < 0.05
    assert located.worst_rad < 0.02


def test_a_fresh_life_that_hears_only_what_is_late_already_says_nothing_until_that_is_over():
    pose_filter = PoseFilter()
    for step in range(20):  # as on a machine that is busy with starting everybody
        now_s = 0.05 * step
        pose_filter.absolute_pose(now_s - 0.25, m.Pose(1.0, 2.0, 0.5), now_s)
        assert pose_filter.estimate() is None
    for step in range(20, 30):
        pose_filter.absolute_pose(0.05 * step, m.Pose(1.0, 2.0, 0.5), 0.05 * step)
    pose = pose_filter.estimate().pose
    assert (pose.x_m, pose.y_m) == pytest.approx((1.0, 2.0), abs=0.01)


@pytest.mark.parametrize(("missing", "start_s", "judge_to_s", "off_rad"), [
    (("absolute-pose-dropout",), 3.3, FOR_EVER, 0.06),  # its heading is from the IMU
    (("absolute-pose-dropout", "imu-dropout"), 3.0, 8.0, 0.15)])  # from the course
def test_a_fresh_life_has_its_heading_from_what_is_there(missing, start_s, judge_to_s, off_rad):
    located = run(*((name, 0.0, FOR_EVER) for name in missing), start_s=start_s,
                  judge_to_s=judge_to_s)
    assert located.lost_s == 0.0
    assert located.worst_rad < off_rad
    assert located.worst_m < BOUND_M


def test_a_fresh_life_that_hears_two_positions_that_contradict_each_other_says_nothing():
    assert run(("gps-bias", 0.0, FOR_EVER), start_s=4.0).told == 0


# ---- any single fault ----------------------------------------------------------------------------

EXCLUDED = {
    **{f"gps-{way}": "GPS" for way in ("bias", "drift", "noise", "stuck")},
    **{f"imu-{way}": "IMU" for way in ("bias", "drift", "noise", "stuck")},
    **{f"odom-{way}": "odometry" for way in ("bias", "drift", "noise", "stuck")},
    **{f"absolute-pose-{way}": "absolute pose" for way in ("bias", "drift", "noise", "stuck")},
    "encoders-bias": "odometry", "freeze:summit_xl/gps": "GPS",
    "delay:summit_xl/absolute_pose": "absolute pose"}
"""The source that is wrong, and no other, is the one that localization excludes."""

MOTION = ("odom-stuck", "odom-drift", "imu-stuck", "imu-slow-drift", "encoders-stuck",
          "encoders-drift", "encoders-dropout")
"""One wrong measurement of motion does not silence two good positions."""


def assert_borne(located: trip.Located, voted: trip.Voted, accused: trip.Accused) -> None:
    assert located.worst_m < BOUND_M
    assert located.worst_rad < 0.1
    assert located.lost_s < 0.11
    assert voted.worst_m < 0.4
    assert voted.unknown_s < 0.45  # shorter than the module's patience
    assert accused.spans == []


@pytest.mark.parametrize("name", trip.sensor_faults())
@pytest.mark.parametrize("how", ["permanent", *(
    pytest.param(how, marks=pytest.mark.nightly) for how in ("transient", "intermittent"))])
def test_any_single_fault_of_a_source_is_borne_by_all_who_read_it(name, how):
    what = trip.fault(name, on_s=0.7, off_s=1.6) if how == "intermittent" else trip.fault(name)
    located, voted, accused = trip.Located(), trip.Voted(), trip.Accused()
    until_s = 14.0 if how == "transient" else FOR_EVER
    trip.watch(trip.disturbed([(what, FROM_S, until_s)]), located, voted, accused)
    assert_borne(located, voted, accused)
    if how == "permanent" and name in EXCLUDED:
        assert located.excluded == {EXCLUDED[name]}
    if name in MOTION:
        assert (located.filter.owed_m, located.lost_s) == (0.0, 0.0)


@pytest.mark.parametrize("wrong", [
    "far ahead", "no number",
    *(pytest.param(wrong, marks=pytest.mark.nightly) for wrong in ("ahead", "infinite"))])
@pytest.mark.parametrize("topic", trip.STAMPED, ids=lambda topic: topic.key)
def test_stamps_of_no_possible_time_are_borne_like_any_other_fault(topic, wrong):
    located, voted, accused = trip.Located(), trip.Voted(), trip.Accused()
    items = trip.mis_stamped(trip.disturbed([]), topic, wrong, FROM_S, once=False)
    trip.watch(items, located, voted, accused)
    assert_borne(located, voted, accused)


@pytest.mark.parametrize("wrong", trip.WRONG_STAMPS)
@pytest.mark.parametrize("topic", trip.STAMPED, ids=lambda topic: topic.key)
def test_a_source_is_silent_when_it_falls_silent_after_a_stamp_of_no_possible_time(topic, wrong):
    located, wrong_s = trip.Located(), math.inf
    for now_s, item in trip.mis_stamped(trip.disturbed([]), topic, wrong, FROM_S, once=True):
        if isinstance(item, trip.Reading) and (item.topic is not topic or now_s <= wrong_s):
            wrong_s = now_s if item.topic is topic and now_s >= FROM_S else wrong_s
            located.take(now_s, item)
        if now_s > 6.0:
            break
    assert [reason for _, reason in located.filter.status(6.0).excluded] == ["silent or late"]


@pytest.mark.parametrize("topic", trip.STAMPED, ids=lambda topic: topic.key)
def test_one_reading_beyond_all_measure_neither_ends_them_nor_stays_in_them(topic):
    located, voted = trip.Located(judge_to_s=FROM_S + 4.0), trip.Voted()
    items = trip.disturbed([(trip.fault("absolute-pose-dropout"), FROM_S + 4.0, FOR_EVER)])
    trip.watch(trip.with_absurd(items, topic, FROM_S), located, voted)
    assert located.worst_m < 0.03
    assert located.excluded == set()
    assert voted.worst_m < 0.4
    assert voted.unknown_s < 0.45


@pytest.mark.parametrize("name", ["gps-bias", "imu-drift", "odom-stuck", "absolute-pose-drift"])
def test_a_source_that_has_recovered_is_used_again(name):
    located, items = trip.Located(), trip.disturbed([(trip.fault(name), 3.0, 12.0)])
    trip.watch(items, located, to_s=9.0)
    assert len(located.filter.status(9.0).in_use) == 3
    trip.watch(items, located)
    assert len(located.filter.status(trip.END_S).in_use) == 4


# ---- two faults: it may not know, it must not be wrong -------------------------------------------


def test_without_both_positions_it_dead_reckons_with_growing_uncertainty_and_then_gives_up():
    lost = (("gps-dropout", 3.0, FOR_EVER), ("absolute-pose-dropout", 3.0, FOR_EVER))
    located = run(*lost)
    assert located.bridged_m > 10.0
    assert 4.0 < located.lost_s < trip.END_S - 12.0
    assert located.worst_m < 0.5
    assert run(*lost, limits=FilterLimits(bridge_m=2.0)).lost_s > located.lost_s + 5.0
    back = [(name, since_s, 24.0) for name, since_s, _ in lost]
    assert 2.0 < run(*back).lost_s < run(*back, judge_to_s=24.0).lost_s + 1.5, "it comes back"


@pytest.mark.parametrize("names", [
    ("gps-dropout", "absolute-pose-drift"), ("absolute-pose-dropout", "gps-bias"),
    ("gps-bias", "absolute-pose-bias"), ("odom-dropout", "absolute-pose-dropout"),
    ("imu-dropout", "gps-dropout"), ("imu-stuck", "odom-bias"),
    ("gps-noise", "absolute-pose-noise"), ("gps-drift", "odom-dropout")])
def test_after_two_faults_it_is_roughly_right_or_says_nothing(names):
    assert run(*((name, 5.0 + 4 * i, FOR_EVER) for i, name in enumerate(names))).worst_m < 1.0


@pytest.mark.parametrize("way", ["stuck", "stuck-noise", "drift", "slow-drift"])
def test_two_positions_that_are_wrong_alike_leave_them_silent_and_a_successor_too(way):
    alike = ((f"gps-{way}", FROM_S, FOR_EVER), (f"absolute-pose-{way}", FROM_S, FOR_EVER))
    first, voted = trip.Located(), trip.Voted()
    trip.watch(trip.disturbed([(trip.fault(name), a, b) for name, a, b in alike]), first, voted)
    assert first.worst_m < 0.6
    assert first.lost_s > 5.0
    assert first.filter.owed_m > 0.0
    assert voted.worst_m < 0.6
    assert voted.unknown_s > 10.0
    second = run(*alike, start_s=5.0, owed_m=first.filter.owed_m)
    assert (second.told, second.filter.owed_m) == (0, FilterLimits().proof_m)


def test_a_successor_believes_positions_that_have_moved_as_the_wheels_do():
    limits = FilterLimits(proof_m=8.0)
    located = run(limits=limits, owed_m=limits.proof_m)
    assert located.filter.owed_m == 0.0
    assert located.told > 200
    assert 8.0 < located.lost_s < 13.0


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


# ---- the nodes, on the bus with the simulated robot ----------------------------------------------

FIELD = {"system": shipped_system(), "airport": trip.field_airport()}


@in_system(**FIELD)
async def test_it_publishes_the_pose_20_times_a_second_and_says_which_source_is_excluded(system):
    truth, poses = system.hear(topics.TRUTH), system.hear(topics.POSE)
    told = system.hear(topics.LOCALIZATION_STATUS)
    system.start("simulator", Simulator, seed=3)
    system.start("localization", FusedLocalization, bridge_m=2.0)

    async def drive(seconds: float) -> m.LocalizationStatus:
        """Drive in a circle."""
        for _ in range(round(seconds / 0.05)):
            system.say(topics.BASE_COMMAND, m.BaseCommand(0.8, 0.2))
            await asyncio.sleep(0.05)
        return told[-1].message

    def fail(name: str) -> None:
        for order in OsmosisFaults().find(name, 0, topics.ALL).orders(name, math.inf):
            system.say(bus_topics.INJECT, order)

    def error_m() -> float:
        """Worst distance of a pose to the truth nearest in time, less the way in between."""
        worst_m = 0.0
        for _, _, header, pose in poses:
            true = min(truth, key=lambda t: abs(t.header.stamp - header.stamp))
            place = true.message.pose
            off_m = math.dist((pose.x_m, pose.y_m), (place.x_m, place.y_m))
            worst_m = max(worst_m, off_m - 0.8 * abs(true.header.stamp - header.stamp))
        return worst_m

    status = await drive(5.0)
    stamps = [pose.header.stamp for pose in poses]
    assert 95 <= len(stamps) <= 101
    assert max(pose.time_s - pose.header.stamp for pose in poses) < 0.05
    assert stamps == sorted(set(stamps))
    assert error_m() < 0.03
    assert sorted(status.in_use) == ["GPS", "IMU", "absolute pose", "odometry"]
    assert (status.excluded, status.bridged_m) == ((), 0.0)
    assert 0 < status.position_sd_m < 0.03
    assert 0 < status.heading_sd_rad < 0.02
    fail("gps-bias")
    status = await drive(3.0)
    assert status.excluded == (("GPS", "moves differently from the others, 0.6 m"),)
    assert error_m() < 0.05
    fail("absolute-pose-dropout")
    await drive(5.0)  # 4 m: twice as far as it bridges
    assert truth[-1].header.stamp - poses[-1].header.stamp > 1.0


@in_system(**FIELD)
async def test_the_papers_localization_passes_on_what_is_newer_and_can_be(system):
    poses = system.hear(topics.POSE)
    system.start("localization", Localization)
    await system.settle()
    bad = {2: math.inf, 3: 1e9, 4: math.nan, 5: 0.05}
    for i in range(10):
        system.say(topics.ABSOLUTE_POSE, m.Pose(math.nan if i == 6 else float(i), 0.0, 0.0),
                   stamp_s=bad.get(i))
        await asyncio.sleep(0.05)
    assert [pose.message.x_m for pose in poses] == [0.0, 1.0, 7.0, 8.0, 9.0]


# ---- parity of odometry, encoders and gyro -------------------------------------------------------

STEP_S = 0.02


def drive(parity, seconds, *, start_s=0.0, without=(), ahead_s=0.0):
    """Drive a circle at 1 m/s and 0.2 rad/s; return the time at its end."""
    now_s, aside = start_s, 0.2 * TURNING_TRACK_M / 2
    wheels = tuple(mps / WHEEL_RADIUS_M for mps in (1.0 - aside, 1.0 + aside) * 2)
    for _ in range(round(seconds / STEP_S)):
        now_s += STEP_S
        stamp_s = now_s + ahead_s
        yaw = math.remainder(0.2 * now_s, math.tau)
        if "imu" not in without:
            parity.imu(m.Imu(yaw, 0.2, 0.0, 0.2), stamp_s, now_s)
        if "odometry" not in without:
            at = m.Pose(5 * math.sin(yaw), 5 * (1 - math.cos(yaw)), yaw)
            parity.odometry(m.Odometry(at, m.Twist(1.0, 0.2)), stamp_s, now_s)
        if "encoders" not in without:
            parity.encoders(m.BaseStatus(False, False, 0.0, wheels), stamp_s, now_s)
    return now_s


@pytest.mark.parametrize("lost", [
    (), ("encoders",), ("odometry",), ("imu",), ("odometry", "imu", "encoders")])
def test_what_is_silent_confirms_nothing_and_a_turn_missed_in_part_is_held_against_nobody(lost):
    """The event loop of a module was late, or messages were lost."""
    parity = MotionParity()
    end_s = drive(parity, 1.0, start_s=drive(parity, 5.0), without=lost)
    assert parity.confirmed(end_s) == ("encoders" not in lost and "odometry" not in lost)
    assert parity.sure(end_s)
    drive(parity, 1.0, start_s=end_s)
    assert parity.gyro_agrees


def test_stamps_from_the_future_shut_out_none():
    parity = MotionParity()
    end_s = drive(parity, 1.0)
    drive(parity, STEP_S, start_s=end_s, ahead_s=1e9)
    end_s = drive(parity, 5.0, start_s=end_s)
    assert parity.confirmed(end_s)
    assert parity.gyro_agrees
