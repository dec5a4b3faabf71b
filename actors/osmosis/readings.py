"""What each sensor's reading means, and whether it means anything: the one place that decides.

A sensor that reports nonsense is a sensor that reports nothing. Zero, a negative number or NaN is
what drivers report for a measurement that failed, and a reader that calculates with it would
believe it. So every reader asks here first, and what is nonsense it treats as if it had never
arrived: its reader sees the sensor fall silent.

The unit is what the device measures by itself: of a laser a ray, of all others the message.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from rampart.actors.ftm.plausible import is_sane
from rampart.actors.osmosis.control.polyline import Array
from rampart.actors.osmosis.messages import BaseStatus, GpsFix, Imu, LightSample, Odometry, Pose

_TURN_RAD = math.pi + 1e-6
"""Angles are in (-pi, pi], and may come from float32."""

_FASTEST = 100.0
"""Nothing that drives on an airport goes at so many m/s, or turns at so many rad/s."""

_FASTEST_WHEEL_RADPS = 1e3
_HARDEST_MPS2 = 1e3

_BRIGHTEST_LUX = 2e5
"""Sunlight is 1.2e5 lux."""

_ROUNDING = 1e-6


@lru_cache(maxsize=8)
def ray_distances(ranges_f32: bytes, range_max_m: float, near_m: float = 0.0) -> Array:
    """Return what each ray of a laser sweep means: the distance of its echo in m, infinity, or NaN.

    Infinity means that nothing is there up to `range_max_m`: the device reports that range, or
    infinity. NaN means that nothing is known: the range is not a number, zero or negative, below
    `near_m`, or beyond `range_max_m`. Readers must not take NaN for free space.

    Args:
        ranges_f32: little-endian float32; what is not a whole number of them is cut off.
        range_max_m: of the device.
        near_m: nearer than this the laser has no echo: it would lie within the robot.

    Returns:
        Read-only, one element per ray.
    """
    ranges = np.frombuffer(ranges_f32[: len(ranges_f32) // 4 * 4], dtype="<f4").astype(np.float64)
    with np.errstate(invalid="ignore"):
        free = (ranges == math.inf) | (abs(ranges - range_max_m) <= range_max_m * _ROUNDING)
    echo = (ranges > 0.0) & (ranges >= near_m) & (ranges < range_max_m)
    found = np.where(free, math.inf, np.where(echo, ranges, math.nan))
    found.flags.writeable = False
    return found


def is_pose(pose: Pose) -> bool:
    """Whether a pose can be one."""
    return is_sane(pose.x_m, pose.y_m) and abs(pose.yaw_rad) <= _TURN_RAD


def is_odometry(reading: Odometry) -> bool:
    """Whether pose and velocity can be a robot's."""
    twist = reading.twist
    return is_pose(reading.pose) and abs(twist.linear_mps) <= _FASTEST \
        and abs(twist.angular_radps) <= _FASTEST


def is_imu(reading: Imu) -> bool:
    """Whether heading, rate and acceleration can be a robot's."""
    return abs(reading.yaw_rad) <= _TURN_RAD and abs(reading.yaw_rate_radps) <= _FASTEST \
        and abs(reading.accel_x_mps2) <= _HARDEST_MPS2 \
        and abs(reading.accel_y_mps2) <= _HARDEST_MPS2


def is_fix(fix: GpsFix) -> bool:
    """Whether a fix can be one; a receiver that claims an error of 0 m has none."""
    return fix.accuracy_m > 0 and is_sane(fix.x_m, fix.y_m, fix.accuracy_m) \
        and math.hypot(fix.velocity_x_mps, fix.velocity_y_mps) <= _FASTEST


def is_light(sample: LightSample) -> bool:
    """Whether an illuminance can be one on earth."""
    return 0.0 <= sample.illuminance_lux <= _BRIGHTEST_LUX


def is_base_status(status: BaseStatus) -> bool:
    """Whether the speeds of the wheels can be a robot's."""
    return all(abs(speed) <= _FASTEST_WHEEL_RADPS for speed in status.wheel_speeds_radps)
