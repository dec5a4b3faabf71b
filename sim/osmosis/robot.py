"""The Summit XL's base: dimensions, skid-steer kinematics and its drive electronics.

Skid steering: in a turn all four tyres slip sideways. With equal wheel loads the lateral moment
a * omega * a of the tyres (a: half wheelbase, b: half track) is balanced when the wheels of a side
run at omega * (b + a^2 / b), for linear as well as for Coulomb friction. So the base has an
effective track `SLIP_FACTOR` = 1 + (a / b)^2 times the real one, independent of speed (the same
model as in Mandow et al., "Experimental kinematics for wheeled skid-steer mobile robots", 2007).

The drive is pure: `Drive.update(now, dt)` returns wheel speeds; MuJoCo turns them into torques.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

LENGTH_M = 0.72
WIDTH_M = 0.614
WHEEL_RADIUS_M = 0.1175
WHEEL_X_M = 0.229
WHEEL_Y_M = 0.235
CIRCUMRADIUS_M = math.hypot(LENGTH_M, WIDTH_M) / 2
SLIP_FACTOR = 1.0 + (WHEEL_X_M / WHEEL_Y_M) ** 2
"""Ratio of effective to real track."""

WHEEL_NAMES = ("front left", "front right", "rear left", "rear right")
"""Order of the wheels in all tuples of four."""

WheelSpeeds = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class DriveLimits:
    """Limits of the base's electronics (datasheet: 3 m/s).

    Args:
        linear_mps: speed to which a command is clipped; well above the controller's limit, so that
            a wrong command is dangerous.
        angular_radps: the same for the turn rate.
        acceleration_mps2: acceleration by command.
        deceleration_mps2: deceleration by command: the controlled stop.
        brake_mps2: deceleration by the brake, within the grip of the tyres; then the wheels lock.
        angular_acceleration_radps2: change of the turn rate by command.
        brake_radps2: deceleration of the turn rate by the brake.
    """

    linear_mps: float = 3.0
    angular_radps: float = 3.0
    acceleration_mps2: float = 1.5
    deceleration_mps2: float = 2.5
    brake_mps2: float = 5.0
    angular_acceleration_radps2: float = 4.0
    brake_radps2: float = 12.0


def wheel_speeds(linear_mps: float, angular_radps: float) -> WheelSpeeds:
    """Return wheel speeds, rad/s, for a twist: front left, front right, rear left, rear right."""
    side_mps = angular_radps * WHEEL_Y_M * SLIP_FACTOR
    left = (linear_mps - side_mps) / WHEEL_RADIUS_M
    right = (linear_mps + side_mps) / WHEEL_RADIUS_M
    return (left, right, left, right)


def twist_from_wheels(speeds: WheelSpeeds) -> tuple[float, float]:
    """Return the twist (m/s, rad/s) of wheel speeds by the kinematic model."""
    left = (speeds[0] + speeds[2]) / 2 * WHEEL_RADIUS_M
    right = (speeds[1] + speeds[3]) / 2 * WHEEL_RADIUS_M
    return (left + right) / 2, (right - left) / (2 * WHEEL_Y_M * SLIP_FACTOR)


class Drive:
    """Command, limits, ramps, dead man and brake.

    Args:
        limits: speeds and ramps.
        dead_man_timeout_s: age of the last valid command at which it brakes; None: no dead man, so
            that the last command stays (the paper's unprotected baseline).

    Attributes:
        brake_ordered: whether the brake is ordered.
        braking: whether the brake was on in the last update, ordered or by the dead man.
        brake_share: remaining share of the brake's deceleration; below 1 it does not lock.
    """

    def __init__(self, limits: DriveLimits, dead_man_timeout_s: float | None) -> None:
        self.limits = limits
        self.dead_man_timeout_s = dead_man_timeout_s
        self.brake_ordered = False
        self.brake_share = 1.0
        self._wanted = (0.0, 0.0)
        self._wanted_at_s = -math.inf
        self._linear = 0.0
        self._angular = 0.0
        self.braking = False

    def command(self, linear_mps: float, angular_radps: float, now_s: float) -> bool:
        """Take a velocity command; one that is not finite is refused.

        Returns:
            Whether it was accepted.
        """
        if not (math.isfinite(linear_mps) and math.isfinite(angular_radps)):
            return False
        limits = self.limits
        self._wanted = (max(-limits.linear_mps, min(limits.linear_mps, linear_mps)),
                        max(-limits.angular_radps, min(limits.angular_radps, angular_radps)))
        self._wanted_at_s = now_s
        return True

    def command_age_s(self, now_s: float) -> float:
        """Age of the last valid command; infinite before the first."""
        return now_s - self._wanted_at_s

    def dead_man_tripped(self, now_s: float) -> bool:
        """Whether the dead man brakes, because commands are missing."""
        timeout_s = self.dead_man_timeout_s
        return timeout_s is not None and self.command_age_s(now_s) > timeout_s + 1e-9

    def give_way(self, linear_mps: float, angular_radps: float) -> None:
        """Limit the ramps to the measured speed, if friction is stronger than the brake.

        So the drive continues from the base's speed when the brake is released.
        """
        self._linear = _between_zero_and(self._linear, linear_mps)
        self._angular = _between_zero_and(self._angular, angular_radps)

    @property
    def locked(self) -> bool:
        """Whether the wheels are blocked: braked, with the ramp at zero."""
        stopped = self._linear == 0.0 and self._angular == 0.0
        return self.braking and stopped and self.brake_share == 1.0

    def update(self, now_s: float, dt_s: float) -> WheelSpeeds:
        """Advance the ramps by `dt_s`; return the target wheel speeds, rad/s."""
        limits = self.limits
        self.braking = self.brake_ordered or self.dead_man_tripped(now_s)
        if self.braking:
            brake_s = self.brake_share * dt_s
            self._linear = _towards(self._linear, 0.0, limits.brake_mps2 * brake_s)
            self._angular = _towards(self._angular, 0.0, limits.brake_radps2 * brake_s)
        else:
            linear, angular = self._wanted
            slowing = self._linear * linear <= 0 or abs(linear) < abs(self._linear)
            rate = limits.deceleration_mps2 if slowing and self._linear else \
                limits.acceleration_mps2
            self._linear = _towards(self._linear, linear, rate * dt_s)
            self._angular = _towards(
                self._angular, angular, limits.angular_acceleration_radps2 * dt_s)
        return wheel_speeds(self._linear, self._angular)


def _between_zero_and(value: float, bound: float) -> float:
    return max(0.0, min(value, bound)) if value > 0 else min(0.0, max(value, bound))


def _towards(value: float, goal: float, step: float) -> float:
    return min(goal, value + step) if value < goal else max(goal, value - step)
