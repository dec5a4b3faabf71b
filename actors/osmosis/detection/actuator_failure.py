"""DM13: actuator failure: does the base move, and brake, as it is told?

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

from rampart.actors.detection.finding import Finding
from rampart.actors.detection.module import DetectionModule
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.readings import is_base_status, is_fix
from rampart.actors.runtime.actor import Context, Header, on
from rampart.manager.spec.tables import NonNegative

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


class ActuatorMonitor(Finding):
    """Active while the base does not do as it is told, and for a while after.

    Args:
        limits: what a sound base does.
        known_after_s: when idle may be claimed without anything heard; -inf for at once.
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
        """When time alone changes the finding."""
        return self._evidence_s + self.limits.hold_s if self.active else super().due_s

    def expire(self, now_s: float) -> None:
        """Forget old evidence."""
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
        """Take a velocity over ground, measured without the wheels (GPS, Doppler)."""
        self._speed_mps, self._speed_s = math.hypot(velocity_x_mps, velocity_y_mps), now_s

    def status(self, wheels_radps: tuple[float, float, float, float], *, braking: bool,
               now_s: float) -> None:
        """Take the state of the base: wheel speeds in the order of `WHEELS`, brake."""
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


_FIRST_STATUS_S = 0.3
"""A respawned module waits this long for a first status of the base before it says idle."""


class ActuatorFailure(DetectionModule):
    """Active while wheels do not turn, or brakes do not brake, as the base was told."""

    class Parameters(DetectionModule.Parameters, frozen=True):
        """The base, and patience.

        Attributes:
            wheel_radius_m: of the base.
            hold_s: how long a finding stays without new evidence, s.
        """

        wheel_radius_m: NonNegative = MotionLimits().wheel_radius_m
        hold_s: NonNegative = MotionLimits().hold_s

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        limits = MotionLimits(
            wheel_radius_m=self.parameters.wheel_radius_m, hold_s=self.parameters.hold_s,
            braking_mps2=context.run.system.robot.braking_mps2)
        self.monitor = self.judged_by(ActuatorMonitor(limits, self.known_after_s(_FIRST_STATUS_S)))

    @on(topics.BASE_COMMAND)
    def command(self, message: m.BaseCommand, _header: Header) -> None:
        """Hear what the base is told."""
        self.monitor.commanded(message.linear_mps, message.angular_radps, self.clock.now())

    @on(topics.GPS)
    def gps(self, message: m.GpsFix, _header: Header) -> None:
        """Hear how fast it is over ground."""
        if is_fix(message):
            self.monitor.moved(message.velocity_x_mps, message.velocity_y_mps, self.clock.now())

    @on(topics.BASE_STATUS)
    def status(self, message: m.BaseStatus, _header: Header) -> None:
        """Hear how the wheels turn, and judge."""
        if is_base_status(message):
            self.monitor.status(message.wheel_speeds_radps, braking=message.brake_engaged,
                                now_s=self.clock.now())
            self.follow()
