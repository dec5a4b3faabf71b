"""Filters of the sensors, for the pilots and the estimator. Pure.

`ImuVote` takes the median of three IMUs, `AttitudeFilter` integrates it, `VerticalFilter` finds the
vertical speed from acceleration and air pressure.
"""

from __future__ import annotations

import math

from quadrotor.rotation import Quaternion, by, leaning, normal, product, turn, up, yaw
from quadrotor.topics import Imu
from quadrotor.vehicle import G_MPS2, Vector

FRESH_S = 0.06
"""Older readings of an IMU are ignored."""

_REPEATS = 5
"""An IMU that repeats a reading this often is stuck, since a sound one has noise."""

_FAR = (0.4, 0.4, 0.4, 4.0, 4.0, 4.0)
"""Difference from the median at which an IMU is outvoted, rad/s and m/s²."""

_SMOOTHING = 0.1


class ImuVote:
    """Three IMUs, of which one may be wrong.

    Attributes:
        sound: number of sound IMUs in the last vote.
    """

    def __init__(self) -> None:
        self.sound = 3
        self._newest: list[tuple[tuple[float, ...], float]] = [((0.0,) * 6, -math.inf)] * 3
        self._same = [0, 0, 0]
        self._apart = [[0.0] * 6 for _ in range(3)]

    def take(self, which: int, imu: Imu, stamp_s: float) -> None:
        """Take a reading of an IMU, numbered from 0."""
        values = (imu.gyro_x_radps, imu.gyro_y_radps, imu.gyro_z_radps,
                  imu.accel_x_mps2, imu.accel_y_mps2, imu.accel_z_mps2)
        self._same[which] = self._same[which] + 1 if values == self._newest[which][0] else 0
        self._newest[which] = (values, stamp_s)

    def vote(self, now_s: float) -> tuple[Vector, Vector] | None:
        """Return angular rate, rad/s, and specific force, m/s²; None without a sound IMU."""
        there = [i for i, (values, stamp_s) in enumerate(self._newest)
                 if now_s - stamp_s <= FRESH_S and self._same[i] < _REPEATS
                 and all(map(math.isfinite, values))]
        if not there:
            self.sound = 0
            return None
        middle = [_middle([self._newest[i][0][axis] for i in there]) for axis in range(6)]
        outvoted = 0
        for i in there:
            apart = self._apart[i]
            for axis, value in enumerate(self._newest[i][0]):
                apart[axis] += _SMOOTHING * (abs(value - middle[axis]) - apart[axis])
            if any(a > far for a, far in zip(apart, _FAR, strict=True)):
                outvoted += 1
        self.sound = len(there) - outvoted
        return (middle[0], middle[1], middle[2]), (middle[3], middle[4], middle[5])


def _middle(values: list[float]) -> float:
    values = sorted(values)
    return values[1] if len(values) == 3 else sum(values) / len(values)


class AttitudeFilter:
    """Integrates the angular rate, and corrects it slowly by the accelerometer.

    In flight the accelerometer measures the thrust and not the tilt, so its weight is small.

    Attributes:
        q: attitude, from `base_link` to `map`.
        known: whether it was ever set.
    """

    _UP_HZ, _YAW_HZ = 0.1, 0.5

    def __init__(self) -> None:
        self.q: Quaternion = (1.0, 0.0, 0.0, 0.0)
        self.known = False

    def begin(self, q: Quaternion) -> None:
        """Begin with an attitude."""
        self.q, self.known = normal(q), True

    def level(self, force_mps2: Vector, yaw_rad: float) -> None:
        """Begin with the accelerometer's vertical, as at rest, and a yaw."""
        length = math.sqrt(sum(part * part for part in force_mps2))
        if length > 1.0:
            x, y, z = (part / length for part in force_mps2)
            lean = leaning((-x, -y, z), 0.0)
            heading = (math.cos(yaw_rad / 2), 0.0, 0.0, math.sin(yaw_rad / 2))
            self.begin(product(heading, lean))

    def step(self, rate_radps: Vector, force_mps2: Vector, yaw_rad: float | None,
             step_s: float) -> None:
        """Integrate over `step_s`; the yaw is the magnetometer's, None if that is silent."""
        length = math.sqrt(sum(part * part for part in force_mps2))
        gx, gy, gz = rate_radps
        if abs(length - G_MPS2) < 2.0:
            w, x, y, z = self.q
            ux, uy, uz = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
            fx, fy, fz = (part / length for part in force_mps2)
            gx += self._UP_HZ * (fy * uz - fz * uy)
            gy += self._UP_HZ * (fz * ux - fx * uz)
            gz += self._UP_HZ * (fx * uy - fy * ux)
        q = product(self.q, by((gx * step_s, gy * step_s, gz * step_s)))
        if yaw_rad is not None:
            wrong_rad = math.remainder(yaw_rad - yaw(q), math.tau)
            q = product(by((0.0, 0.0, self._YAW_HZ * step_s * wrong_rad)), q)
        self.q = normal(q)

    def upward(self, force_mps2: Vector) -> float:
        """Return the vertical acceleration without gravity, m/s²."""
        return turn(self.q, force_mps2)[2] - G_MPS2

    @property
    def axis(self) -> Vector:
        """Where the rotors' axis points, in `map`."""
        return up(self.q)


class VerticalFilter:
    """Height and vertical speed from acceleration and air pressure.

    A jump of the barometer sets the height and leaves the speed. If the speed followed it, the
    vehicle would hit the ground when the bias ends.

    Attributes:
        height_m, speed_mps: upwards.
    """

    _BAND_RADPS, _JUMP_M = 0.8, 1.0

    def __init__(self) -> None:
        self.height_m = self.speed_mps = 0.0
        self._known = False
        self._last_m = math.nan

    def step(self, upward_mps2: float, step_s: float) -> None:
        """Integrate an acceleration."""
        self.height_m += self.speed_mps * step_s
        self.speed_mps += upward_mps2 * step_s

    def measured(self, altitude_m: float, step_s: float) -> None:
        """Take a height of the barometer, `step_s` after the one before."""
        if not math.isfinite(altitude_m) or altitude_m == self._last_m:
            return
        self._last_m = altitude_m
        off_m = altitude_m - self.height_m
        if not self._known or abs(off_m) > self._JUMP_M:
            self.height_m, self._known = altitude_m, True
            return
        self.height_m += 1.4 * self._BAND_RADPS * step_s * off_m
        self.speed_mps += self._BAND_RADPS ** 2 * step_s * off_m
