"""Parity checks of odometry, encoders and IMU.

**Each device against itself** (`OdometryCheck`, `ImuCheck`). Odometry reports a pose and a twist,
the IMU a heading and a turning rate: an integral and its rate, from the same wheels or gyro. Both
must give the same motion since the last message, up to rounding: a parity check without a model of
the robot (analytical redundancy; Isermann, "Fault-Diagnosis Systems", 2006, chapter 10). Small
differences may add up over many steps, so their sum is checked too, with slow forgetting. A MEMS
device never repeats a reading bit by bit; one that does is stuck, even with fresh stamps. Odometry
has no such check, since wheels at rest repeat readings.

**The devices against each other** (`MotionParity`). Odometry and the wheel speeds of the base
arrive in two messages. While they agree, wrong odometry is excluded as the reason why dead
reckoning and positions differ. Three comparisons, each summed with forgetting:

* odometry against encoders, distance and turn, over a second and over a minute;
* the two wheels of a side, which have the same command: a stuck or weak wheel skids, and then
  neither odometry nor encoders measure the motion of the robot;
* the gyro's turn against the wheels', of which skid steering leaves a share uncertain, over 5 and
  20 s.

Localization, DM1 and DM8 each have an instance. Speeds are m/s, turns rad, times simulated s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import msgspec

from rampart.actors.ftm.plausible import is_possible
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.control.polyline import wrap_angle
from rampart.actors.osmosis.messages import Imu, Odometry
from rampart.actors.osmosis.readings import is_base_status, is_imu, is_odometry

BACK_AFTER_S = 1.0
"""Time without a flaw after which a device is trusted again."""

LONGEST_STEP_S = 0.2
"""After a longer gap a message is not compared with the one before."""

_FLAT_READINGS = 3
"""Consecutive equal readings of a stuck device."""


class ParityLimits(msgspec.Struct, frozen=True):
    """Largest differences between integral and rate.

    Args:
        step: in one step, m or rad.
        sum: summed with forgetting, m or rad.
        forget_s: time constant of the forgetting; a rate error r adds up to r * forget_s.
        fastest: largest possible rate, m/s or rad/s.
    """

    step: float
    sum: float
    forget_s: float
    fastest: float


ODOMETRY_PARITY = ParityLimits(step=0.02, sum=0.05, forget_s=1.0, fastest=3.6)
"""Measured without a fault: 1e-6 m a step, 0.6 mm after a lost message at 1.5 m/s2. A speed that is
0.1 m/s too high reaches the sum's limit in 0.7 s. The drive's top speed is 3 m/s."""

IMU_PARITY = ParityLimits(step=0.02, sum=0.02, forget_s=2.0, fastest=3.6)
"""Measured without a fault: below 1e-15 rad a step, 0.4 mrad after a lost message at 4 rad/s2. A
rate error of 0.02 rad/s reaches the sum's limit in 1.4 s."""

_SLOW_S, _SLOW_RAD, _SLOW_MOST_RAD = 60.0, 0.03, 0.035
"""The same over a minute, for a heading that drifts by milliradians a second. The sum is capped, so
that a recovered device is soon trusted again."""


@dataclass(slots=True)
class Source:
    """A sensor and whether it is trusted.

    Attributes:
        name: display name.
        fresh_s: greatest age of a present reading.
        distrust: why it is excluded; "" if it is trusted.
        stamp_s: time of the newest reading.
    """

    name: str
    fresh_s: float
    distrust: str = field(default="", init=False)
    stamp_s: float = field(default=-math.inf, init=False)
    _clean_since_s: float = field(default=-math.inf, init=False)

    def flaw(self, reason: str, stamp_s: float) -> None:
        """Exclude it from now on; the first reason stays."""
        self.distrust = self.distrust or reason
        self._clean_since_s = stamp_s

    def clean(self, stamp_s: float) -> None:
        """Count a message without a flaw."""
        if self.distrust and stamp_s - self._clean_since_s >= BACK_AFTER_S:
            self.distrust = ""

    def fresh(self, now_s: float) -> bool:
        """Whether its newest reading is present."""
        return now_s - self.stamp_s <= self.fresh_s

    def usable(self, now_s: float) -> bool:
        """Whether its newest reading is present and it is trusted."""
        return not self.distrust and now_s - self.stamp_s <= self.fresh_s

    def why_not(self, now_s: float) -> str:
        """Return why it is not in use, or ""."""
        if self.distrust or self.usable(now_s):
            return self.distrust
        return "never received" if self.stamp_s == -math.inf else "silent or late"


