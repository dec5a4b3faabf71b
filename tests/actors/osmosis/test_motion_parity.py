"""Odometry, encoders and gyro of a robot that drives a circle; faults are seen by their readers."""

import math

import pytest

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.motion_check import TURNING_TRACK_M, WHEEL_RADIUS_M, MotionParity

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
