"""Faults of the Summit XL's actuators: the remaining capability of motors and brake. Pure.

**Stuck wheel**: a seized gearbox or bearing. The wheel is blocked like a braked one, and its motor
gives no torque (its drive trips); the tyre slides.

**Weak wheel**: a share k of the motor's voltage and current remains (a broken phase, a derated
power stage, a bad contact). Stall torque and no-load speed are proportional to them, so the
envelope shrinks: torque up to k times the servo's limit, speed up to k times the rated speed.
Inside the envelope the closed loop reaches its target, so a weak motor shows only in acceleration,
in turns (the tyres' lateral slip costs torque) and at speed. Beyond its no-load speed it is driven
by the ground and brakes within its torque. At k = 0 the wheel rolls freely. A scaled target or
servo gain would be a wheel that is slow even without load, which a speed loop prevents.

**Brake failure**: the motors are the base's only brake. A brake order makes them absorb energy
along a ramp, regardless of the velocity command, and then block. With a share s the ramp has s
times the deceleration and s times the torque of the healthy ramp, only against the wheel's motion
(an absorber does not drive), and the wheels never block. At s = 0 the base coasts, slowed by the
friction of bearings and gears. A stop by velocity command (the controlled stop) does not use the
brake and still works. Friction helps a weak brake: above s = 0.9 the stopping distance is that of a
healthy one, within one or two centimetres.

A fault counts the ticks in which it had an effect. Of several faults on one actuator the worst acts
and counts: a stuck wheel hides its weak motor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from rampart.actors.bus.limits import Remembered
from rampart.actors.osmosis.messages import ActuatorFault, ActuatorFaultKind
from rampart.sim.osmosis.robot import WHEEL_NAMES, WHEEL_RADIUS_M, DriveLimits, WheelSpeeds
from rampart.sim.osmosis.scene import WorldError

STANDING_RADPS = 0.05
"""A slower wheel, 6 mm/s at its tread, stands: a brake has no effect."""



_REMEMBERED = 256
"""Number of ended faults whose count is reported again on request."""


@dataclass(frozen=True, slots=True)
class Motor:
    """A healthy wheel motor with its speed loop.

    Args:
        torque_nm: the loop's torque limit.
        servo_gain: torque per speed error, N m s/rad.
        rated_radps: rated speed, at the base's top speed.
        brake_torque_nm: torque that brakes the base along the healthy ramp.
    """

    torque_nm: float
    servo_gain: float
    rated_radps: float
    brake_torque_nm: float


def motor_of(model: Any, limits: DriveLimits) -> Motor:
    """Return the wheel motor of a compiled MuJoCo model of the Summit XL; all four are equal."""
    # The free joint has the first six degrees of freedom, the wheels come next.
    inertia = float(model.dof_armature[6] + model.body("wheel_front_left").inertia[1])
    moved_kg = float(model.body("base").subtreemass[0]) + 4 * inertia / WHEEL_RADIUS_M**2
    return Motor(torque_nm=float(model.actuator_forcerange[0, 1]),
                 servo_gain=float(model.actuator_gainprm[0, 0]),
                 rated_radps=limits.linear_mps / WHEEL_RADIUS_M,
                 brake_torque_nm=moved_kg * limits.brake_mps2 * WHEEL_RADIUS_M / 4)


@dataclass(frozen=True, slots=True)
class Actuation:
    """Input of the wheels in one tick, in the order of `WHEEL_NAMES`.

    Attributes:
        targets_radps: target speeds of the servos.
        torques_nm: least and greatest torque of the servos.
        blocked: which wheels are seized.
    """

    targets_radps: tuple[float, ...]
    torques_nm: tuple[tuple[float, float], ...]
    blocked: tuple[bool, ...]


@dataclass(frozen=True, slots=True)
class FaultNews:
    """A fault has started, has its first effect, or has ended."""

    injection: str
    affected_ticks: int
    finished: bool


@dataclass(slots=True)
class _InForce:
    order: ActuatorFault
    until_s: float
    affected_ticks: int = 0


@dataclass(frozen=True, slots=True)
class _Loss:
    """Remaining share of an actuator, and the faults that cause it."""

    share: float
    causes: tuple[_InForce, ...]


class ActuatorFaults:
    """The actuator faults in force. Time is an argument.

    Args:
        motor: healthy motor of each wheel.
    """

    def __init__(self, motor: Motor) -> None:
        self._motor = motor
        self._in_force: dict[str, _InForce] = {}
        self._over: Remembered[str, int] = Remembered(_REMEMBERED)
        self._news: list[FaultNews] = []
        self._weigh()

    def __bool__(self) -> bool:
        """Whether any fault is in force."""
        return bool(self._in_force)

    def order(self, order: ActuatorFault, now_s: float) -> None:
        """Start or change a fault, or end it by a duration of 0.

        A repeated id replaces the fault and keeps its count. Ending an ended fault repeats the news
        of its end.

        Raises:
            WorldError: a value is invalid, the fault to end never started, or there are too many.
        """
        injection = order.injection
        if not order.duration_s >= 0:
            raise WorldError(f"duration_s = {order.duration_s}: expected seconds, 0 to end the "
                             "fault, inf for the rest of the run")
        if order.duration_s == 0:
            if injection in self._in_force:
                self._end(injection)
            elif injection in self._over:
                self._news.append(FaultNews(injection, self._over[injection], finished=True))
            else:
                raise WorldError(f"injection = {injection!r}: unknown fault, nothing to end")
            return
        if not 0 <= order.strength <= 1:  # NaN is refused here as well
            raise WorldError(f"strength = {order.strength}: expected a share from 0 to 1")
        if order.kind != ActuatorFaultKind.BRAKE_FAILURE and order.wheel not in WHEEL_NAMES:
            raise WorldError(f"wheel = {order.wheel!r}: expected one of {', '.join(WHEEL_NAMES)}")
        before = self._in_force.get(injection)
        affected_ticks = before.affected_ticks if before else 0
        self._in_force[injection] = _InForce(order, now_s + order.duration_s, affected_ticks)
        self._weigh()
        self._news.append(FaultNews(injection, affected_ticks, finished=False))

    def expire(self, now_s: float) -> None:
        """End the faults whose time is up."""
        for injection in [i for i, f in self._in_force.items() if now_s >= f.until_s - 1e-9]:
            self._end(injection)

    def take_news(self) -> list[FaultNews]:
        """Return the news since the last call, oldest first."""
        news, self._news = self._news, []
        return news

    @property
    def brake_share(self) -> float:
        """Remaining share of the brake's deceleration."""
        return self._brake.share

    def actuate(self, targets_radps: WheelSpeeds, speeds_radps: WheelSpeeds, braking: bool
                ) -> Actuation:
        """Apply the faults to the drive's output of one tick, and count their effects.

        Args:
            targets_radps: wheel speeds by the drive; along the weak ramp if a failed brake is
                ordered.
            speeds_radps: wheel speeds now.
            braking: whether the brake is ordered.
        """
        brake_fails = braking and self._brake.share < 1
        if brake_fails and max(map(abs, speeds_radps)) > STANDING_RADPS:
            self._count(self._brake)
        targets = list(targets_radps)
        torques = [self._torque_range(speed, brake_fails) for speed in speeds_radps]
        for wheel, (asked, speed) in enumerate(zip(targets_radps, speeds_radps, strict=True)):
            if self._blocked[wheel]:
                targets[wheel] = 0.0
                if abs(asked) > STANDING_RADPS:
                    self._count(self._stuck[wheel])
            elif self._weak[wheel].share < 1:
                weak, sound = self._weak[wheel], torques[wheel]
                # While it brakes, a motor has no speed loop: only its torque counts.
                top_radps = math.inf if brake_fails else weak.share * self._motor.rated_radps
                limit_nm = weak.share * self._motor.torque_nm
                targets[wheel] = max(-top_radps, min(top_radps, asked))
                torques[wheel] = max(sound[0], -limit_nm), min(sound[1], limit_nm)
                wanted_nm = self._motor.servo_gain * (asked - speed)
                lacks_torque = abs(max(sound[0], min(sound[1], wanted_nm))) > limit_nm
                turning = max(abs(asked), abs(speed)) > STANDING_RADPS
                if turning and (lacks_torque or targets[wheel] != asked):
                    self._count(weak)
        return Actuation(tuple(targets), tuple(torques), self._blocked)

    def _torque_range(self, speed_radps: float, brake_fails: bool) -> tuple[float, float]:
        """Return the torque range of a motor that is not weak, at a wheel speed."""
        if not brake_fails:
            return -self._motor.torque_nm, self._motor.torque_nm
        absorbed_nm = self._brake.share * self._motor.brake_torque_nm
        return (-absorbed_nm, 0.0) if speed_radps > 0 else (0.0, absorbed_nm)

    def _weigh(self) -> None:
        """Update the remaining share of each actuator, once per change."""
        self._brake = self._loss(ActuatorFaultKind.BRAKE_FAILURE)
        self._stuck = [self._loss(ActuatorFaultKind.STUCK_WHEEL, name) for name in WHEEL_NAMES]
        self._weak = [self._loss(ActuatorFaultKind.WEAK_WHEEL, name) for name in WHEEL_NAMES]
        self._blocked = tuple(bool(loss.causes) for loss in self._stuck)

    def _loss(self, kind: ActuatorFaultKind, wheel: str | None = None) -> _Loss:
        faults = [f for f in self._in_force.values()
                  if f.order.kind == kind and wheel in (None, f.order.wheel)]
        share = min((fault.order.strength for fault in faults), default=1.0)
        if kind != ActuatorFaultKind.STUCK_WHEEL:  # whose strength means nothing
            faults = [fault for fault in faults if fault.order.strength == share]
        return _Loss(share, tuple(faults))

    def _count(self, loss: _Loss) -> None:
        for fault in loss.causes:
            fault.affected_ticks += 1
            if fault.affected_ticks == 1:
                self._news.append(FaultNews(fault.order.injection, 1, finished=False))

    def _end(self, injection: str) -> None:
        affected_ticks = self._in_force.pop(injection).affected_ticks
        self._weigh()
        self._over[injection] = affected_ticks
        self._news.append(FaultNews(injection, affected_ticks, finished=True))
