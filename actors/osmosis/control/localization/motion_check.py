"""Whether odometry and IMU can be believed, each by what it says twice.

Both devices report an integral and its rate: odometry a pose and a twist, the IMU a heading and a
turning rate. The two come from the same wheels and the same gyro, so what they say about the way
since the last message must be the same, up to rounding: a parity check with no model of the robot
in it (analytical redundancy; Isermann, "Fault-Diagnosis Systems", 2006, chapter 10). What passes
as one step may add up over many, so the difference is also summed up, and forgotten slowly.

Besides, a MEMS device never repeats itself to the last bit; one that does is stuck, though its
stamps be fresh. Wheels that stand do repeat themselves, so odometry has no such check.

A device that has failed is believed again when it has been without a flaw for a while.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import msgspec

from rampart.actors.ftm.plausible import is_possible
from rampart.actors.osmosis.control.polyline import wrap_angle
from rampart.actors.osmosis.messages import Imu, Odometry
from rampart.actors.osmosis.readings import is_imu, is_odometry

BACK_AFTER_S = 1.0
"""How long a device must have been without a flaw to be believed again."""

LONGEST_STEP_S = 0.2
"""After a longer gap a message says nothing about the way meanwhile, right or wrong."""

_FLAT_READINGS = 3
"""The same reading so many times in a row is a stuck device."""


class ParityLimits(msgspec.Struct, frozen=True):
    """How much integral and rate may differ.

    Args:
        step: in one step, m or rad.
        sum: of all, with forgetting, m or rad.
        forget_s: time constant of the forgetting. A rate error r adds up to r * forget_s.
        fastest: rate beyond which a step is impossible, m/s or rad/s.
    """

    step: float
    sum: float
    forget_s: float
    fastest: float


ODOMETRY_PARITY = ParityLimits(step=0.02, sum=0.05, forget_s=1.0, fastest=3.6)
"""Measured without a fault: 1e-6 m a step, 0.6 mm where a message was lost at 1.5 m/s2. A tenth of
a metre per second too much reaches the sum's limit in 0.7 s. The drive can do 3 m/s."""

IMU_PARITY = ParityLimits(step=0.02, sum=0.02, forget_s=2.0, fastest=3.6)
"""Measured without a fault: below 1e-15 rad a step, 0.4 mrad where a message was lost at 4 rad/s2.
Two hundredths of a radian per second reach the sum's limit in 1.4 s."""

_SLOW_S, _SLOW_RAD, _SLOW_MOST_RAD = 60.0, 0.03, 0.035
"""The same over a minute, for a heading that drifts by milliradians a second. The sum goes no
further than its most, so that a device that has recovered is believed again soon."""


@dataclass(slots=True)
class Source:
    """What is known of any source.

    Attributes:
        name: for people.
        fresh_s: greatest age of a reading that counts as present.
        distrust: why it is not believed; "" if it is.
        stamp_s: of the newest reading.
    """

    name: str
    fresh_s: float
    distrust: str = field(default="", init=False)
    stamp_s: float = field(default=-math.inf, init=False)
    _clean_since_s: float = field(default=-math.inf, init=False)

    def flaw(self, reason: str, stamp_s: float) -> None:
        """Note a flaw: it is not believed from now on; the first reason stays."""
        self.distrust = self.distrust or reason
        self._clean_since_s = stamp_s

    def clean(self, stamp_s: float) -> None:
        """Note a message without a flaw."""
        if self.distrust and stamp_s - self._clean_since_s >= BACK_AFTER_S:
            self.distrust = ""

    def fresh(self, now_s: float) -> bool:
        """Whether there is a present reading."""
        return now_s - self.stamp_s <= self.fresh_s

    def usable(self, now_s: float) -> bool:
        """Whether there is one, and it is believed."""
        return not self.distrust and now_s - self.stamp_s <= self.fresh_s

    def why_not(self, now_s: float) -> str:
        """Return why it is not in use, or ""."""
        if self.distrust or self.usable(now_s):
            return self.distrust
        return "never heard" if self.stamp_s == -math.inf else "silent or late"


class OdometryCheck(Source):
    """Takes odometry messages and gives the way made since the last one.

    Attributes:
        speed_mps: of the newest message.
    """

    def __init__(self) -> None:
        super().__init__("odometry", fresh_s=0.15)
        self.speed_mps = 0.0
        self._pose = (0.0, 0.0, 0.0)
        self._sum = (0.0, 0.0)

    def take(self, stamp_s: float, reading: Odometry) -> tuple[float, float, float] | None:
        """Take a message; return (duration s, way forward m, turn rad) since the last one.

        Returns:
            None for the first message, one after a gap, an old one, one that is no number, and
            one with a flaw; `distrust` may deny more.
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
    """Takes IMU messages and gives the heading at any time near the newest one.

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
