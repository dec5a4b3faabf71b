"""The simulated robot on an open field, by itself and within its actor."""

from __future__ import annotations

from typing import Any

import shapely

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.airport.model import Airport, StartPose
from rampart.actors.runtime.actor import Context, Header
from rampart.actors.runtime.clock import Clock
from rampart.sim.osmosis.simulator import Simulator
from rampart.sim.osmosis.world import World
from rampart.sim.virtual.virtual_bus import Hub, VirtualBus
from tests.osmosis_system import run_context

FIELD = Airport("Field", {"a": (0.0, 0.0), "b": (1.0, 0.0)}, (("a", "b"),),
                shapely.box(-90, -90, 90, 90), StartPose(0, 0, 0))


def world(airport: Airport = FIELD, **changes: Any) -> World:
    """A world without a dead man that is never too late, unless changed."""
    return World(airport, **{"dead_man_timeout_s": None, "max_catch_up_s": 100.0, **changes})


def run(sim: World, linear: float, angular: float, seconds: float) -> World:
    sim.command(linear, angular)
    sim.step_to(sim.time_s + seconds)
    return sim


class Bench:
    """A simulator whose clock is moved by hand; its messages and diagnostics are kept."""

    def __init__(self, airport: Airport = FIELD, **parameters: Any) -> None:
        self.now_s = 100.0
        clock = Clock(0.0, 1.0, lambda: self.now_s)
        self.actor = Simulator(Context(
            "simulator", 1, clock, VirtualBus(Hub(), "simulator"), parameters,
            run_context(airport=airport)))
        self.sent: list[tuple[str, Any, float]] = []
        self.complaints: list[tuple[str, ...]] = []
        self.actor.has_readers = lambda topic: True
        self.actor.publish = lambda topic, body, stamp=None, name=None: self.sent.append(
            (topic.key, body, self.now_s if stamp is None else stamp))
        self.actor.report_diagnostic = lambda *complaint: self.complaints.append(complaint)
        self.actor.on_start()

    def run(self, seconds: float, command: m.BaseCommand | None = None) -> None:
        for _ in range(round(seconds / 0.02)):
            self.now_s += 0.02
            if command is not None:
                self.actor.command(command, self.header())
            self.actor.tick()

    def header(self, age_s: float = 0.0) -> Header:
        return Header("tester", 1, 1, self.now_s - age_s)

    def all(self, topic: Any) -> list[Any]:
        return [body for key, body, _ in self.sent if key == topic.key]

    def last(self, topic: Any) -> Any:
        return self.all(topic)[-1]
