"""An invalid reading counts as missing; with two lasers the view of the other one stays."""

import math
import random

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import readings
from rampart.actors.osmosis.control.limits_from_spec import reach_of
from rampart.actors.osmosis.control.pilot.laser_pair import (
    LOWER,
    UPPER,
    LaserCheck,
    LaserPair,
    LaserReach,
)
from rampart.actors.osmosis.messages import LaserScan
from rampart.actors.osmosis.page.state import thin
from rampart.sim.campaign.job import Job, run_job
from rampart.sim.faults.scenario import parse_fault
from tests.actors.osmosis.control.world import RAYS, full_sweep
from tests.osmosis_system import shipped_system
from tests.whole.missions import write_mission

REACH = reach_of(shipped_system())
NO_RAY = [0.0, -1.0, math.nan, 0.01, 8.5]
FREE = [8.0, math.inf]


def as_bytes(ranges):
    return np.array(ranges, "<f4").tobytes()


def with_rays(sweep, *changed):
    """Return a sweep with other ranges, each given by index or slice, and m."""
    ranges = np.frombuffer(sweep.ranges_f32, "<f4").copy()
    for where, range_m in changed:
        ranges[where] = range_m
    return msgspec.structs.replace(sweep, ranges_f32=as_bytes(ranges))


def view_of(lower, upper=None):
    pair = LaserPair(REACH)
    if upper is not None:
        pair.take(UPPER, upper, 0.0, 0.0)
    return pair.take(LOWER, lower, 0.0, 0.0)


def nearest_m(view):
    return np.hypot(*view.points.T).min() if len(view.points) else math.inf


# ---- rays ---------------------------------------------------------------------------------------


def test_a_ray_is_an_echo_or_free_or_nothing():
    meaning = readings.ray_distances(as_bytes([3.0, *FREE, *NO_RAY]) + b"\1", 8.0, near_m=0.25)
    assert meaning[0] == 3.0
    assert np.isinf(meaning[1:3]).all()
    assert np.isnan(meaning[3:]).all()


@pytest.mark.parametrize("range_m", NO_RAY)
@pytest.mark.parametrize("where", [slice(None), slice(0, 3), slice(-3, None), 90])
def test_where_no_laser_knows_anything_there_is_no_view(where, range_m):
    wrong = with_rays(full_sweep(8.0, 1), (where, range_m))
    assert "no valid range" in view_of(wrong).fault
    assert "no valid range" in view_of(wrong, with_rays(full_sweep(8.0, 2), (where, -1.0))).fault


def test_a_finer_laser_may_lose_rays_between_which_nothing_can_hide():
    fine = m.LaserScan(-2.4, 0.01, 8.0, as_bytes(np.full(481, 8.0)), 0.1)
    assert view_of(with_rays(fine, (slice(0, None, 2), 0.0))).fault == ""
    assert "no valid range" in view_of(with_rays(fine, (slice(200, 203), 0.0))).fault


def test_lasers_whose_rays_differ_fill_each_other_s_holes():
    lower = with_rays(full_sweep(8.0, 1), (slice(None), 0.0))
    upper = m.LaserScan(-2.4, 0.01, 8.0, as_bytes(np.full(481, 5.0)), 0.1)
    assert (view_of(lower, upper).fault, len(view_of(lower, upper).points)) == ("", 481)
    holed = with_rays(upper, (slice(100, 200), math.nan))
    assert "no valid range" in view_of(lower, holed).fault
    filled = with_rays(lower, (slice(None), 8.0))
    assert view_of(filled, holed).fault == ""


@given(st.lists(st.sampled_from([8.0, 3.0, *NO_RAY]), min_size=RAYS, max_size=RAYS),
       st.lists(st.sampled_from([8.0, 3.0, *NO_RAY]), min_size=RAYS, max_size=RAYS))
def test_whatever_the_rays_a_view_shows_every_echo_of_either(a, b):
    lower, upper = (with_rays(full_sweep(8.0, i), (slice(None), ranges))
                    for i, ranges in enumerate((a, b)))
    view = view_of(lower, upper)
    if not view.fault:
        assert len(view.points) == sum(3.0 in pair for pair in zip(a, b, strict=True))


def test_the_page_shows_no_echo_where_a_ray_means_nothing():
    shown = thin(with_rays(full_sweep(8.0, 1), (90, 0.0), (20, 3.0)))
    assert set(shown["cm"]) == {-1, 300}


# ---- other sensors -------------------------------------------------------------------------------


POSE, TWIST = m.Pose(1.0, 2.0, 3.0), m.Twist(0.5, 0.1)
SOUND = [
    (readings.is_pose, POSE), (readings.is_odometry, m.Odometry(POSE, TWIST)),
    (readings.is_imu, m.Imu(0.1, 0.0, 0.2, -0.1)), (readings.is_light, m.LightSample(0.0)),
    (readings.is_fix, m.GpsFix(1.0, 2.0, 0.5, 0.0, 0.02)),
    (readings.is_base_status, m.BaseStatus(False, False, 0.0, (8.0, 8.0, 8.0, 8.0)))]


