"""The laser's check of itself: which sweeps are believed."""

from __future__ import annotations

import math
import random

import msgspec
import pytest

from rampart.actors.osmosis import topics
from rampart.actors.osmosis.control.pilot.laser_pair import LaserCheck
from rampart.sim.campaign.job import Job, run_job
from rampart.sim.faults.scenario import parse_fault
from rampart.sim.osmosis.trial.faults import OsmosisFaults
from tests.whole.missions import write_near_mission


def judge(references, period_s=0.05):
    check = LaserCheck()
    return [check.fault(r, i * period_s) for i, r in enumerate(references)]


def healthy(count, seed=1):
    dice = random.Random(seed)
    return [0.1 + dice.gauss(0, 0.01) for _ in range(count)]


def test_a_healthy_laser_is_believed_for_an_hour():
    assert set(judge(healthy(72_000))) == {""}


def test_a_device_without_a_reference_is_believed():
    assert judge([-1.0] * 10) == [""] * 10


def test_a_laser_that_repeats_itself_is_found_out_with_the_fourth_sweep():
    found = judge([*healthy(5), *[0.1] * 6])
    assert found[:8] == [""] * 8
    assert set(found[8:]) == {"the laser repeats itself"}


@pytest.mark.parametrize("off_m", [0.5, -0.3, 0.1, math.nan, math.inf])
def test_a_wrong_reference_is_found_out_at_once(off_m):
    assert judge([*healthy(5), 0.1 + off_m])[5].startswith("the laser's reference is off by")


def test_after_a_wrong_sweep_the_laser_is_not_believed_for_a_second():
    found = judge([0.5, *healthy(40)])
    assert [bool(why) for why in found] == [True] * 20 + [False] * 21


@pytest.mark.parametrize("fault", [
    "laser-bias@26+inf", "stuck:summit_xl/scan@2+inf",
    *(pytest.param(f"laser-{way}@26+inf", marks=pytest.mark.slow)
      for way in ("stuck", "noise", "dropout"))])
def test_a_robot_that_cannot_trust_its_laser_stands(fault):
    result = run_job(Job(row="x", system="paper", options={"mission": "A", "obstacles": 2},
                         faults=(parse_fault(fault),)))
    assert (result.safe, result.success) == (True, False)
    assert result.duration_s < 26 + 43


def test_once_the_laser_is_right_again_the_mission_goes_on(tmp_path):
    mission = str(write_near_mission(tmp_path))
    result = run_job(Job(row="x", system="paper", options={"mission": mission},
                         faults=(parse_fault("laser-stuck@12+3"),)))
    assert result.effective
    assert (result.safe, result.success) == (True, True)


@pytest.mark.slow
@pytest.mark.parametrize("field", ["ranges_f32", "angle_min_rad", "angle_increment_rad"])
def test_one_wrong_number_of_one_laser_hides_no_obstacle_from_a_robot_with_two(field):
    seed = next(seed for seed in range(1, 999, 2) for offsets in [
        OsmosisFaults().find("corrupt:summit_xl/scan", seed, topics.ALL
                             ).disturbances[0].add_fields]
        if offsets.get(field, 0) > 0)
    wrong = msgspec.structs.replace(parse_fault("corrupt:summit_xl/scan@13+inf"), seed=seed)
    result = run_job(Job(row="x", options={"mission": "A"}, seed=1,
                         faults=(wrong, parse_fault("obstacle-ahead:4@14.1"))))
    assert (result.safe, result.success) == (True, True)
