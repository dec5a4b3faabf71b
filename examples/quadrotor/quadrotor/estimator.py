"""The estimator: fuses IMUs, GPS, barometer and magnetometer into position, velocity and attitude.

A complementary filter with fixed gains. The accelerometer leads; the velocity of the GPS corrects
within half a second, its position within five. A position that jumps or drifts pulls the estimate
so slowly that detection modules notice the difference. Repeated readings are ignored: the sensor is
stuck. `FusedState` is pure.
"""

from __future__ import annotations

import math

from quadrotor import topics as t
from quadrotor.control import STEP_S, bounded
from quadrotor.rotation import turn
from quadrotor.sensing import Sensing
from quadrotor.vehicle import G_MPS2, Vector
from rampart import Context, Header, every, on

_GPS_S = 0.1
_SPEED_S, _PLACE_S, _HEIGHT_S = 0.4, 5.0, 8.0
_BARO_HZ, _BARO_HZ2 = 0.56, 0.16
_MOST_OFF_M, _MOST_OFF_MPS = 2.0, 2.0
"""Larger differences between a sensor and the estimate count as this much."""

_LATE_S = 0.3


class FusedState:
    """Position and velocity in `map`.

    Attributes:
        position, velocity: in m and m/s.
        fix_s: simulated time of the last sound fix.
    """

    def __init__(self) -> None:
        self.position = [0.0, 0.0, 0.0]
        self.velocity = [0.0, 0.0, 0.0]
        self.fix_s = -math.inf
        self._last_fix: t.GpsFix | None = None
        self._last_altitude_m = math.nan

    def step(self, accel_mps2: Vector, step_s: float) -> None:
        """Integrate an acceleration in `map`."""
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
        """Take a height of the barometer, `step_s` after the one before."""
        if math.isfinite(altitude_m) and altitude_m != self._last_altitude_m:
            self._last_altitude_m = altitude_m
            off_m = bounded(altitude_m - self.position[2], _MOST_OFF_M)
            self.position[2] += _BARO_HZ * step_s * off_m
            self.velocity[2] += _BARO_HZ2 * step_s * off_m


class Estimator(Sensing):
    """Publishes position, velocity and attitude."""

    outputs = (t.ESTIMATE,)
    wait_s = 0.15

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._state = FusedState()
        self._turn = 0

    @on(t.GPS)
    def gps(self, message: t.GpsFix, header: Header) -> None:
        """Take a fix, unless it is late or a repetition."""
        if header.stamp > self._state.fix_s and self.clock.now() - header.stamp < _LATE_S:
            self._state.fix(message, header.stamp)

    @on(t.BAROMETER)
    def barometer(self, message: t.Barometer, _header: Header) -> None:
        """Take a height."""
        self._state.pressure(message.altitude_m, 1 / t.BAROMETER.rate_hz)

    @on(t.PILOT)
    def pilot(self, message: t.PilotStatus, _header: Header) -> None:
        """After a restart begin with the pilot's attitude."""
        if not self._filter.known and all(map(math.isfinite, message.attitude)):
            self._filter.begin(message.attitude)

    @every(STEP_S)
    def step(self) -> None:
        """Advance by 10 ms; publish every second estimate."""
        sensed, state = self._sense(), self._state
        if sensed is None or state.fix_s == -math.inf:
            return
        x, y, z = turn(self._filter.q, sensed[1])
        state.step((x, y, z - G_MPS2), STEP_S)
        self._turn += 1
        if self._turn % 2 == 0:
            (vx, vy, vz), (px, py, pz) = state.velocity, state.position
            self.publish(t.ESTIMATE, t.Estimate(
                px, py, pz, vx, vy, vz, math.sqrt(vx * vx + vy * vy + vz * vz), self._filter.q,
                self.clock.now() - state.fix_s))
