"""Where the pose filter starts: from both positions if they agree, or from the only one."""

from __future__ import annotations

import math

import msgspec

from rampart.actors.osmosis.control.localization.motion_check import ImuCheck, OdometryCheck
from rampart.actors.osmosis.control.localization.position_source import PositionSource
from rampart.actors.osmosis.control.polyline import wrap_angle

GPS_VELOCITY_SD_MPS, SIDESLIP_RAD = 0.03, 0.03
COURSE_FROM_MPS = 0.4
"""Slower than this, the velocity over ground does not say where the robot is heading."""

_APART_M = 0.3
_ALONE_S = 0.15
_IMU_SD_RAD = 0.05


class FirstPose(msgspec.Struct, frozen=True):
    """Where to start.

    Attributes:
        source: whose newest reading is the position.
        yaw_rad: heading in `map`.
        heading_sd_rad: its standard deviation; None for that of the absolute pose.
    """

    source: PositionSource
    yaw_rad: float
    heading_sd_rad: float | None = None


def find_first(pose: PositionSource, gps: PositionSource, wheels: OdometryCheck, gyro: ImuCheck,
               *, now_s: float, waited_s: float) -> FirstPose | None:
    """Return where to start; None if that is not known yet.

    Without an absolute pose the heading is the IMU's, which was aligned before the mission, or
    else the course over ground of a robot that moves forward.

    Args:
        pose: the absolute pose.
        gps: GPS.
        wheels: for the direction of motion.
        gyro: the IMU.
        now_s: now.
        waited_s: since the first reading; a position that is alone is believed after a short wait.
    """
    by_pose, by_gps = pose.fresh(now_s), gps.fresh(now_s)
    if by_pose and by_gps:
        dt_s = pose.stamp_s - gps.stamp_s
        there = [at + v * dt_s for at, v in zip(gps.reading, gps.velocity, strict=False)]
        return FirstPose(pose, pose.reading[2]) \
            if math.dist(there, pose.reading[:2]) <= _APART_M else None
    # If it is neither, what came is late already, on a machine that is busy.
    if not (by_pose or by_gps) or waited_s < _ALONE_S:
        return None
    if by_pose:
        return FirstPose(pose, pose.reading[2])
    if gyro.usable(now_s):
        return FirstPose(gps, wrap_angle(gyro.yaw_rad), _IMU_SD_RAD)
    vx, vy = gps.velocity
    speed_mps = math.hypot(vx, vy)
    if speed_mps > COURSE_FROM_MPS and wheels.speed_mps > 0:
        return FirstPose(gps, math.atan2(vy, vx), GPS_VELOCITY_SD_MPS / speed_mps + SIDESLIP_RAD)
    return None
