"""DM13: actuator failure: the base does not move or brake as commanded.

Three checks, each only while its result is certain:

* *The two wheels of a side turn at the same speed.* Their commands are equal, also in a curve and
  during acceleration, and slip does not affect an encoder. A wheel that lags behind its neighbour
  is stuck or weak. This needs no model of the base.
* *The speed over ground is the commanded one.* It is checked while the command is constant, since
  the ramp determines the speed during a change.
* *The brake decelerates the base.* It is checked while the brake is engaged by any source. An
  unused brake cannot be checked, since the base executes no command against its brake.

A finding is held for `hold_s`: a recovery that hides the failure (a weak motor keeps up at low
speed) must not be released at once by its own success.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from rampart.actors.detection.finding import Finding
from rampart.actors.detection.module import DetectionModule
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.readings import is_base_status, is_fix
from rampart.actors.runtime.actor import Context, Header, on

WHEELS = ("front left", "front right", "rear left", "rear right")
_SIDES = ((0, 2), (1, 3))


@dataclass(frozen=True, slots=True)
class MotionLimits:
    """Behaviour of a healthy base. Wheel speeds are at the treads.

    Args:
        wheel_radius_m: radius of the wheels.
        pair_mps: largest lag of a wheel behind its neighbour, or ...
        pair_share: ... as a share of the neighbour's speed; the larger one applies.
        short_mps, short_share: the same for the speed over ground behind the command.
        steady_s: time after which a command is constant.
        steady_mps, steady_radps: largest change of a constant command.
        turning_radps: largest turn rate for the check of the speed over ground.
        lasts_s: time that the evidence has to last.
        braking_mps2: guaranteed deceleration.
        brake_share: least share of it for a healthy brake.
        brake_lag_s: time until the brake acts.
        hold_s: time that a finding is held without new evidence.
    """

    wheel_radius_m: float = 0.1175
    pair_mps: float = 0.1
    pair_share: float = 0.2
    short_mps: float = 0.2
    short_share: float = 0.25
    steady_s: float = 1.5
    steady_mps: float = 0.1
    steady_radps: float = 0.15
    turning_radps: float = 0.3
    lasts_s: float = 0.5
    braking_mps2: float = 2.0
    brake_share: float = 0.5
    brake_lag_s: float = 0.2
    hold_s: float = 30.0


class ActuatorMonitor(Finding):
    """Active while the base does not follow its commands, and for `hold_s` after.

    Args:
        limits: behaviour of a healthy base.
        known_after_s: time from which it may be idle without input; -inf for at once.
    """

    def __init__(self, limits: MotionLimits | None = None, known_after_s: float = -math.inf
                 ) -> None:
        super().__init__(known_after_s)
        self.limits = limits or MotionLimits()
        self._command = (0.0, 0.0)
        self._steady_since_s = math.inf
        self._speed_mps = math.nan
        self._speed_s = -math.inf
        self._since_s: dict[str, float] = {}
        self._evidence_s = -math.inf
        self._braked_from: tuple[float, float] | None = None

    @property
    def due_s(self) -> float:
        """Time of the next change without input."""
        return self._evidence_s + self.limits.hold_s if self.active else super().due_s

    def expire(self, now_s: float) -> None:
        """Drop old evidence."""
        super().expire(now_s)
        if now_s >= self._evidence_s + self.limits.hold_s:
            self.clear()

    def commanded(self, linear_mps: float, angular_radps: float, now_s: float) -> None:
        """Take a velocity command for the base."""
        limits, (linear, angular) = self.limits, self._command
        steady = (abs(linear_mps - linear) <= limits.steady_mps
                  and abs(angular_radps - angular) <= limits.steady_radps)
        if not steady or self._steady_since_s == math.inf:
            self._steady_since_s = now_s
            self._command = (linear_mps, angular_radps)

    def moved(self, velocity_x_mps: float, velocity_y_mps: float, now_s: float) -> None:
        """Take a velocity over ground that is independent of the wheels (GPS, Doppler)."""
        self._speed_mps, self._speed_s = math.hypot(velocity_x_mps, velocity_y_mps), now_s

    def status(self, wheels_radps: tuple[float, float, float, float], *, braking: bool,
               now_s: float) -> None:
        """Take wheel speeds, in the order of `WHEELS`, and the state of the brake."""
        self.known = True
        treads = [speed * self.limits.wheel_radius_m for speed in wheels_radps]
        found = self._brake(treads, now_s) if braking else self._drive(treads, now_s)
        if not braking:
            self._braked_from = None
        self._since_s = {what: self._since_s.get(what, now_s) for what in found}
        for what, since_s in self._since_s.items():
            if now_s - since_s >= self.limits.lasts_s - 1e-9 or what.startswith("the brake"):
                self._evidence_s = now_s
                self.reason = self.reason or what

    def _drive(self, treads: list[float], now_s: float) -> list[str]:
        limits, found = self.limits, []
        for pair in _SIDES:
            slow, fast = sorted(pair, key=lambda wheel: abs(treads[wheel]))
            lag_mps = abs(treads[fast] - treads[slow])
            if lag_mps > max(limits.pair_mps, limits.pair_share * abs(treads[fast])):
                found.append(f"the {WHEELS[slow]} wheel lags behind its neighbour")
        linear_mps, angular_radps = self._command
        steady = now_s - self._steady_since_s >= limits.steady_s
        if steady and now_s - self._speed_s <= 0.3 and abs(angular_radps) <= limits.turning_radps:
            short_mps = abs(linear_mps) - self._speed_mps
            if abs(short_mps) > max(limits.short_mps, limits.short_share * abs(linear_mps)):
                found.append("the speed over ground differs from the command")
        return found

    def _brake(self, treads: list[float], now_s: float) -> list[str]:
        limits = self.limits
        speed_mps = max(map(abs, treads))
        if self._braked_from is None:
            self._braked_from = (now_s, speed_mps)
        then_s, then_mps = self._braked_from
        time_s = now_s - then_s - limits.brake_lag_s
        due_mps = then_mps - limits.brake_share * limits.braking_mps2 * max(time_s, 0.0)
        if time_s > 0 and speed_mps > max(due_mps, 0.0) + limits.pair_mps:
            return ["the brake does not brake"]
        return []


_FIRST_STATUS_S = 0.3
"""Time that a restarted module waits for a status of the base before it reports idle."""


class ActuatorFailure(DetectionModule):
    """Active while wheels or brake do not follow the commands."""

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        limits = MotionLimits(braking_mps2=context.run.system.robot.braking_mps2)
        self.monitor = self.judged_by(ActuatorMonitor(limits, self.known_after_s(_FIRST_STATUS_S)))

    @on(topics.BASE_COMMAND)
    def command(self, message: m.BaseCommand, _header: Header) -> None:
        """Take a command for the base."""
        self.monitor.commanded(message.linear_mps, message.angular_radps, self.clock.now())

    @on(topics.GPS)
    def gps(self, message: m.GpsFix, _header: Header) -> None:
        """Take the speed over ground."""
        if is_fix(message):
            self.monitor.moved(message.velocity_x_mps, message.velocity_y_mps, self.clock.now())

    @on(topics.BASE_STATUS)
    def status(self, message: m.BaseStatus, _header: Header) -> None:
        """Take the state of the base and check it."""
        if is_base_status(message):
            self.monitor.status(message.wheel_speeds_radps, braking=message.brake_engaged,
                                now_s=self.clock.now())
            self.follow()
