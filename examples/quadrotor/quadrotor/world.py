"""The world: the simulated vehicle as an actor. A real one's drivers would stand behind its topics.

A timer of 10 ms steps the physics to the clock's time, in real time as in virtual time, and says
what every sensor reads that is due.
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
"""What the clock was further ahead, because this process was stopped, is left out."""


class World(Actor):
    """Runs the `Physics` on the actor's clock, and knows what is so."""

    class Parameters(Actor.Parameters, frozen=True):
        """The day; the run says `seed`, `dead_man` and `dead_man_timeout_s`.

        Attributes:
            seed: of wind and noise.
            dead_man: whether the speed controllers idle when commands cease.
            dead_man_timeout_s: how long they carry out the last one.
            pilots: whom they obey; the one that comes first is preferred.
            wind_mps: mean wind, from a direction that the seed chooses.
            charge: of the battery at the start, from 0 to 1.
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
        said = self.parameters
        self._rotors = SpeedControllers(
            said.pilots, said.dead_man_timeout_s if said.dead_man else math.inf)
        self.physics = physics = Physics(
            said.seed, said.wind_mps, said.charge, self._rotors, self.clock.now())
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
            self.report_diagnostic("rotors", "a thrust that no rotor has", header.source)

    @on(t.BODY_FAULT)
    def fault(self, message: t.BodyFault, _header: Header) -> None:
        """Put a fault of the vehicle in force."""
        place = message.kind, message.rotor
        if message.kind not in ("rotor", "battery"):
            self._tell(message, 0, finished=True, why=f"no fault of kind {message.kind!r}")
            return
        self._faults[place] = (message, self.clock.now() + message.duration_s, 0)
        self._set(message, message.factor)

    @every(_TICK_S)
    def tick(self) -> None:
        """Step the physics, and say what is due."""
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
            self._go_on(now_s)

    def _go_on(self, now_s: float) -> None:
        for place, (fault, until_s, ticks) in list(self._faults.items()):
            self._faults[place] = fault, until_s, ticks + 1
            if over := now_s >= until_s:
                del self._faults[place]
                self._set(fault, 1.0)
            if over or ticks == 0:
                self._tell(fault, ticks + 1, finished=over)

    def _set(self, fault: t.BodyFault, factor: float) -> None:
        if fault.kind == "rotor":
            self.physics.health.rotors[fault.rotor] = min(factor, 1.0)
        else:
            self.physics.health.drain = factor

    def _tell(self, fault: t.BodyFault, ticks: int, *, finished: bool, why: str = "") -> None:
        self.publish(INJECTION_REPORT, InjectionReport(
            fault.injection, self.name, ticks, finished, why))
