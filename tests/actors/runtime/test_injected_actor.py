"""Injections in living actors: what goes over the bus, what the readers get, what is reported."""

from __future__ import annotations

import asyncio
import math
from contextlib import asynccontextmanager

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.envelope import decode
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.runtime.actor import Actor, Context, Header, every, on
from rampart.sim.virtual.virtual_bus import VirtualBus
from tests.osmosis_system import System
from tests.virtual_time import within


class Talker(Actor):
    """Publishes a pose ten times a second, and a reset once a second."""

    outputs = (topics.POSE, ftm_topics.RESET)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.said = 0

    @every(0.1)
    def speak(self) -> None:
        self.said += 1
        self.publish(topics.POSE, m.Pose(float(self.said), 0.0, 0.0))
        if self.said % 10 == 0:
            self.publish(ftm_topics.RESET, fm.Reset("RM1", str(self.said)))


class Listener(Actor):
    """Keeps the messages that it receives."""

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.poses: list[float] = []
        self.resets: list[str] = []
        self.reports: list[bm.InjectionReport] = []
        self.diagnostics: list[bm.Diagnostic] = []

    @on(topics.POSE)
    def pose(self, message: m.Pose, header: Header) -> None:
        self.poses.append(message.x_m)

    @on(ftm_topics.RESET)
    def reset(self, message: fm.Reset, header: Header) -> None:
        self.resets.append(message.by)

    @on(bus_topics.INJECTION_REPORT)
    def report(self, message: bm.InjectionReport, header: Header) -> None:
        self.reports.append(message)

    @on(bus_topics.DIAGNOSTIC)
    def diagnostic(self, message: bm.Diagnostic, header: Header) -> None:
        self.diagnostics.append(message)

    @property
    def told(self) -> list[tuple[int, bool, str]]:
        return [(r.affected, r.finished, r.reason) for r in self.reports]


class Tool(Actor):
    """Orders injections."""

    outputs = (bus_topics.INJECT,)


class Scene:
    """A talker, a listener, a tool, and what passes on the wire."""

    def __init__(self, system: System) -> None:
        self.system = system
        self.wire: list[bytes] = []
        self.talker = system.start("talker", Talker)
        self.listener = system.start("listener", Listener)
        self.tool = system.start("tool", Tool)

    async def open(self) -> None:
        tap = VirtualBus(self.system.hub, "tap")
        await tap.open()
        for topic in (topics.POSE, ftm_topics.RESET):
            tap.subscribe(topic.at(), lambda _key, payload: self.wire.append(payload))
        await self.system.settle()

    def inject(self, mode: str, duration_s: float, topic: str = "localization/pose",
               **fields: object) -> None:
        self.tool.publish(bus_topics.INJECT, bm.Injection("i", topic, mode, duration_s, **fields))


@asynccontextmanager
async def scene():
    async with System() as system:
        made = Scene(system)
        await made.open()
        yield made


@within(scene)
async def test_a_duplicate_is_the_same_payload_twice_and_reaches_no_actor_twice(scene):
    scene.inject("duplicate", 9.0)
    scene.tool.publish(bus_topics.INJECT, bm.Injection("j", "manager/reset", "duplicate", 9.0))
    await asyncio.sleep(3.05)
    assert len(scene.wire) == 2 * (30 + 3)
    for first, second in zip(scene.wire[::2], scene.wire[1::2], strict=True):
        assert first == second
    sequences = [decode(topics.POSE, p)[0].sequence for p in scene.wire[::2]
                 if b"RM1" not in p]
    assert sequences == sorted(set(sequences))
    assert scene.listener.poses == [float(i) for i in range(1, 31)]
    assert scene.listener.resets == ["10", "20", "30"]


@within(scene)
async def test_a_fault_for_a_while_reports_its_order_its_first_effect_and_its_end(scene):
    scene.inject("drop", 0.95)
    await asyncio.sleep(2.0)
    assert scene.listener.told == [(0, False, ""), (1, False, ""), (9, True, "")]
    assert scene.listener.poses == [float(i) for i in range(10, 20)]


@within(scene)
async def test_a_permanent_fault_sets_no_timer_and_never_ends(scene):
    timers = len(scene.talker._timers)
    scene.inject("drop", math.inf)
    await scene.system.settle()
    assert len(scene.talker._timers) == timers
    await asyncio.sleep(100.0)
    assert scene.talker.said > 900
    assert scene.listener.poses == []
    assert scene.listener.told == [(0, False, ""), (1, False, "")]


@within(scene)
async def test_an_order_without_duration_ends_the_fault_with_its_count_once(scene):
    scene.inject("drop", 5.0)
    await asyncio.sleep(1.05)
    scene.inject("drop", 0.0)
    await asyncio.sleep(9.0)
    assert scene.listener.poses[0] == 11.0
    assert [r for r in scene.listener.told if r[1]] == [(10, True, "")]


@within(scene)
async def test_a_fault_that_does_not_fit_its_topic_is_refused_when_it_is_ordered(scene):
    scene.inject("corrupt", 5.0, set_fields={"z_m": 1.0})
    await asyncio.sleep(1.05)
    ((affected, finished, reason),) = scene.listener.told
    assert (affected, finished) == (0, True)
    assert "'z_m': unknown in Pose; known: x_m, y_m, yaw_rad" in reason
    assert len(scene.listener.poses) == 10


@within(scene)
async def test_a_fault_that_fails_on_its_first_message_is_reported_as_no_effect(scene):
    class Broken(Actor):
        outputs = (topics.SCAN,)

        @every(0.1)
        def speak(self) -> None:
            self.publish(topics.SCAN, m.LaserScan(0.0, 0.1, 8.0, b"12345"))

    scene.system.start("broken", Broken)
    await scene.system.settle()
    scene.inject("corrupt", 5.0, "summit_xl/scan", add_fields={"ranges_f32": 1.0})
    await asyncio.sleep(9.0)
    assert [r[:2] for r in scene.listener.told] == [(0, False), (0, True)]
    assert "5 bytes" in scene.listener.told[-1][2]
    (diagnostic,) = scene.listener.diagnostics
    assert (diagnostic.context, diagnostic.offender) == ("fault injection", "summit_xl/scan")
