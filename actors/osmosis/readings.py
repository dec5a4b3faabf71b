"""Validity of sensor readings.

An invalid reading counts as missing. Drivers report a failed measurement as zero, a negative number
or NaN, and a reader would calculate with it. So each reader checks here first and drops an invalid
reading, as if the sensor were silent.

The unit is one measurement: of a laser a ray, of all other sensors a message.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from rampart.actors.ftm.plausible import is_sane
from rampart.actors.osmosis.control.polyline import Array
from rampart.actors.osmosis.messages import BaseStatus, GpsFix, Imu, LightSample, Odometry, Pose

_TURN_RAD = math.pi + 1e-6
"""Largest angle, with the rounding of float32."""

_FASTEST = 100.0
"""Largest plausible speed, m/s, and turn rate, rad/s."""

_FASTEST_WHEEL_RADPS = 1e3
_HARDEST_MPS2 = 1e3

_BRIGHTEST_LUX = 2e5
"""Largest plausible illuminance; sunlight is 1.2e5 lux."""

_ROUNDING = 1e-6


@lru_cache(maxsize=8)
def ray_distances(ranges_f32: bytes, range_max_m: float, near_m: float = 0.0) -> Array:
    """Return for each ray of a sweep the distance of its echo in m, infinity, or NaN.

    Infinity: no echo up to `range_max_m`; the device reports that range or infinity. NaN: unknown;
    the range is NaN, zero or negative, below `near_m`, or beyond `range_max_m`. Readers must not
    treat NaN as free space.

    Args:
        ranges_f32: little-endian float32; trailing bytes are ignored.
        range_max_m: range of the device.
        near_m: least distance of an echo; a nearer one would lie within the robot.

    Returns:
        Read-only array, one element per ray.
    """
    ranges = np.frombuffer(ranges_f32[: len(ranges_f32) // 4 * 4], dtype="<f4").astype(np.float64)
    with np.errstate(invalid="ignore"):
        free = (ranges == math.inf) | (abs(ranges - range_max_m) <= range_max_m * _ROUNDING)
    echo = (ranges > 0.0) & (ranges >= near_m) & (ranges < range_max_m)
    found = np.where(free, math.inf, np.where(echo, ranges, math.nan))
    found.flags.writeable = False
    return found


def is_pose(pose: Pose) -> bool:
    """Whether a pose is plausible."""
    return is_sane(pose.x_m, pose.y_m) and abs(pose.yaw_rad) <= _TURN_RAD


def is_odometry(reading: Odometry) -> bool:
    """Whether pose and velocity are plausible."""
    twist = reading.twist
    return is_pose(reading.pose) and abs(twist.linear_mps) <= _FASTEST \
        and abs(twist.angular_radps) <= _FASTEST


def is_imu(reading: Imu) -> bool:
    """Whether heading, rate and acceleration are plausible."""
    return abs(reading.yaw_rad) <= _TURN_RAD and abs(reading.yaw_rate_radps) <= _FASTEST \
        and abs(reading.accel_x_mps2) <= _HARDEST_MPS2 \
        and abs(reading.accel_y_mps2) <= _HARDEST_MPS2


def is_fix(fix: GpsFix) -> bool:
    """Whether a fix is plausible; an accuracy of 0 m is not."""
    return fix.accuracy_m > 0 and is_sane(fix.x_m, fix.y_m, fix.accuracy_m) \
        and math.hypot(fix.velocity_x_mps, fix.velocity_y_mps) <= _FASTEST


def is_light(sample: LightSample) -> bool:
    """Whether an illuminance is plausible."""
    return 0.0 <= sample.illuminance_lux <= _BRIGHTEST_LUX


def is_base_status(status: BaseStatus) -> bool:
    """Whether the wheel speeds are plausible."""
    return all(abs(speed) <= _FASTEST_WHEEL_RADPS for speed in status.wheel_speeds_radps)