class OdometryCheck(Source):
    """Checks odometry and gives the motion since the last message.

    Attributes:
        speed_mps: speed of the newest message.
    """

    def __init__(self) -> None:
        super().__init__("odometry", fresh_s=0.15)
        self.speed_mps = 0.0
        self._pose = (0.0, 0.0, 0.0)
        self._sum = (0.0, 0.0)

    def take(self, stamp_s: float, reading: Odometry) -> tuple[float, float, float] | None:
        """Take a message; return (duration s, distance forward m, turn rad) since the last one.

        Returns:
            None for the first message, after a gap, and for an old, invalid or flawed message.
        """
        pose = x_m, y_m, yaw_rad = reading.pose.x_m, reading.pose.y_m, reading.pose.yaw_rad
        linear_mps = reading.twist.linear_mps
        if not stamp_s > self.stamp_s or not is_odometry(reading):
            return None
        then_s, was = self.stamp_s, self._pose
        self.stamp_s, self._pose, self.speed_mps = stamp_s, pose, linear_mps
        dt_s = stamp_s - then_s
        if dt_s > LONGEST_STEP_S:
            return None
        limits = ODOMETRY_PARITY
        turn = wrap_angle(yaw_rad - was[2])
        middle = was[2] + turn / 2
        cos, sin = math.cos(middle), math.sin(middle)
        dx, dy = x_m - was[0], y_m - was[1]
        forward_m = dx * cos + dy * sin
        off_x, off_y = dx - linear_mps * dt_s * cos, dy - linear_mps * dt_s * sin
        if abs(linear_mps) > limits.fastest or math.hypot(off_x, off_y) > limits.step + dt_s**2:
            self._sum = (0.0, 0.0)
            self.flaw("pose and twist contradict each other", stamp_s)
            return None
        keep = max(0.0, 1.0 - dt_s / limits.forget_s)
        self._sum = sum_x, sum_y = self._sum[0] * keep + off_x, self._sum[1] * keep + off_y
        if sum_x * sum_x + sum_y * sum_y > limits.sum**2:
            self.flaw("pose and twist drift apart", stamp_s)
        else:
            self.clean(stamp_s)
        return dt_s, forward_m, turn


class ImuCheck(Source):
    """Checks the IMU and gives the heading at any time near the newest message.

    Attributes:
        yaw_rad: heading of the newest message.
        rate_radps: turning rate of the newest message.
    """

    def __init__(self) -> None:
        super().__init__("IMU", fresh_s=0.1)
        self.yaw_rad = 0.0
        self.rate_radps = 0.0
        self._acceleration = (0.0, 0.0)
        self._sum = self._slow_sum = 0.0
        self._flat = 0

    def take(self, stamp_s: float, reading: Imu, now_s: float) -> None:
        """Take a message."""
        yaw_rad, rate_radps = reading.yaw_rad, reading.yaw_rate_radps
        acceleration = reading.accel_x_mps2, reading.accel_y_mps2
        if not stamp_s > self.stamp_s or not is_possible(stamp_s, now_s) \
                or not is_imu(reading):
            return
        then_s, then_yaw = self.stamp_s, self.yaw_rad
        same = (rate_radps == self.rate_radps and yaw_rad == then_yaw
                and acceleration == self._acceleration)
        self._flat = self._flat + 1 if same else 0
        self.stamp_s, self.yaw_rad, self.rate_radps = stamp_s, yaw_rad, rate_radps
        self._acceleration = acceleration
        dt_s = stamp_s - then_s
        if dt_s > LONGEST_STEP_S:
            return
        limits = IMU_PARITY
        off = wrap_angle(yaw_rad - then_yaw - rate_radps * dt_s)
        self._sum = self._sum * max(0.0, 1.0 - dt_s / limits.forget_s) + off
        slow_sum = self._slow_sum * (1.0 - dt_s / _SLOW_S) + off
        self._slow_sum = max(-_SLOW_MOST_RAD, min(_SLOW_MOST_RAD, slow_sum))
        if abs(rate_radps) > limits.fastest or not -limits.step < off < limits.step:
            self._sum = 0.0
            self.flaw("heading and turning rate contradict each other", stamp_s)
        elif abs(self._sum) > limits.sum or abs(self._slow_sum) > _SLOW_RAD:
            self.flaw("heading and turning rate drift apart", stamp_s)
        elif self._flat >= _FLAT_READINGS:
            self.flaw("repeats the same reading", stamp_s)
        elif self.distrust:
            self.clean(stamp_s)

    def heading_at(self, stamp_s: float) -> float:
        """Return the heading at a time near the newest message, rad, not wrapped."""
        return self.yaw_rad + self.rate_radps * (stamp_s - self.stamp_s)