@pytest.mark.parametrize("wrong", [math.nan, -math.inf, 1e9])
@pytest.mark.parametrize(("can_be", "reading"), SOUND)
def test_a_reading_with_one_number_that_cannot_be_is_none(can_be, reading, wrong):
    assert can_be(reading)
    for changed in changes(reading, wrong):
        assert not can_be(changed), changed


def changes(reading, wrong):
    """Yield the reading with each of its measured numbers wrong."""
    for name in reading.__struct_fields__:
        value = getattr(reading, name)
        if isinstance(value, msgspec.Struct):
            for inner in changes(value, wrong):
                yield msgspec.structs.replace(reading, **{name: inner})
        elif isinstance(value, tuple):
            for i in range(len(value)):
                yield msgspec.structs.replace(
                    reading, **{name: (*value[:i], wrong, *value[i + 1:])})
        elif isinstance(value, float) and name != "command_age_s":
            yield msgspec.structs.replace(reading, **{name: wrong})


def test_readings_beyond_what_a_device_can_say_are_none():
    assert not readings.is_light(m.LightSample(-1.0))
    assert not readings.is_pose(m.Pose(0.0, 0.0, 7.0))
    assert not readings.is_fix(m.GpsFix(0.0, 0.0, 0.0, 0.0, 0.0))  # as a receiver without a fix
    assert not readings.is_fix(m.GpsFix(1.0, 2.0, 0.0, 0.0, -1.0))


# ---- whole runs ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("system", "fault"), [
    ("osmosis", "zero:summit_xl/scan@5+inf"), ("paper", "laser-stuck@12+3"),
    pytest.param("paper", "laser-dropout@12+3", marks=pytest.mark.slow),
    *(pytest.param("osmosis", f"{way}:summit_xl/{laser}@5+inf", marks=pytest.mark.slow)
      for way, laser in (("zero", "upper_scan"), ("negative", "scan"), ("nan", "upper_scan")))])
def test_a_laser_of_nonsense_costs_two_lasers_nothing_and_one_a_stop(tmp_path, system, fault):
    mission = str(write_mission(tmp_path, "NEAR"))  # an obstacle is on its way
    result = run_job(Job(row="x", system=system, options={"mission": mission, "obstacles": 2},
                         seed=3, faults=(parse_fault(fault),)))
    assert result.effective
    assert (result.safe, result.success) == (True, True), result.reasons


# ---- two lasers: whatever happens to one, the other's view stays, and nothing is unseen ----------

FAR_M, PERIOD_S = 8.0, 0.05
ANGLE_MIN = -0.2
NARROW = LaserReach(range_m=5.0, field_rad=0.4, gap_rad=0.1)


def sweep(ranges, reference_m=0.1):
    return LaserScan(ANGLE_MIN, 0.1, FAR_M, np.array(ranges, "<f4").tobytes(), reference_m)


def healthy(i, ranges=(8, 8, 3, 8, 8)):
    return sweep(ranges, 0.1 + 0.001 * math.sin(i + 1))


def distances(view):
    return sorted(round(float(np.hypot(*point)), 3) for point in view.points)


class Bench:
    """Feeds a pair sweep by sweep and keeps the view that is in force."""

    def __init__(self):
        self.pair, self.view = LaserPair(NARROW), None

    def feed(self, laser, message, stamp_s, now_s=None):
        view = self.pair.take(laser, message, stamp_s, stamp_s if now_s is None else now_s)
        if view is not None:
            self.view = view


def broken(way, i):
    """Return sweep and stamp of a laser with a fault, or None for silence."""
    now_s, free = i * PERIOD_S, (8, 8, 8, 8, 8)
    return {"silent": None, "stuck": (sweep(free, 0.1), now_s), "frozen": (healthy(0, free), 0.0),
            "biased": (sweep((8, 8, 3.5, 8, 8), 0.6), now_s),
            "late": (healthy(i, free), now_s - 1.5)}[way]


@pytest.mark.parametrize("bad", [LOWER, UPPER])
@pytest.mark.parametrize("way", ["silent", "stuck", "biased", "frozen", "late"])
def test_whatever_one_of_them_does_the_view_stays_fresh_and_right(bad, way):
    bench, good = Bench(), 1 - bad
    for i in range(100):
        now_s = i * PERIOD_S
        found = broken(way, i) if i >= 20 else (healthy(i + 1000), now_s)
        if found is not None:
            bench.feed(bad, *found)
        bench.feed(good, healthy(i), now_s)
        assert bench.view.fault == ""
        assert now_s - bench.view.stamp_s <= 0.15, "the view is old"
        if i > 30:
            assert bench.view.stamp_s == now_s
            assert distances(bench.view)[0] == 3.0


@pytest.mark.parametrize("stamp_s", [1e9, 0.6, math.nan])
@pytest.mark.parametrize("laser", [LOWER, UPPER])
def test_a_sweep_of_no_possible_time_is_no_view_and_shuts_out_none(laser, stamp_s):
    bench = Bench()
    for i in range(20):
        now_s = i * PERIOD_S
        bench.feed(LOWER, healthy(i), now_s)
        if i == 8:
            assert bench.pair.take(laser, healthy(99, (8,) * 5), stamp_s, now_s) is None
        bench.feed(UPPER, healthy(i + 100), now_s)
        assert (bench.view.stamp_s, distances(bench.view)[0]) == (now_s, 3.0)


