"""DM13's monitor: does the base move, and brake, as it is told? Pure.

Three questions, each asked only when its answer is sure:

* *Do the two wheels of a side turn alike?* They are told the same speed, always, also in a curve
  and while accelerating; slip does not come between an encoder and its motor. One that lags behind
  its neighbour is stuck or weak. No model of the base is needed.
* *Is the speed over ground what was commanded?* Asked while the command has not changed for a
  while: during a change it is the ramp's business.
* *Does the brake brake?* Asked whenever it is on, by whomever. It is the only time at which this
  can be known: a brake that nobody uses looks like a sound one, and the base takes no velocity
  command against its brake by which one could test it standing.

What was found stays for `hold_s`: a recovery that makes the failure invisible (a weak motor keeps
up at low speed) must not be ended by its own success at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

WHEELS = ("front left", "front right", "rear left", "rear right")
_SIDES = ((0, 2), (1, 3))


@dataclass(frozen=True, slots=True)
class MotionLimits:
    """What a sound base does. Speeds of wheels are at their treads.

    Args:
        wheel_radius_m: of the base.
        pair_mps: by which a wheel may lag behind its neighbour, and ...
        pair_share: ... as a share of the neighbour's speed; the larger counts.
        short_mps, short_share: by which the speed over ground may fall short of the command.
        steady_s: how long a command must not have changed.
        steady_mps, steady_radps: what is no change.
        turning_radps: with a larger turn rate the speed over ground is not judged.
        lasts_s: how long the evidence has to last.
        braking_mps2: deceleration that is certain.
        brake_share: share of it with which a brake still counts as sound.
        brake_lag_s: until the brake bites.
        hold_s: how long a finding stays without new evidence.
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


class ActuatorMonitor:
    """Active while the base does not do as it is told, and for a while after.

    Args:
        limits: what a sound base does.
        known_after_s: when idle may be claimed without anything heard; -inf for at once.
    """

    nodes: tuple[str, ...] = ()

    def __init__(self, limits: MotionLimits | None = None, known_after_s: float = -math.inf
                 ) -> None:
        self.limits = limits or MotionLimits()
        self.active = False
        self.reason = ""
        self.known = known_after_s == -math.inf
        self._known_after_s = known_after_s
        self._command = (0.0, 0.0)
        self._steady_since_s = math.inf
        self._speed_mps = math.nan
        self._speed_s = -math.inf
        self._since_s: dict[str, float] = {}
        self._evidence_s = -math.inf
        self._braked_from: tuple[float, float] | None = None

    @property
    def due_s(self) -> float:
        """When time alone changes the finding."""
        if self.active:
            return self._evidence_s + self.limits.hold_s
        return math.inf if self.known else self._known_after_s

    def expire(self, now_s: float) -> None:
        """Forget old evidence."""
        if not self.known:
            self.known = now_s >= self._known_after_s
        if self.active and now_s >= self._evidence_s + self.limits.hold_s:
            self.active = False
            self.reason = ""

    def commanded(self, linear_mps: float, angular_radps: float, now_s: float) -> None:
        """Take a velocity command for the base."""
        limits, (linear, angular) = self.limits, self._command
        steady = (abs(linear_mps - linear) <= limits.steady_mps
                  and abs(angular_radps - angular) <= limits.steady_radps)
        if not steady or self._steady_since_s == math.inf:
            self._steady_since_s = now_s
            self._command = (linear_mps, angular_radps)

    def moved(self, velocity_x_mps: float, velocity_y_mps: float, now_s: float) -> None:
        """Take a velocity over ground, measured without the wheels (GPS, Doppler)."""
        speed_mps = math.hypot(velocity_x_mps, velocity_y_mps)
        if math.isfinite(speed_mps):
            self._speed_mps, self._speed_s = speed_mps, now_s

    def status(self, wheels_radps: tuple[float, float, float, float], *, braking: bool,
               now_s: float) -> None:
        """Take the state of the base: wheel speeds in the order of `WHEELS`, brake."""
        self.known = True
        if not all(map(math.isfinite, wheels_radps)):
            return
        treads = [speed * self.limits.wheel_radius_m for speed in wheels_radps]
        found = self._brake(treads, now_s) if braking else self._drive(treads, now_s)
        if not braking:
            self._braked_from = None
        for what in list(self._since_s):
            if what not in found:
                del self._since_s[what]
        for what in found:
            since_s = self._since_s.setdefault(what, now_s)
            if now_s - since_s >= self.limits.lasts_s - 1e-9 or what.startswith("the brake"):
                self._evidence_s = now_s
                self.active = True
                self.reason = self.reason or what

    def _drive(self, treads: list[float], now_s: float) -> list[str]:
        limits, found = self.limits, []
        for pair in _SIDES:
            slow, fast = sorted(pair, key=lambda wheel: abs(treads[wheel]))
            lag_mps = abs(treads[fast] - treads[slow])
            if lag_mps > max(limits.pair_mps, limits.pair_share * abs(treads[fast])):
                found.append(f"the {WHEELS[slow]} wheel does not keep up with its neighbour")
        linear_mps, angular_radps = self._command
        steady = now_s - self._steady_since_s >= limits.steady_s
        if steady and now_s - self._speed_s <= 0.3 and abs(angular_radps) <= limits.turning_radps:
            short_mps = abs(linear_mps) - self._speed_mps
            if abs(short_mps) > max(limits.short_mps, limits.short_share * abs(linear_mps)):
                found.append("the speed over ground is not the one commanded")
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
