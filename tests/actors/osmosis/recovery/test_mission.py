"""Recoveries that ask the Mission Manager: for another plan, and to come home."""

from __future__ import annotations

import asyncio

import pytest

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.control.mission.mission_manager import MissionManager
from rampart.actors.osmosis.messages import MissionAction, MissionPhase, Mode
from rampart.actors.osmosis.recovery.replan import Replan
from rampart.actors.osmosis.recovery.return_home import ReturnHome
from rampart.actors.runtime.actor import Actor, on
from rampart.testing import run
from tests.actors.osmosis.recovery.world import Boss, hang
from tests.osmosis_system import System

AIRPORT = load_airport("vallombre")
DOWN = m.Goal(-29.5, -3.0, Mode.TAXI)


class Planner(Actor):
    """Answers each goal with a route, unless it is set to be silent."""

    outputs = (topics.ROUTE, topics.MISSION_REQUEST)

    def __init__(self, context):
        super().__init__(context)
        self.way = ((0.0, 0.0), (1.0, 0.0))
        self.dumb = False

    @on(topics.GOAL)
    def goal(self, message, header):
        if not self.dumb:
            self.publish(topics.ROUTE, m.Route(
                message.mission_id, message.step, message.goal.mode, message.active,
                self.way if message.active else (), "" if self.way else "no way", message.plan))


    def begin(self, mission_id):
        self.publish(topics.MISSION_REQUEST, m.MissionRequest(mission_id, "A", (DOWN,)))


def play(name, recovery, scenario, *, mission=True):
    async def scene():
        async with System(airport=AIRPORT) as system:
            boss, planner = Boss(system), system.start("planner", Planner)
            manager = system.start("mission_manager", MissionManager)
            system.start(name, recovery)
            await system.settle()
            if mission:
                planner.begin("m1")
            await asyncio.sleep(0.5)
            await scenario(boss, planner, manager)

    run(scene)


# ---- RM6 Replan ---------------------------------------------------------------------------------


def test_a_replan_is_done_when_the_new_route_is_there():
    async def scenario(boss, planner, manager):
        boss.order("RM6")
        await asyncio.sleep(0.1)
        assert boss.phases == ["idle", "acting", "done"]
        assert manager.state.plan == 1
        boss.order("RM6")
        await asyncio.sleep(0.5)
        assert manager.state.plan == 1, "the same command is the same order"
        boss.order("RM6", decision=2)
        await asyncio.sleep(0.5)
        assert manager.state.plan == 2
        boss.release("RM6", decision=3)
        await asyncio.sleep(0.1)
        assert boss.phases == ["idle", "acting", "done", "acting", "done", "idle"]

    play("RM6", Replan, scenario)


@pytest.mark.parametrize(("mission", "way", "dumb", "reason"), [
    (False, ((0.0, 0.0),), False, "refused: no mission is under way"),
    (True, (), False, "no route: no way"),
    (True, ((0.0, 0.0),), True, "not done within 2 s: no new route")])
def test_a_replan_without_a_new_route_fails_with_the_reason(mission, way, dumb, reason):
    async def scenario(boss, planner, manager):
        planner.way, planner.dumb = way, dumb
        boss.order("RM6")
        await asyncio.sleep(2.2)
        assert boss.phases == ["idle", "acting", "failed"]
        assert boss.reports[-1].message.reason == reason

    play("RM6", Replan, scenario, mission=mission)


# ---- ReturnHome ---------------------------------------------------------------------------------


def come_home(scenario, *, mission=True):
    play("RM9", ReturnHome, scenario, mission=mission)


def test_the_robot_is_ordered_home_once_and_goes_on_doing_so_when_the_cause_is_gone():
    async def scenario(boss, planner, manager):
        boss.order("RM9", reason="no link to ground")
        await asyncio.sleep(0.5)
        assert boss.phases == ["idle", "acting", "degraded"]
        assert manager.state.phase is MissionPhase.RETURNING
        assert manager.state.homing == "RM9: no link to ground"
        boss.order("RM9", decision=2)
        await asyncio.sleep(0.5)
        boss.release("RM9", decision=3)
        await asyncio.sleep(0.5)
        assert boss.phases == ["idle", "acting", "degraded", "idle"]
        assert manager.state.phase is MissionPhase.RETURNING
        assert len(manager.state.answers) == 1

    come_home(scenario)


def test_a_robot_on_its_way_home_already_is_left_alone():
    async def scenario(boss, planner, manager):
        manager.order(m.MissionOrder("o1", MissionAction.HOME, "lunch", "operator"), None)
        await asyncio.sleep(0.5)
        boss.order("RM9")
        await asyncio.sleep(0.5)
        assert boss.phases[-1] == "degraded"
        assert manager.state.homing == "operator: lunch"

    come_home(scenario)


@pytest.mark.parametrize("begun", [False, True])
def test_with_nothing_to_bring_home_it_waits_for_a_mission_that_is_begun(begun):
    async def scenario(boss, planner, manager):
        boss.order("RM9")
        await asyncio.sleep(0.5)
        assert boss.reports[-1].message.reason == "no mission is under way"
        if begun:
            planner.begin("m2")
            await asyncio.sleep(0.5)
            assert manager.state.phase is MissionPhase.RETURNING
        assert boss.phases[-1] == "degraded"

    come_home(scenario, mission=False)


@pytest.mark.parametrize("late_s", [1.0, 3.0])
def test_where_home_is_not_known_it_waits_for_that_until_its_deadline(late_s):
    async def scenario(boss, planner, manager):
        planner.dumb = True
        planner.begin("m2")
        await asyncio.sleep(0.2)
        boss.order("RM9")
        await asyncio.sleep(late_s)
        assert manager.state.phase is MissionPhase.RUNNING
        planner.dumb = False
        await asyncio.sleep(0.5)
        if late_s > 2.0:
            assert boss.reports[-1].message.reason == (
                "not done within 2 s: refused: the start of the mission is unknown")
            boss.order("RM9", decision=2)
            await asyncio.sleep(0.2)
        assert boss.phases[-1] == "degraded"
        assert manager.state.phase is MissionPhase.RETURNING

    come_home(scenario, mission=False)


def test_it_fails_at_its_deadline_without_a_mission_manager():
    async def scenario(boss, planner, manager):
        hang(manager)
        boss.order("RM9")
        await asyncio.sleep(2.3)
        assert boss.reports[-1].message.reason.endswith("no answer from the Mission Manager")

    come_home(scenario)
