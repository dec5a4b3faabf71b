"""An HMI in a small world: a hub in this process, and `Others` that stands for the rest."""

from __future__ import annotations

import asyncio
import json
from contextlib import asynccontextmanager
from dataclasses import replace

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.page.hmi import OsmosisHmi
from rampart.actors.runtime.actor import Actor, Context, Header, on
from rampart.actors.runtime.clock import Clock
from rampart.sim.virtual.virtual_bus import Hub, VirtualBus
from rampart.testing import eventually
from tests.osmosis_system import run_context

AIRPORT = load_airport("vallombre")
RATE = 20.0


class Others(Actor):
    """Stands for the rest of the system."""

    outputs = (topics.MISSION_STATUS, ftm_topics.MANAGER_STATUS, topics.POSE, ftm_topics.DETECTION,
               topics.MISSION_ORDER_ANSWER, topics.PILOT_STATUS, ftm_topics.NODES,
               topics.BASE_STATUS, ftm_topics.ADAPTATION, bus_topics.INJECTION_REPORT,
               bus_topics.DIAGNOSTIC)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.requests: list[m.MissionRequest] = []
        self.resets: list[fm.Reset] = []
        self.orders: list[m.MissionOrder] = []
        self.diagnostics: list[bm.Diagnostic] = []
        self.stick: list[m.Joystick] = []
        self.signals: list[fm.SignalOrder] = []
        self.adaptations: list[fm.AdaptationRequest] = []
        self.injections: list[bm.Injection] = []
        self.actuator_faults: list[m.ActuatorFault] = []

    @on(ftm_topics.SIGNAL)
    def signal(self, message: fm.SignalOrder, _header: Header) -> None:
        self.signals.append(message)

    @on(topics.MISSION_REQUEST)
    def request(self, message: m.MissionRequest, _header: Header) -> None:
        self.requests.append(message)

    @on(ftm_topics.RESET)
    def reset(self, message: fm.Reset, _header: Header) -> None:
        self.resets.append(message)

    @on(topics.MISSION_ORDER)
    def order(self, message: m.MissionOrder, _header: Header) -> None:
        self.orders.append(message)

    @on(topics.JOYSTICK)
    def joystick(self, message: m.Joystick, _header: Header) -> None:
        self.stick.append(message)

    @on(ftm_topics.ADAPT)
    def adapt(self, message: fm.AdaptationRequest, _header: Header) -> None:
        self.adaptations.append(message)

    @on(bus_topics.INJECT)
    def injection(self, message: bm.Injection, _header: Header) -> None:
        self.injections.append(message)

    @on(topics.ACTUATOR_FAULT)
    def actuator_fault(self, message: m.ActuatorFault, _header: Header) -> None:
        self.actuator_faults.append(message)

    @on(bus_topics.DIAGNOSTIC)
    def diagnostic(self, message: bm.Diagnostic, _header: Header) -> None:
        self.diagnostics.append(message)


class World:
    """A hub with `Others` on it; HMIs join and leave."""

    def __init__(self) -> None:
        loop = asyncio.get_running_loop()
        self.hub = Hub()
        self.clock = Clock(loop.time(), RATE, loop.time)
        self.others = Others(self.context("others", 1))

    def context(self, name: str, incarnation: int, **shared: object) -> Context:
        return Context(name, incarnation, self.clock, VirtualBus(self.hub, name, incarnation),
                       run=run_context(**{"airport": AIRPORT, "run_id": "r1", **shared}))

    @asynccontextmanager
    async def running(self, actor: Actor):
        task = asyncio.create_task(actor.run())
        for _ in range(20):
            await asyncio.sleep(0)
        try:
            yield actor
        finally:
            actor.stop()
            await asyncio.wait_for(task, 5)

    @asynccontextmanager
    async def hmi(self, incarnation: int = 1, **shared: object):
        context = replace(self.context("hmi", incarnation, **shared),
                          topics={topic.key: topic for topic in topics.ALL},
                          parameters={"panels": OsmosisHmi.panels})
        async with self.running(OsmosisHmi(context)) as hmi:
            yield hmi

    def say_running(self, request: m.MissionRequest) -> None:
        self.others.publish(topics.MISSION_STATUS, m.MissionStatus(
            request.mission_id, request.name, m.MissionPhase.RUNNING, 0, request.goals, (), (), ""))

    def say(self, phase: m.MissionPhase, *possible: m.MissionAction) -> None:
        goals = tuple(m.Goal(g.x_m, g.y_m, m.Mode(g.mode)) for g in AIRPORT.mission("A").goals)
        self.others.publish(topics.MISSION_STATUS, m.MissionStatus(
            "r1/first", "A", phase, 0, goals, (), (), "", orders=possible))

    def say_latched(self, *names: str) -> None:
        self.others.publish(ftm_topics.MANAGER_STATUS, fm.ManagerStatus(
            (), (), names, names, "safety-first", 1))


@asynccontextmanager
async def repeated(say, period_s: float = 0.02):
    """Have something said again and again, as living nodes do."""
    async def again() -> None:
        while True:
            say()
            await asyncio.sleep(period_s)

    task = asyncio.create_task(again())
    try:
        yield
    finally:
        task.cancel()


async def served(hmi: OsmosisHmi) -> str:
    await eventually(lambda: hmi._server is not None)
    return f"127.0.0.1:{hmi._server.port}"


async def hear(page, *kinds: str) -> dict:
    """Return the next message of some kinds; of a state, all that the page knows by then."""
    async with asyncio.timeout(5):
        while True:
            message = json.loads(await page.recv())
            if message["type"] == "state":
                known = page.__dict__.setdefault("picture", {})
                for log in ("decisions", "events"):
                    message[log] = [*known.get(log, ()), *message.get(log, ())]
                known |= message
                message = dict(known)
            if message["type"] in kinds:
                return message