@pytest.mark.parametrize("way", ["stuck", "biased"])
def test_without_any_that_can_be_believed_there_is_no_view_and_a_reason(way):
    bench = Bench()
    for i in range(20):
        for laser in (LOWER, UPPER):
            bench.feed(laser, *broken(way, i))
    assert "laser" in bench.view.fault
    assert not len(bench.view.points)


def test_the_nearer_echo_of_each_ray_counts_whichever_of_them_has_it():
    bench = Bench()
    bench.feed(UPPER, healthy(1, (8, 2.5, 4, 8, 8)), 0.0)
    bench.feed(LOWER, healthy(2, (8, 8, 3, 3.5, 8)), 0.0)
    assert distances(bench.view) == [2.5, 3.0, 3.5]


@pytest.mark.parametrize("other", [
    LaserScan(-0.3, 0.1, FAR_M, np.full(7, 4, "<f4").tobytes(), 0.1001),
    LaserScan(-0.2, 0.05, FAR_M, np.full(9, 4, "<f4").tobytes(), 0.1001),
    LaserScan(-0.2, 0.1, 6.0, np.full(5, 4, "<f4").tobytes(), 0.1001)])
@pytest.mark.parametrize("first", [LOWER, UPPER])
def test_of_lasers_that_differ_in_their_rays_all_echoes_count(first, other):
    bench = Bench()
    bench.feed(first, other, 0.0)
    bench.feed(1 - first, healthy(1), 0.0)
    bench.feed(first, msgspec.structs.replace(other, reference_m=0.1002), PERIOD_S)
    assert set(distances(bench.view)) == {3.0, 4.0}
    assert len(bench.view.points) == 1 + len(other.ranges_f32) // 4


LACKING = {
    "empty": {"ranges_f32": b""}, "torn": {"ranges_f32": healthy(1).ranges_f32[:-1]},
    "few rays": {"ranges_f32": healthy(1).ranges_f32[:8]}, "near": {"range_max_m": 0.3},
    "no range": {"range_max_m": math.nan}, "endless": {"range_max_m": math.inf},
    "turned": {"angle_min_rad": ANGLE_MIN + 0.06}, "nowhere": {"angle_min_rad": math.nan},
    "behind": {"angle_min_rad": ANGLE_MIN - math.tau}, "narrow": {"angle_increment_rad": 0.01},
    "wide": {"angle_increment_rad": 0.2}, "backwards": {"angle_increment_rad": -0.1}}


def lacking(way, i):
    """Return a sweep that shows less than it should and looks like free space."""
    return msgspec.structs.replace(healthy(i, (8, 8, 8, 8, 8)), **LACKING[way])


@pytest.mark.parametrize("bad", [LOWER, UPPER])
@pytest.mark.parametrize("way", LACKING)
def test_a_sweep_that_shows_less_than_it_should_hides_nothing_that_the_other_sees(way, bad):
    bench, alone = Bench(), Bench()
    for i in range(20):
        bench.feed(bad, lacking(way, i) if i >= 5 else healthy(i + 100), i * PERIOD_S)
        bench.feed(1 - bad, healthy(i), i * PERIOD_S)
        assert (bench.view.stamp_s, bench.view.fault) == (i * PERIOD_S, "")
        assert distances(bench.view)[0] == 3.0
    alone.feed(LOWER, lacking(way, 1), 0.0)
    assert "laser" in alone.view.fault
    alone.feed(LOWER, healthy(2), PERIOD_S)
    assert (alone.view.fault, distances(alone.view)) == ("", [3.0])


# ---- a laser's check of itself -------------------------------------------------------------------


def faults(*references):
    check = LaserCheck()
    return [check.fault(reference, i * PERIOD_S) for i, reference in enumerate(references)]


def noise(count):
    dice = random.Random(1)
    return [0.1 + dice.gauss(0, 0.01) for _ in range(count)]


def test_a_healthy_laser_is_believed_for_an_hour_and_one_that_never_had_a_reference_too():
    assert set(faults(*noise(72_000))) == {""}
    assert set(faults(*[-1.0] * 10)) == {""}
    assert "reference" in faults(0.1, -1.0)[-1]


def test_a_laser_that_repeats_itself_is_found_out_with_the_fourth_sweep():
    found = faults(*noise(5), *[0.1] * 6)
    assert found[:8] == [""] * 8
    assert set(found[8:]) == {"the laser repeats itself"}


@pytest.mark.parametrize("off_m", [0.5, -0.3, 0.1, math.nan, math.inf])
def test_a_wrong_reference_is_found_out_at_once_and_not_believed_for_a_second(off_m):
    found = faults(0.1 + off_m, *noise(40))
    assert [bool(why) for why in found] == [True] * 20 + [False] * 21
    assert found[0].startswith("the laser's reference is off by")
