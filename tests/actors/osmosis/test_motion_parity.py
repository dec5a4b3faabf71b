"""Odometry, encoders and gyro of a robot that drives on a made-up way, one of them wrong."""

from __future__ import annotations

import math

import pytest

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.motion_check import (
    TURNING_TRACK_M,
    WHEEL_RADIUS_M,
    MotionParity,
)

STEP_S = 0.02


def drive(parity, seconds, *, start_s=0.0, odometry=1.0, wheels=(1.0, 1.0, 1.0, 1.0), gyro=0.0,
          without=()):
    """Drive a circle at 1 m/s and 0.2 rad/s, and return the time at its end, s.

    Args:
        parity: receives the readings.
        seconds: How long.
        start_s: Time at the beginning.
        odometry: Factor on the way of odometry.
        wheels: Factors on front left, front right, rear left, rear right.
        gyro: Bias, rad/s.
        without: silent devices.
    """
    now_s = start_s
    for _ in range(round(seconds / STEP_S)):
        now_s += STEP_S
        yaw = 0.2 * now_s
        if "imu" not in without:
            turned = math.remainder(yaw + gyro * now_s, math.tau)
            parity.imu(m.Imu(turned, 0.2 + gyro, 0.0, 0.2), now_s, now_s)
        if "odometry" not in without:
            at = m.Pose(odometry * 5 * math.sin(yaw), odometry * 5 * (1 - math.cos(yaw)),
                        math.remainder(yaw, math.tau))
            parity.odometry(m.Odometry(at, m.Twist(odometry, 0.2)), now_s, now_s)
        if "encoders" not in without:
            aside = 0.2 * TURNING_TRACK_M / 2
            left, right = 1.0 - aside, 1.0 + aside
            speeds = [mps * share / WHEEL_RADIUS_M for mps, share in
                      zip((left, right, left, right), wheels, strict=True)]
            parity.encoders(status(tuple(speeds)), now_s, now_s)
    return now_s


def status(speeds):
    return m.BaseStatus(brake_engaged=False, dead_man_tripped=False, command_age_s=0.0,
                        wheel_speeds_radps=speeds)


def test_devices_that_agree_confirm_the_motion():
    parity = MotionParity()
    end_s = drive(parity, 20.0)
    assert parity.confirmed(end_s)
    assert parity.gyro_agrees


@pytest.mark.parametrize("wrong", [
    {"odometry": 1.15}, {"odometry": 0.0}, {"odometry": 1.02},
    {"wheels": (0.0, 1.0, 1.0, 1.0)}, {"wheels": (1.2, 1.0, 1.2, 1.0)}])
def test_a_way_that_odometry_and_encoders_measure_differently_is_not_confirmed(wrong):
    parity = MotionParity()
    end_s = drive(parity, 30.0, **wrong)
    assert not parity.confirmed(end_s)


@pytest.mark.parametrize("silent", ["odometry", "encoders"])
def test_a_silent_device_confirms_nothing_and_contradicts_nothing(silent):
    parity = MotionParity()
    end_s = drive(parity, 5.0, start_s=drive(parity, 5.0), without=(silent,))
    assert not parity.confirmed(end_s)
    assert parity.sure(end_s)


def test_a_gyro_that_drifts_does_not_agree_with_the_wheels():
    parity = MotionParity()
    drive(parity, 30.0, gyro=0.03)
    assert not parity.gyro_agrees


@pytest.mark.parametrize("lost", [("odometry",), ("imu",), ("odometry", "imu", "encoders")])
def test_a_turn_that_is_missed_in_part_is_not_held_against_the_gyro(lost):
    """The event loop of a module was late, or messages were lost."""
    parity = MotionParity()
    end_s = drive(parity, 1.0, start_s=drive(parity, 5.0), without=lost)
    drive(parity, 1.0, start_s=end_s)
    assert parity.gyro_agrees