WHEEL_RADIUS_M = 0.1175
TURNING_TRACK_M = 0.916
"""Effective track of the skid-steer base: difference of the sides' distances per radian."""

AGREED_AFTER_S = 2.0
"""Time without a contradiction after which measurements agree again."""

_FRESH_S, _GYRO_FRESH_S = 0.35, 0.1
_LONGEST_STEP_S, _LONGEST_ODOMETRY_S = 0.5, 0.2
_SOON_S, _LATE_S, _TURNS_S = 1.0, 60.0, (5.0, 20.0)
# Largest values without a fault: 0.04 and 0.10 m, 0.08 and 0.21 rad, 1e-5 m, 0.04 m/s, 0.03 rad.
_SOON_M, _LATE_M, _SOON_RAD, _LATE_RAD = 0.08, 0.2, 0.3, 0.4
_OWN_M = 0.05
"""Largest difference between the distances by pose and by twist of odometry."""
_PAIR_MPS = 0.1
"""Largest mean lag of a wheel behind its neighbour over a second."""
_CAP = 1.2
_SLIP_SHARE, _GYRO_RAD = 0.05, 0.05


class MotionParity:
    """Compares odometry, encoders and IMU.

    Attributes:
        gyro_agrees: whether the gyro turns like the wheels.
        gyro: the checked IMU.
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
        self.gyro = ImuCheck()

    def confirmed(self, now_s: float) -> bool:
        """Whether encoders are received and confirm complete odometry."""
        return (now_s - self._status_s <= _FRESH_S and self.whole(now_s) and self.sure(now_s))

    def whole(self, now_s: float) -> bool:
        """Whether odometry had no gap lately."""
        return (now_s - self._odometry_s <= _LONGEST_ODOMETRY_S
                and now_s - self._gap_s > AGREED_AFTER_S)

    def sure(self, now_s: float) -> bool:
        """Whether nothing contradicts odometry; a missing device does not."""
        return now_s - self._odometry_flawed_s > AGREED_AFTER_S and self.encoders_agree(now_s)

    def encoders_agree(self, now_s: float) -> bool:
        """Whether the encoders contradict neither odometry nor each other."""
        return now_s - self._encoders_flawed_s > AGREED_AFTER_S

    def imu(self, reading: m.Imu, stamp_s: float, now_s: float) -> None:
        """Take the gyro's heading."""
        self.gyro.take(stamp_s, reading, now_s)

    def odometry(self, reading: m.Odometry, stamp_s: float, now_s: float) -> None:
        """Take odometry and compare its turn with the gyro's."""
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
            self._gyro_was = None
            return
        step_m = math.hypot(x_m - was.x_m, y_m - was.y_m)
        self._own = _capped(
            self._own * (1.0 - dt_s) + step_m - mean_mps * dt_s, _OWN_M)
        if abs(self._own) > _OWN_M:
            self._odometry_flawed_s = stamp_s
        self._compare_turns(yaw_rad - was.yaw_rad, dt_s)

    def _compare_turns(self, wheels_rad: float, dt_s: float) -> None:
        stamp_s = self._odometry_s
        gyro_s, gyro_yaw = self.gyro.stamp_s, self.gyro.yaw_rad
        gyro_was = self._gyro_was
        self._gyro_was = gyro_yaw if stamp_s - gyro_s <= _GYRO_FRESH_S else None
        if gyro_was is None or self._gyro_was is None:
            return
        wheels = math.remainder(wheels_rad, math.tau)
        gyro = math.remainder(gyro_yaw - gyro_was, math.tau)
        astray = bool(self.gyro.distrust)
        for which, over_s in enumerate(_TURNS_S):
            off, turned = (each * (1.0 - dt_s / over_s) for each in self._turned[which])
            turned += max(abs(wheels), abs(gyro))
            most = _GYRO_RAD + _SLIP_SHARE * turned
            off = _capped(off + gyro - wheels, most)
            self._turned[which] = (off, turned)
            astray = astray or (abs(off) > most and self.sure(stamp_s))
        if astray:
            self._gyro_flawed_s = stamp_s
        self.gyro_agrees = stamp_s - self._gyro_flawed_s > AGREED_AFTER_S

    def encoders(self, reading: m.BaseStatus, stamp_s: float, now_s: float) -> None:
        """Take the wheel speeds and compare them with each other and with odometry."""
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
    """Keep a sum near its limit, so that a recovered device is soon trusted again."""
    return max(-_CAP * most, min(_CAP * most, total))
