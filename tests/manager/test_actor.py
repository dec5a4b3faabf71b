"""The FTM Manager between real detection and recovery modules, on one virtual bus.

Below, all of DM1 to DM7 and RM1 to RM5 run as in the shipped system; base, pilot, supervisor and
the nodes are played. Nothing here takes real time.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from rampart.actors.bus import topics as bus_topics
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.machine.absence import GRACE_S
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.runtime.actor import Actor, Context, every
from rampart.actors.system.layout import Layout
from rampart.sim.virtual.virtual_loop import VirtualLoop
from tests.actors.osmosis.detection.lane import LANE
from tests.actors.osmosis.recovery.world import Base, Node, Pilot, Supervisor
from tests.osmosis_system import System, shipped_system
from tests.virtual_time import within

NODES = ("mission_manager", "graph_planner", "osmosis_control", "hmi", "teleoperation",
         "localization")


class Robot(Actor):
    """Publishes command, pose and GPS at 20 Hz, until one of them is told to cease."""

    outputs = (topics.COMMAND, topics.POSE, topics.GPS)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.silent: set[str] = set()
        self.speed_mps = 0.5
        self.y_m = 0.0

    @every(0.05)
    def talk(self) -> None:
        if "command" not in self.silent:
            self.publish(topics.COMMAND, m.Twist(self.speed_mps, 0.0))
        if "pose" not in self.silent:
            self.publish(topics.POSE, m.Pose(0.0, self.y_m, 0.0))
        self.publish(topics.GPS, m.GpsFix(0.0, self.y_m, 0.0, 0.0, 0.05))


class Whole(System):
    """All modules of the shipped system, and the world around them."""

    def __init__(self) -> None:
        super().__init__(system=shipped_system(), airport=LANE)
        self.layout = Layout(self.run.plan, self.run.system, self.run.application)
        spec = shipped_system()
        self.modules = [*(row.name for row in (*spec.detections, *spec.recoveries)), "ftm_manager"]

    async def begin(self) -> None:
        """Start everything, and wait until all is known and well."""
        self.decisions = self.hear(ftm_topics.DECISION)
        self._statuses = self.hear(ftm_topics.MANAGER_STATUS)
        self._problems = self.hear(bus_topics.DIAGNOSTIC)
        self.base = self.start("base", Base)
        self.pilot = self.start("safety_pilot", Pilot)
        self.supervisor = self.start("supervisor", Supervisor)
        self.robot = self.start("robot", Robot)
        for name in NODES:
            self.start(name, Node)
        for name in self.modules:
            self.start_node(name)
        await asyncio.sleep(1.0)
        assert self.decisions == []
        assert self.status.activated == ()

    @property
    def status(self) -> fm.ManagerStatus:
        """What the manager said last."""
        return self._statuses[-1].message

    @property
    def problems(self) -> list[str]:
        return [f"{p.message.context}: {p.message.reason}" for p in self._problems]

    @property
    def taken(self) -> list[tuple[tuple[str, ...], int, tuple[str, ...]]]:
        """Active mechanisms, rule and recoveries of each decision."""
        return [(d.message.active, d.message.rule, d.message.recoveries) for d in self.decisions]

    @property
    def silent(self) -> set[str]:
        """All that ever counted as silent."""
        return {name for status in self._statuses for name in status.message.silent}


@asynccontextmanager
async def whole() -> AsyncIterator[Whole]:
    async with Whole() as system:
        await system.begin()
        yield system


@pytest.mark.parametrize(("node", "mechanism", "recovery"), [
    ("osmosis_control", "FTM4", "RM3"), ("hmi", "FTM5", "RM4"), ("localization", "FTM7", "RM4")])
@within(whole)
async def test_a_killed_node_is_asked_for_before_any_time_passes_and_released_when_it_is_back(
        system, node, mechanism, recovery):
    await system.kill(node)
    killed_s = system.clock.now()
    await system.settle()
    at, request = system.supervisor.requests[0]
    assert (at, request.node, request.failed_incarnation, request.by) == (
        killed_s, node, 1, recovery)
    await asyncio.sleep(3.0)
    assert system.taken == [((mechanism,), 1, (recovery,)), ((), 0, ())]
    assert system.decisions[0].message.detected_s == killed_s
    assert system.status.activated == ()
    assert system.incarnations[node] == 2


@within(whole)
async def test_an_emergency_stop_comes_with_the_fix_and_stays_until_it_is_reset(system):
    system.robot.y_m = 2.2
    system.robot.talk()
    await system.settle()
    assert system.base.engaged
    reset = fm.Reset("RM1", "operator")
    system.say(ftm_topics.RESET, reset)
    await system.settle()
    assert system.problems == ["reset refused: the cause persists: FTM1 active"]
    system.robot.y_m = 0.0
    await asyncio.sleep(5.0)
    assert system.base.engaged
    assert system.status.latched == ("RM1",)
    system.say(ftm_topics.RESET, reset)
    await system.settle()
    assert not system.base.engaged
    assert system.status.latched == ()


@within(whole)
async def test_a_detection_module_that_lives_and_is_not_heard_is_replaced_once(system):
    system.supervisor.answer = "nothing"
    timeout_s = system.run.system.timing.detection_silence_timeout_s
    hung_s = system.clock.now()
    system.actors["DM3"].hold(True)
    await asyncio.sleep(3.0)
    (at_s, request), = system.supervisor.requests
    assert 0.4 * timeout_s < at_s - hung_s < 0.75 * timeout_s
    assert (request.node, request.failed_incarnation, request.by) == ("DM3", 1, "ftm_manager")
    assert system.status.silent == ("DM3",)
    await system.kill("DM3")
    system.start_node("DM3")
    await asyncio.sleep(2.0)
    assert system.status.silent == ()
    system.actors["DM3"].hold(True)
    await asyncio.sleep(2.0)
    assert [(r.request, r.node, r.failed_incarnation)
            for _, r in system.supervisor.requests] == [(1, "DM3", 1), (2, "DM3", 2)]


@pytest.mark.parametrize("dies_too", [(), ("RM1",)], ids=["alone", "with RM1"])
@within(whole)
async def test_a_respawned_manager_adopts_a_latched_emergency_stop(system, dies_too):
    system.robot.y_m = 2.2
    await asyncio.sleep(0.5)
    for name in ("ftm_manager", *dies_too):
        await system.kill(name)
    system.robot.y_m = 0.0
    await asyncio.sleep(2.0)
    for name in ("ftm_manager", *dies_too):
        system.start_node(name)
        await asyncio.sleep(0.3)
    for _ in range(100):
        await asyncio.sleep(0.05)
        assert system.base.engaged
    assert system.status.latched == ("RM1",)
    system.say(ftm_topics.RESET, fm.Reset("RM1", "operator"))
    await asyncio.sleep(0.5)
    assert not system.base.engaged


@within(whole)
async def test_a_manager_that_was_stopped_takes_nobodys_unread_mail_for_silence(system):
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    for pause_s in (0.31, 0.4, 0.5, 0.7, 1.1, 5.0):
        loop.jump(pause_s)
        await asyncio.sleep(2.0)
    assert not system.base.engaged
    assert not any("DM" in name for name in system.silent)
    assert system.decisions == []


@within(whole)
async def test_a_manager_that_was_stopped_waits_for_modules_that_go_on_after_it(system):
    for actor in system.actors.values():
        actor.hold(True)
    await asyncio.sleep(5.0)
    system.actors["ftm_manager"].hold(False)
    await asyncio.sleep(0.8 * GRACE_S)
    for actor in system.actors.values():
        actor.hold(False)
    await asyncio.sleep(2.0)
    assert system.decisions == []
    assert set(system.incarnations.values()) == {1}
    system.actors["DM6"].hold(True)
    await asyncio.sleep(2.0)
    assert "DM6" in system.status.silent
