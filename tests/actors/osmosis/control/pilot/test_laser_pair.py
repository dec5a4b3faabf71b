"""Two lasers: whatever happens to one of them, the other's view stays, and nothing is unseen."""

import math
import random

import msgspec
import numpy as np
import pytest

from rampart.actors.osmosis.control.pilot.laser_pair import (
    LOWER,
    UPPER,
    LaserCheck,
    LaserPair,
    LaserReach,
)
from rampart.actors.osmosis.messages import LaserScan

RAYS, TOP_M, PERIOD_S = 5, 8.0, 0.05
ANGLE_MIN = -0.2
REACH = LaserReach(range_m=5.0, field_rad=0.4, gap_rad=0.1)


def sweep(ranges, reference_m=0.1):
    return LaserScan(ANGLE_MIN, 0.1, TOP_M, np.array(ranges, "<f4").tobytes(), reference_m)


def healthy(i, ranges=(8, 8, 3, 8, 8)):
    return sweep(ranges, 0.1 + 0.001 * math.sin(i + 1))


def distances(view):
    return sorted(round(float(np.hypot(*point)), 3) for point in view.points)


class Bench:
    """Feeds a pair sweep by sweep and keeps the view that is in force."""

    def __init__(self):
        self.pair, self.view = LaserPair(REACH), None

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
    LaserScan(-0.3, 0.1, TOP_M, np.full(7, 4, "<f4").tobytes(), 0.1001),
    LaserScan(-0.2, 0.05, TOP_M, np.full(9, 4, "<f4").tobytes(), 0.1001),
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
