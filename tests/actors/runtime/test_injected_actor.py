"""Injections in living actors: what goes over the bus, what the readers get, what is reported."""

from __future__ import annotations

import asyncio
import math

from rampart.actors.bus import topics as bus_topics
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.runtime.actor import Actor, Context, Header, every, on
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
    """Keeps what it receives."""

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.poses: list[float] = []
        self.resets: list[str] = []

    @on(topics.POSE)
    def pose(self, message: m.Pose, _header: Header) -> None:
        self.poses.append(message.x_m)

    @on(ftm_topics.RESET)
    def reset(self, message: fm.Reset, _header: Header) -> None:
        self.resets.append(message.by)


class Scene(System):
    """A talker, a listener, and what passes on the wire."""

    async def __aenter__(self) -> Scene:
        await super().__aenter__()
        self.wire = self.hear(topics.POSE)
        self.reports = self.hear(bus_topics.INJECTION_REPORT)
        self.diagnostics = self.hear(bus_topics.DIAGNOSTIC)
        self.talker = self.start("talker", Talker)
        self.listener = self.start("listener", Listener)
        await self.settle()
        return self

    @property
    def told(self) -> list[tuple[int, bool, str]]:
        """What was affected, whether it is over, and why, of each report."""
        return [(r.message.affected, r.message.finished, r.message.reason) for r in self.reports]


@within(Scene)
async def test_a_duplicate_is_the_same_payload_twice_and_reaches_no_actor_twice(scene):
    scene.inject(topics.POSE, "duplicate", 9.0)
    scene.inject(ftm_topics.RESET, "duplicate", 9.0, name="another")
    await asyncio.sleep(3.05)
    assert len(scene.wire) == 2 * 30
    assert scene.wire[::2] == scene.wire[1::2]
    sequences = [heard.header.sequence for heard in scene.wire[::2]]
    assert sequences == sorted(set(sequences))
    assert scene.listener.poses == [float(i) for i in range(1, 31)]
    assert scene.listener.resets == ["10", "20", "30"]


@within(Scene)
async def test_a_fault_for_a_while_reports_its_order_its_first_effect_and_its_end(scene):
    scene.inject(topics.POSE, "drop", 0.95)
    await asyncio.sleep(2.0)
    assert scene.told == [(0, False, ""), (1, False, ""), (9, True, "")]
    assert scene.listener.poses == [float(i) for i in range(10, 20)]


@within(Scene)
async def test_a_permanent_fault_sets_no_timer_and_never_ends(scene):
    timers = len(scene.talker._timers)
    scene.inject(topics.POSE, "drop", math.inf)
    await scene.settle()
    assert len(scene.talker._timers) == timers
    await asyncio.sleep(100.0)
    assert scene.talker.said > 900
    assert scene.listener.poses == []
    assert scene.told == [(0, False, ""), (1, False, "")]


@within(Scene)
async def test_an_order_without_duration_ends_the_fault_with_its_count_once(scene):
    scene.inject(topics.POSE, "drop", 5.0)
    await asyncio.sleep(1.05)
    scene.inject(topics.POSE, "drop", 0.0)
    await asyncio.sleep(9.0)
    assert scene.listener.poses[0] == 11.0
    assert [told for told in scene.told if told[1]] == [(10, True, "")]


@within(Scene)
async def test_a_fault_that_does_not_fit_its_topic_is_refused_when_it_is_ordered(scene):
    scene.inject(topics.POSE, "corrupt", 5.0, set_fields={"z_m": 1.0})
    await asyncio.sleep(1.05)
    ((affected, finished, reason),) = scene.told
    assert (affected, finished) == (0, True)
    assert "'z_m': unknown in Pose; known: x_m, y_m, yaw_rad" in reason
    assert len(scene.listener.poses) == 10


@within(Scene)
async def test_a_fault_that_fails_on_its_first_message_is_reported_as_no_effect(scene):
    class Broken(Actor):
        outputs = (topics.SCAN,)

        @every(0.1)
        def speak(self) -> None:
            self.publish(topics.SCAN, m.LaserScan(0.0, 0.1, 8.0, b"12345"))

    scene.start("broken", Broken)
    await scene.settle()
    scene.inject(topics.SCAN, "corrupt", 5.0, add_fields={"ranges_f32": 1.0})
    await asyncio.sleep(9.0)
    assert [told[:2] for told in scene.told] == [(0, False), (0, True)]
    assert "5 bytes" in scene.told[-1][2]
    (diagnostic,) = (heard.message for heard in scene.diagnostics)
    assert (diagnostic.context, diagnostic.offender) == ("fault injection", "summit_xl/scan")
