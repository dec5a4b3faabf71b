"""What is made of the sensors: the vote of the IMUs, the filters, the fused state."""

import math
import random

import pytest
from quadrotor import topics as t
from quadrotor.attitude import AttitudeFilter, ImuVote, VerticalFilter
from quadrotor.estimator import FusedState
from quadrotor.rotation import tilt
from quadrotor.vehicle import G_MPS2

DICE = random.Random(7)


def reading(gyro=0.0, up=G_MPS2):
    noise = DICE.gauss(0.0, 1e-3)
    return t.Imu(gyro + noise, 0.0, 0.0, 0.0, 0.0, up + noise)


def voted(wrong, ticks=100):
    """Return vote and rate after a while in which the first IMU is wrong."""
    vote = ImuVote()
    for tick in range(ticks):
        now_s = tick * 0.01
        if wrong is not None:
            vote.take(0, wrong, now_s)
        vote.take(1, reading(), now_s)
        vote.take(2, reading(), now_s)
        found = vote.vote(now_s)
    return vote, found


@pytest.mark.parametrize("wrong", [
    t.Imu(3.0, 0.0, 0.0, 0.0, 0.0, 2.0), t.Imu(math.nan, 0.0, 0.0, 0.0, 0.0, 9.8), None,
    t.Imu(0.001, 0.0, 0.0, 0.0, 0.0, 9.81)], ids=["biased", "no number", "silent", "stuck"])
def test_one_imu_that_is_wrong_is_outvoted(wrong):
    vote, found = voted(wrong)
    assert vote.sound == 2
    rate, force = found
    assert rate[0] == pytest.approx(0.0, abs=0.01)
    assert force[2] == pytest.approx(G_MPS2, abs=0.01)


def test_attitude_at_rest_on_a_slope_is_that_of_the_slope():
    attitude = AttitudeFilter()
    attitude.level((G_MPS2 * math.sin(0.2), 0.0, G_MPS2 * math.cos(0.2)), 0.0)
    assert tilt(attitude.q) == pytest.approx(0.2)
    assert attitude.upward((G_MPS2 * math.sin(0.2), 0.0, G_MPS2 * math.cos(0.2))
                           ) == pytest.approx(0.0, abs=1e-6)


def test_attitude_follows_the_gyro_and_forgets_a_bias_slowly():
    attitude = AttitudeFilter()
    attitude.begin((1.0, 0.0, 0.0, 0.0))
    for _ in range(50):
        attitude.step((0.4, 0.0, 0.0), (0.0, 0.0, G_MPS2), None, 0.01)
    assert tilt(attitude.q) == pytest.approx(0.2, abs=0.02)
    for _ in range(6000):
        attitude.step((0.0, 0.0, 0.0), (0.0, 0.0, G_MPS2), None, 0.01)
    assert tilt(attitude.q) < 0.01


def test_vertical_speed_comes_from_pressure_and_acceleration():
    vertical = VerticalFilter()
    for tick in range(2000):
        vertical.step(0.05, 0.01)  # the accelerometer is off by that much
        if tick % 5 == 0:
            vertical.measured(-0.5 * tick * 0.01 + DICE.gauss(0.0, 1e-4), 0.05)
    assert vertical.speed_mps == pytest.approx(-0.5, abs=0.15)


def test_a_barometer_that_jumps_there_and_back_does_not_pass_for_speed():
    vertical, fastest_mps = VerticalFilter(), 0.0
    for tick in range(2000):
        vertical.step(0.0, 0.01)
        if tick % 5 == 0:
            bias_m = -6.0 if 500 < tick < 900 else 0.0
            vertical.measured(5.0 + bias_m + DICE.gauss(0.0, 0.1), 0.05)
        fastest_mps = max(fastest_mps, abs(vertical.speed_mps))
    assert fastest_mps < 0.2


def fix(x_m=0.0, speed_mps=0.0):
    return t.GpsFix(x_m + DICE.gauss(0.0, 1e-4), 0.0, 5.0, speed_mps, 0.0, 0.0)


def test_a_fix_that_jumps_pulls_slowly_enough_to_be_noticed():
    state = FusedState()
    state.fix(fix(), 0.0)
    for tick in range(1, 11):
        state.fix(fix(x_m=8.0), tick * 0.1)
    assert 0.1 < state.position[0] < 0.6


def test_what_is_no_number_or_repeated_is_not_taken():
    state = FusedState()
    stuck = fix(x_m=1.0)
    state.fix(stuck, 0.0)
    before = list(state.position)
    state.fix(stuck, 0.1)
    state.fix(t.GpsFix(math.nan, 0.0, 0.0, 0.0, 0.0, 0.0), 0.2)
    state.pressure(math.inf, 0.05)
    assert state.position == before
    assert state.fix_s == 0.0
