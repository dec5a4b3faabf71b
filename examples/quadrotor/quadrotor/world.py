"""The world: the simulated vehicle as an actor. On a real vehicle, drivers take its place.

Every 10 ms a timer steps the physics to the clock's time, and publishes the sensors that are due.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any

import msgspec

from quadrotor import topics as t
from quadrotor.physics import Physics
from quadrotor.rotors import SpeedControllers
from rampart import (
    INJECTION_REPORT,
    Actor,
    Header,
    InjectionReport,
    NonNegative,
    Positive,
    Topic,
    every,
    on,
)
from rampart.sim.runs.physics import report_instability

_TICK_S = 0.01
_MOST_BEHIND_S = 0.5
"""After a longer stop of this process, the time of the stop is skipped."""


class World(Actor):
    """Runs the `Physics` on the actor's clock, and publishes sensors and ground truth."""

    class Parameters(Actor.Parameters, frozen=True):
        """Conditions of a flight; the run sets `seed`, `dead_man` and `dead_man_timeout_s`.

        Attributes:
            seed: seed of wind and noise.
            dead_man: whether the speed controllers idle when commands cease.
            dead_man_timeout_s: how long they carry out the last command.
            pilots: names of the pilots, the preferred one first.
            wind_mps: mean wind; its direction follows from the seed.
            charge: charge of the battery at the start, from 0 to 1.
        """

        seed: int = 0
        dead_man: bool = True
        dead_man_timeout_s: Positive = 0.4
        pilots: Annotated[tuple[t.Text, ...], msgspec.Meta(min_length=1)] = ("pilot", "reserve")
        wind_mps: NonNegative = 1.0
        charge: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.9

    parameters: Parameters
    outputs = (*t.IMUS, t.GPS, t.BAROMETER, t.HEADING, t.BATTERY, t.ESC, t.TRUTH)

    def on_start(self) -> None:
        """Put the vehicle on the ground."""
        given = self.parameters
        self._rotors = SpeedControllers(
            given.pilots, given.dead_man_timeout_s if given.dead_man else math.inf)
        self.physics = physics = Physics(
            given.seed, given.wind_mps, given.charge, self._rotors, self.clock.now())
        self._faults: dict[tuple[str, int], tuple[t.BodyFault, float, int]] = {}
        self._ticks = 0
        read: list[tuple[Topic[Any], Callable[[], Any]]] = [
            (topic, partial(physics.imu, i)) for i, topic in enumerate(t.IMUS)]
        read += [(t.ESC, physics.esc), (t.TRUTH, physics.truth), (t.BAROMETER, physics.barometer),
                 (t.HEADING, physics.heading), (t.GPS, physics.gps), (t.BATTERY, physics.battery)]
        self._readings = [(round(1 / (topic.rate_hz * _TICK_S)), topic, r) for topic, r in read]

    @on(t.ROTORS)
    def rotors(self, message: t.RotorCommand, header: Header) -> None:
        """Pass a command to the speed controllers."""
        stamp_s = min(header.stamp, self.clock.now())
        if not self._rotors.command(header.source, message.thrust_n, stamp_s):
            self.report_diagnostic(
                "rotors", f"thrust {message.thrust_n} N: impossible", header.source)

    @on(t.BODY_FAULT)
    def fault(self, message: t.BodyFault, _header: Header) -> None:
        """Put a fault of the vehicle in force."""
        place = message.kind, message.rotor
        if message.kind not in ("rotor", "battery"):
            self._report(message, 0, finished=True, why=f"kind {message.kind!r}: expected rotor or "
                                                        "battery")
            return
        self._faults[place] = (message, self.clock.now() + message.duration_s, 0)
        self._set(message, message.factor)

    @every(_TICK_S)
    def tick(self) -> None:
        """Step the physics, and publish the sensors that are due."""
        now_s, physics = self.clock.now(), self.physics
        if now_s - physics.now_s > _MOST_BEHIND_S:
            physics.skip(now_s - _TICK_S)
        physics.step_to(now_s)
        if report_instability(self, physics.data):
            return
        self._ticks += 1
        for each, topic, read in self._readings:
            if self._ticks % each == 0:
                self.publish(topic, read())
        if self._faults:
            self._advance_faults(now_s)

    def _advance_faults(self, now_s: float) -> None:
        for place, (fault, until_s, ticks) in list(self._faults.items()):
            self._faults[place] = fault, until_s, ticks + 1
            if over := now_s >= until_s:
                del self._faults[place]
                self._set(fault, 1.0)
            if over or ticks == 0:
                self._report(fault, ticks + 1, finished=over)

    def _set(self, fault: t.BodyFault, factor: float) -> None:
        if fault.kind == "rotor":
            self.physics.health.rotors[fault.rotor] = min(factor, 1.0)
        else:
            self.physics.health.drain = factor

    def _report(self, fault: t.BodyFault, ticks: int, *, finished: bool, why: str = "") -> None:
        self.publish(INJECTION_REPORT, InjectionReport(
            fault.injection, self.name, ticks, finished, why))
