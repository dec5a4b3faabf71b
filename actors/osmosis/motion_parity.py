"""Whether odometry, encoders and gyro measure the same motion.

Odometry and the base's own wheel speeds reach the robot in two messages. While they agree, a wrong
odometry is excluded as the reason why dead reckoning and positions differ. Three comparisons, each
summed up with forgetting, so that what passes as one step does not pass for ever:

* odometry against encoders, way and turn, over a second and over a minute;
* the two wheels of a side, which are commanded alike: a wheel that is stuck or weak skids, and
  then neither odometry nor encoders measure the way of the robot;
* the gyro's turn against the wheels', of which skid steering leaves a share uncertain, over 5 and
  20 s; and the IMU against itself (`motion_check`).

Localization, DM1 and DM8 each have an instance. Speeds are m/s, turns rad, times simulated s.
"""

from __future__ import annotations

import math

import msgspec

from rampart.actors.ftm.plausible import is_possible
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.control.localization.motion_check import ImuCheck
from rampart.actors.osmosis.readings import is_base_status, is_odometry

WHEEL_RADIUS_M = 0.1175
TURNING_TRACK_M = 0.916
"""Of a base that turns by skidding: difference of the sides' ways per radian."""

BACK_AFTER_S = 2.0
"""How long the measurements must have agreed again."""

_FRESH_S, _GYRO_FRESH_S = 0.35, 0.1
_LONGEST_STEP_S, _LONGEST_ODOMETRY_S = 0.5, 0.2
_SOON_S, _LATE_S, _TURNS_S = 1.0, 60.0, (5.0, 20.0)
# Measured without a fault, at most: 0.04 and 0.10 m, 0.08 and 0.21 rad, 1e-5 m, 0.04 m/s, 0.03 rad.
_SOON_M, _LATE_M, _SOON_RAD, _LATE_RAD = 0.08, 0.2, 0.3, 0.4
_OWN_M = 0.05
"""By which the way of the odometry's pose may differ from that of its twist."""
_PAIR_MPS = 0.1
"""Average over a second by which a wheel may lag behind its neighbour, more on a turn."""
_CAP = 1.2
_SLIP_SHARE, _GYRO_RAD = 0.05, 0.05


