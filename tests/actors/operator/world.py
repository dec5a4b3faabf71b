"""An HMI in a small world: a hub in this process, and `Others` that stands for the rest."""

from __future__ import annotations

import asyncio
import json
import math
import os
from contextlib import asynccontextmanager
from dataclasses import replace

import numpy as np
import websockets

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.page.hmi import OsmosisHmi
from rampart.actors.runtime.actor import Actor, Context, on
from rampart.actors.runtime.clock import Clock
from rampart.manager.spec.specification import parse_specification
from rampart.sim.virtual.virtual_bus import Hub, VirtualBus
from rampart.testing import eventually, free_port
from tests import system_file
from tests.osmosis_system import run_context

AIRPORT = load_airport("vallombre")
FILE = system_file("osmosis")
SPEC = parse_specification(FILE.read_text(encoding="utf-8"), FILE.name)
TOKEN = "abcdefghijklmnop"
LIVE = "$('#link').textContent === 'live'"


NOTED = {"requests": topics.MISSION_REQUEST, "resets": ftm_topics.RESET,
         "orders": topics.MISSION_ORDER, "stick": topics.JOYSTICK, "signals": ftm_topics.SIGNAL,
         "adaptations": ftm_topics.ADAPT, "injections": bus_topics.INJECT,
         "diagnostics": bus_topics.DIAGNOSTIC}
"""Lists of messages in `Others`, by topic."""


def noting(name: str, topic: Topic):
    """Return a handler that notes each message of a topic."""
    def note(self, message, _header) -> None:
        getattr(self, name).append(message)

    return on(topic)(note)


class Others(Actor):
    """Stands for the rest of the system: notes what it hears, and says what a test wants."""

    outputs = tuple(topics.ALL)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        for name in NOTED:
            setattr(self, name, [])

    on_request, on_reset, on_order, on_stick, on_signal, on_adapt, on_injection, on_diagnostic = (
        noting(name, topic) for name, topic in NOTED.items())

    def manager(self, *active: str, activated: tuple[str, ...] = (),
                latched: tuple[str, ...] = ()) -> None:
        """Publish the manager's status: some mechanisms are active, and so are their modules."""
        detecting = {d for x in SPEC.mechanisms if x.name in active for d in x.detections}
        self.publish(ftm_topics.MANAGER_STATUS, fm.ManagerStatus(
            active, (), activated, latched, "guarded-repair", 1, tuple(
                fm.DetectionView(d.name, d.name in detecting, "a test" * (d.name in detecting), ())
                for d in SPEC.detections)))

    def sweep(self) -> None:
        """Publish a pose and a sweep with one echo, 3 m straight ahead."""
        ranges = np.full(181, 8.0, dtype="<f4")
        ranges[90] = 3.0
        self.publish(topics.POSE, m.Pose(-10.0, 5.0, 0.5))
        self.publish(topics.SCAN, m.LaserScan(
            -math.radians(135), math.radians(1.5), 8.0, ranges.tobytes()))

    def busy(self) -> None:
        """Publish something for every part of the page."""
        self.sweep()
        self.manager("FTM4", activated=("RM3",), latched=("RM1",))
        goals = tuple(m.Goal(g.x_m, g.y_m, m.Mode(g.mode)) for g in AIRPORT.mission("AB").goals)
        self.publish(topics.MISSION_STATUS, m.MissionStatus(
            "r1/first", "AB", m.MissionPhase.RUNNING, 1, goals, (12.0,), (), "",
            orders=tuple(m.MissionAction)))
        self.publish(topics.PILOT_STATUS, m.PilotStatus(m.PilotMode.AUTO, False, "", 0))
        self.publish(ftm_topics.NODES, fm.NodeTable(tuple(
            fm.NodeInfo(n.name, n.kind.value, os.getpid(), fm.NodeState.RUNNING, 1, 0)
            for n in SPEC.actors())))


class World:
    """A hub with `Others` on it; HMIs join and leave."""

    airport = AIRPORT

    def __init__(self) -> None:
        loop = asyncio.get_running_loop()
        self.hub = Hub()
        self.clock = Clock(loop.time(), 20.0, loop.time)
        self.others = Others(self.context("others", 1))

    def context(self, name: str, incarnation: int, **shared: object) -> Context:
        run = {"airport": AIRPORT, "run_id": "r1", "hmi_port": free_port(), **shared}
        return Context(name, incarnation, self.clock, VirtualBus(self.hub, name, incarnation),
                       run=run_context(**run))

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
    async def hmi(self, incarnation: int = 1, panels=OsmosisHmi.panels, **shared: object):
        context = replace(self.context("hmi", incarnation, **shared),
                          topics={topic.key: topic for topic in topics.ALL},
                          parameters={"panels": panels})
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


def open_page(at: str, token: str = "", path: str = "/ws", **options):
    if token:
        options["additional_headers"] = {"Authorization": f"Bearer {token}"}
    return websockets.connect(f"ws://{at}{path}", **options)


@asynccontextmanager
async def visited(world: World, token: str = "", **shared: object):
    """Yield an HMI and a page on it, of a visitor with a token."""
    async with world.hmi(**shared) as hmi, open_page(await served(hmi), token) as page:
        yield hmi, page


async def ask(page, **wish: object) -> dict:
    """Send a wish and return what the page is told."""
    await page.send(json.dumps(wish))
    return await hear(page, "done", "error", "stick")


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


# -- The page on an HMI in a real Chromium --


async def show(tab, hmi, **look) -> None:
    """Show the page of an HMI."""
    await tab.show(f"http://{await served(hmi)}/", **look)
    await tab.until(LIVE)


@asynccontextmanager
async def page(world: World, tab, airport=AIRPORT, system=SPEC, **look):
    """Show the page of an HMI that knows the system and an airport."""
    async with world.hmi(system=system, airport=airport) as hmi:
        await show(tab, hmi, **look)
        await tab.until("$$('#tree .event').length > 0")
        yield hmi


def text(name: str) -> str:
    """Return an expression for the text of an element with an id."""
    return f"$('#{name}').textContent"


def events(kind: str) -> str:
    return f"$$('#tree .event.{kind} .ftm').map((t) => t.textContent).join()"
