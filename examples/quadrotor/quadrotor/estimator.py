"""The estimator: fuses IMUs, GPS, barometer and magnetometer into position, velocity and attitude.

A complementary filter with fixed gains. The accelerometer leads; the velocity of the GPS corrects
within half a second, its position within five. So a position that jumps or drifts away pulls the
estimate slowly enough to be noticed: it disagrees with the estimate, and detection modules compare
the two. What a sensor repeats to the last digit is not taken twice: it is stuck.
`FusedState` is pure.
"""

from __future__ import annotations

import math

from quadrotor import topics as t
from quadrotor.attitude import AttitudeFilter, ImuVote
from quadrotor.control import bounded
from quadrotor.rotation import turn
from quadrotor.vehicle import G_MPS2, Vector
from rampart import Actor, Context, Header, every, on

_STEP_S = 0.01
_GPS_S = 0.1
_SPEED_S, _PLACE_S, _HEIGHT_S = 0.4, 5.0, 8.0
_BARO_HZ, _BARO_HZ2 = 0.56, 0.16
_MOST_OFF_M, _MOST_OFF_MPS = 2.0, 2.0
"""What a sensor says is taken to be no further off than this."""

_WAIT_S = 0.15
_LATE_S = 0.3


class FusedState:
    """Position and velocity in `map`.

    Attributes:
        position, velocity: m and m/s.
        fix_s: when the last sound fix of the GPS was taken.
    """

    def __init__(self) -> None:
        self.position = [0.0, 0.0, 0.0]
        self.velocity = [0.0, 0.0, 0.0]
        self.fix_s = -math.inf
        self._last_fix: t.GpsFix | None = None
        self._last_altitude_m = math.nan

    def step(self, accel_mps2: Vector, step_s: float) -> None:
        """Go on by a time, with the acceleration in `map`."""
        for i in range(3):
            self.position[i] += self.velocity[i] * step_s
            self.velocity[i] += accel_mps2[i] * step_s

    def fix(self, gps: t.GpsFix, stamp_s: float) -> None:
        """Take a fix of the GPS."""
        place = gps.x_m, gps.y_m, gps.z_m
        speed = gps.velocity_x_mps, gps.velocity_y_mps, gps.velocity_z_mps
        if gps == self._last_fix or not all(map(math.isfinite, (*place, *speed))):
            return
        self._last_fix = gps
        if self.fix_s == -math.inf:
            self.position, self.velocity = list(place), list(speed)
        slow = (_PLACE_S, _PLACE_S, _HEIGHT_S)
        for i in range(3):
            self.position[i] += _GPS_S / slow[i] * bounded(place[i] - self.position[i], _MOST_OFF_M)
            self.velocity[i] += _GPS_S / _SPEED_S * bounded(
                speed[i] - self.velocity[i], _MOST_OFF_MPS)
        self.fix_s = stamp_s

    def pressure(self, altitude_m: float, step_s: float) -> None:
        """Take a height of the barometer, each so many seconds."""
        if math.isfinite(altitude_m) and altitude_m != self._last_altitude_m:
            self._last_altitude_m = altitude_m
            off_m = bounded(altitude_m - self.position[2], _MOST_OFF_M)
            self.position[2] += _BARO_HZ * step_s * off_m
            self.velocity[2] += _BARO_HZ2 * step_s * off_m


class Estimator(Actor):
    """Hears the sensors and says where the vehicle is."""

    outputs = (t.ESTIMATE,)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._imus = ImuVote()
        self._attitude = AttitudeFilter()
        self._state = FusedState()
        self._yaw_rad: float | None = None
        self._born_s = self.clock.now()
        self._turn = 0

    @on(t.IMU_1)
    def imu_1(self, message: t.Imu, header: Header) -> None:
        """Take a reading."""
        self._imus.take(0, message, header.stamp)

    @on(t.IMU_2)
    def imu_2(self, message: t.Imu, header: Header) -> None:
        """Take a reading."""
        self._imus.take(1, message, header.stamp)

    @on(t.IMU_3)
    def imu_3(self, message: t.Imu, header: Header) -> None:
        """Take a reading."""
        self._imus.take(2, message, header.stamp)

    @on(t.GPS)
    def gps(self, message: t.GpsFix, header: Header) -> None:
        """Take a fix, unless it is late, or was taken already."""
        if header.stamp > self._state.fix_s and self.clock.now() - header.stamp < _LATE_S:
            self._state.fix(message, header.stamp)

    @on(t.BAROMETER)
    def barometer(self, message: t.Barometer, _header: Header) -> None:
        """Take a height."""
        self._state.pressure(message.altitude_m, 1 / t.BAROMETER.rate_hz)

    @on(t.HEADING)
    def heading(self, message: t.Heading, _header: Header) -> None:
        """Take a yaw."""
        if math.isfinite(message.yaw_rad):
            self._yaw_rad = message.yaw_rad

    @on(t.PILOT)
    def pilot(self, message: t.PilotStatus, _header: Header) -> None:
        """Begin with the attitude that the pilot knows, when joining in flight."""
        if not self._attitude.known and all(map(math.isfinite, message.attitude)):
            self._attitude.begin(message.attitude)

    @every(_STEP_S)
    def step(self) -> None:
        """Go on by 10 ms; say every second time what came of it."""
        now_s, state = self.clock.now(), self._state
        voted = self._imus.vote(now_s)
        if voted is None:
            return
        rate, force = voted
        if not self._attitude.known:
            if now_s - self._born_s > _WAIT_S and self._yaw_rad is not None:
                self._attitude.level(force, self._yaw_rad)
            return
        self._attitude.step(rate, force, self._yaw_rad, _STEP_S)
        if state.fix_s == -math.inf:
            return
        x, y, z = turn(self._attitude.q, force)
        state.step((x, y, z - G_MPS2), _STEP_S)
        self._turn += 1
        if self._turn % 2 == 0:
            (vx, vy, vz), (px, py, pz) = state.velocity, state.position
            self.publish(t.ESTIMATE, t.Estimate(
                px, py, pz, vx, vy, vz, math.sqrt(vx * vx + vy * vy + vz * vz), self._attitude.q,
                now_s - state.fix_s))
