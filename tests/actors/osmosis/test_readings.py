"""An invalid reading counts as missing."""

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.control.limits_from_spec import reach_of
from rampart.actors.osmosis.control.pilot.laser_pair import LOWER, UPPER, LaserPair
from rampart.actors.osmosis.page.state import thin
from rampart.actors.osmosis.readings import (
    is_base_status,
    is_fix,
    is_imu,
    is_light,
    is_odometry,
    is_pose,
    ray_distances,
)
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
    meaning = ray_distances(as_bytes([3.0, *FREE, *NO_RAY]) + b"\1", 8.0, near_m=0.25)
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
    (is_pose, POSE), (is_odometry, m.Odometry(POSE, TWIST)), (is_imu, m.Imu(0.1, 0.0, 0.2, -0.1)),
    (is_fix, m.GpsFix(1.0, 2.0, 0.5, 0.0, 0.02)), (is_light, m.LightSample(0.0)),
    (is_base_status, m.BaseStatus(False, False, 0.0, (8.0, 8.0, 8.0, 8.0)))]


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
    assert not is_light(m.LightSample(-1.0))
    assert not is_pose(m.Pose(0.0, 0.0, 7.0))
    assert not is_fix(m.GpsFix(0.0, 0.0, 0.0, 0.0, 0.0))  # as a receiver without a fix says
    assert not is_fix(m.GpsFix(1.0, 2.0, 0.0, 0.0, -1.0))


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