class MotionParity:
    """Compares the devices; hand it every reading.

    Attributes:
        gyro_agrees: whether the gyro turns as the wheels do.
    """

    def __init__(self) -> None:
        self.gyro_agrees = True
        self._encoders_flawed_s = self._odometry_flawed_s = self._gyro_flawed_s = -math.inf
        self._status_s = self._odometry_s = self._gap_s = -math.inf
        self._linear_mps = self._turn_radps = 0.0
        self._pose: m.Pose | None = None
        self._gyro_was: float | None = None
        self._way = [0.0, 0.0]
        self._turn = [0.0, 0.0]
        self._lag = [0.0, 0.0]
        self._own = 0.0
        self._turned = [(0.0, 0.0)] * len(_TURNS_S)
        self._imu = ImuCheck()

    def confirmed(self, now_s: float) -> bool:
        """Whether encoders are received and confirm odometry, of which nothing is missing."""
        return (now_s - self._status_s <= _FRESH_S and self.whole(now_s) and self.sure(now_s))

    def whole(self, now_s: float) -> bool:
        """Whether no odometry was missing lately: the way meanwhile would not be known."""
        return (now_s - self._odometry_s <= _LONGEST_ODOMETRY_S
                and now_s - self._gap_s > BACK_AFTER_S)

    def sure(self, now_s: float) -> bool:
        """Whether nothing contradicts odometry; what is missing does not."""
        return now_s - self._odometry_flawed_s > BACK_AFTER_S and self.encoders_agree(now_s)

    def encoders_agree(self, now_s: float) -> bool:
        """Whether the encoders do not contradict odometry, nor each other."""
        return now_s - self._encoders_flawed_s > BACK_AFTER_S

    def imu(self, reading: m.Imu, stamp_s: float, now_s: float) -> None:
        """Take the gyro's heading."""
        self._imu.take(stamp_s, reading, now_s)

    def odometry(self, reading: m.Odometry, stamp_s: float, now_s: float) -> None:
        """Take odometry, and compare its turn with the gyro's."""
        twist, (x_m, y_m, yaw_rad) = reading.twist, msgspec.structs.astuple(reading.pose)
        if not stamp_s > self._odometry_s or not is_possible(stamp_s, now_s) \
                or not is_odometry(reading):
            return
        dt_s, self._odometry_s = stamp_s - self._odometry_s, stamp_s
        mean_mps = abs(self._linear_mps + twist.linear_mps) / 2
        self._linear_mps, self._turn_radps = twist.linear_mps, twist.angular_radps
        was, self._pose = self._pose, reading.pose
        if was is None:
            return
        if dt_s > _LONGEST_ODOMETRY_S:
            self._gap_s = stamp_s
            return
        step_m = math.hypot(x_m - was.x_m, y_m - was.y_m)
        self._own = _capped(
            self._own * (1.0 - dt_s) + step_m - mean_mps * dt_s, _OWN_M)
        if abs(self._own) > _OWN_M:
            self._odometry_flawed_s = stamp_s
        self._compare_turns(yaw_rad - was.yaw_rad, dt_s)

    def _compare_turns(self, wheels_rad: float, dt_s: float) -> None:
        stamp_s = self._odometry_s
        gyro_s, gyro_yaw = self._imu.stamp_s, self._imu.yaw_rad
        gyro_was = self._gyro_was
        self._gyro_was = gyro_yaw if stamp_s - gyro_s <= _GYRO_FRESH_S else None
        if gyro_was is None or self._gyro_was is None:
            return
        wheels = math.remainder(wheels_rad, math.tau)
        gyro = math.remainder(gyro_yaw - gyro_was, math.tau)
        astray = bool(self._imu.distrust)
        for which, over_s in enumerate(_TURNS_S):
            off, turned = (each * (1.0 - dt_s / over_s) for each in self._turned[which])
            turned += max(abs(wheels), abs(gyro))
            most = _GYRO_RAD + _SLIP_SHARE * turned
            off = _capped(off + gyro - wheels, most)
            self._turned[which] = (off, turned)
            astray = astray or (abs(off) > most and self.sure(stamp_s))
        if astray:
            self._gyro_flawed_s = stamp_s
        self.gyro_agrees = stamp_s - self._gyro_flawed_s > BACK_AFTER_S

    def encoders(self, reading: m.BaseStatus, stamp_s: float, now_s: float) -> None:
        """Take the wheels' speeds, and compare them with each other and with odometry."""
        speeds = reading.wheel_speeds_radps
        if not stamp_s > self._status_s or not is_possible(stamp_s, now_s) \
                or not is_base_status(reading):
            return
        dt_s, self._status_s = stamp_s - self._status_s, stamp_s
        if dt_s > _LONGEST_STEP_S or stamp_s - self._odometry_s > 0.1:
            return
        front_left, front_right, rear_left, rear_right = (s * WHEEL_RADIUS_M for s in speeds)
        left, right = (front_left + rear_left) / 2, (front_right + rear_right) / 2
        way_m = ((left + right) / 2 - self._linear_mps) * dt_s
        turn_rad = ((right - left) / TURNING_TRACK_M - self._turn_radps) * dt_s
        soon, late = 1.0 - dt_s / _SOON_S, 1.0 - dt_s / _LATE_S
        self._way = [_capped(self._way[0] * soon + way_m, _SOON_M),
                     _capped(self._way[1] * late + way_m, _LATE_M)]
        self._turn = [_capped(self._turn[0] * soon + turn_rad, _SOON_RAD),
                      _capped(self._turn[1] * late + turn_rad, _LATE_RAD)]
        self._lag = [self._lag[0] * soon + (front_left - rear_left) * dt_s,
                     self._lag[1] * soon + (front_right - rear_right) * dt_s]
        if abs(self._way[0]) > _SOON_M or abs(self._way[1]) > _LATE_M \
                or abs(self._turn[0]) > _SOON_RAD or abs(self._turn[1]) > _LATE_RAD \
                or max(map(abs, self._lag)) > _PAIR_MPS:
            self._encoders_flawed_s = stamp_s


def _capped(total: float, most: float) -> float:
    """Keep a sum near its limit: a device that has recovered is believed again soon."""
    return max(-_CAP * most, min(_CAP * most, total))
