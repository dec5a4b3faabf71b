"""The control loops: position → velocity → acceleration → attitude → rotors. Pure.

`PositionControl` runs in the flight controller, and in a pilot that flies without setpoints;
`AttitudeControl` runs in the pilots.
"""

from __future__ import annotations

import math

from quadrotor.rotation import Quaternion, inverse, leaning, product, up
from quadrotor.topics import Estimate, Goal
from quadrotor.vehicle import G_MPS2, HOVER_N, INERTIA_KGM2, MASS_KG, Thrusts, Vector, mix, wrench

MOST_ACCEL_MPS2 = 3.0
"""Horizontal; a tilt of 17°."""
CLIMB_MPS = 1.5
_FOLLOW_SHARE = 0.02
"""Share of the other pilot's trim taken over with each message at 50 Hz: a time constant of 1 s."""
_LIGHT_SHARE = 0.85
"""Below this share of the weight the integrals rest, since the vehicle may stand on the ground."""
STEP_S = 0.01
"""Period of the pilots' and the estimator's loops."""


def bounded(value: float, most: float) -> float:
    """Return a value within ±most."""
    return min(max(value, -most), most)


class PositionControl:
    """Position → velocity (P) → acceleration (PI), in `map`."""

    _POSITION_HZ, _SPEED_HZ = 0.9, 2.2
    _REST_HZ2: Vector = (0.5, 0.5, 2.5)
    _MOST_REST_MPS2 = 2.5

    def __init__(self) -> None:
        self._rest = [0.0, 0.0, 0.0]

    def reset(self) -> None:
        """Reset the integrals, which compensate wind and weak rotors."""
        self._rest = [0.0, 0.0, 0.0]

    def step(self, goal: Goal, at: Estimate, step_s: float) -> Vector:
        """Return the acceleration towards a goal, m/s²."""
        east, north = (self._POSITION_HZ * (goal.x_m - at.x_m),
                       self._POSITION_HZ * (goal.y_m - at.y_m))
        shorter = min(1.0, goal.speed_mps / max(math.hypot(east, north), 1e-6))
        upward = min(max(self._POSITION_HZ * (goal.z_m - at.z_m), -goal.descent_mps), CLIMB_MPS)
        return self.towards((east * shorter, north * shorter, upward), at, step_s)

    def towards(self, velocity_mps: Vector, at: Estimate, step_s: float) -> Vector:
        """Return the acceleration towards a velocity in `map`, m/s²."""
        now = at.velocity_x_mps, at.velocity_y_mps, at.velocity_z_mps
        asked = []
        for i, (wanted, have) in enumerate(zip(velocity_mps, now, strict=True)):
            wrong = wanted - have
            self._rest[i] = bounded(
                self._rest[i] + self._REST_HZ2[i] * bounded(wrong, 1.0) * step_s,
                self._MOST_REST_MPS2)
            asked.append(self._SPEED_HZ * wrong + self._rest[i])
        east, north, upward = asked
        shorter = min(1.0, MOST_ACCEL_MPS2 / max(math.hypot(east, north), 1e-6))
        return east * shorter, north * shorter, bounded(upward, 4.0)


class AttitudeControl:
    """Acceleration → attitude (P) → angular rate (PI) → rotors.

    Attributes:
        trim: share of the hover thrust by which the integrals trim one rotor.
    """

    _TILT_HZ, _YAW_HZ = 6.0, 2.0
    _RATE_HZ: Vector = (16.0, 16.0, 5.0)
    _REST_HZ2: Vector = (25.0, 25.0, 2.0)
    _MOST_REST_RADPS2: Vector = (25.0, 25.0, 2.0)

    def __init__(self) -> None:
        self._rest = [0.0, 0.0, 0.0]
        self.trim = 0.0

    def reset(self) -> None:
        """Reset the trim, which is meaningless on the ground."""
        self._rest, self.trim = [0.0, 0.0, 0.0], 0.0

    def follow(self, thrusts_n: Thrusts) -> None:
        """Follow the trim of the other pilot, from the thrusts that it commands.

        On average the vehicle does not turn, so a lasting torque is a trim.
        """
        if all(map(math.isfinite, thrusts_n)):
            for i, torque_nm in enumerate(wrench(thrusts_n)[1]):
                trim = bounded(torque_nm / INERTIA_KGM2[i], self._MOST_REST_RADPS2[i])
                self._rest[i] += _FOLLOW_SHARE * (trim - self._rest[i])

    def step(self, accel_mps2: Vector, yaw_rad: float, q: Quaternion, rate_radps: Vector,
             *, flies: bool = True) -> Thrusts:
        """Return the thrust of each rotor, N.

        Args:
            accel_mps2: demanded acceleration in `map`, without gravity.
            yaw_rad: demanded yaw.
            q: attitude.
            rate_radps: angular rate in `base_link`.
            flies: whether the rotors obey; otherwise the integrals rest.
        """
        force = accel_mps2[0], accel_mps2[1], max(accel_mps2[2] + G_MPS2, 2.0)
        length = math.sqrt(sum(part * part for part in force))
        axis = force[0] / length, force[1] / length, force[2] / length
        wrong = product(inverse(q), leaning(axis, yaw_rad))
        sign = 2.0 if wrong[0] >= 0 else -2.0
        speeds = self._TILT_HZ, self._TILT_HZ, self._YAW_HZ
        torque = []
        for i in range(3):
            asked = bounded(sign * wrong[i + 1] * speeds[i], 4.0 if i < 2 else 1.0)
            short = asked - rate_radps[i]
            if flies and force[2] > _LIGHT_SHARE * G_MPS2:
                self._rest[i] = bounded(self._rest[i] + self._REST_HZ2[i] * short * STEP_S,
                                        self._MOST_REST_RADPS2[i])
            torque.append(INERTIA_KGM2[i] * (self._RATE_HZ[i] * short + self._rest[i]))
        self.trim = max(abs(f - HOVER_N) for f in mix(4 * HOVER_N, (
            INERTIA_KGM2[0] * self._rest[0], INERTIA_KGM2[1] * self._rest[1], 0.0))) / HOVER_N
        along = sum(f * u for f, u in zip(force, up(q), strict=True))
        return mix(MASS_KG * max(along, 0.0), (torque[0], torque[1], torque[2]))
