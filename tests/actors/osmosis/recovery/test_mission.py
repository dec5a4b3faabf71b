"""RM6: another plan is asked of the Mission Manager."""

import asyncio

import pytest

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.control.mission.mission_manager import MissionManager
from rampart.actors.osmosis.messages import Mode
from rampart.actors.osmosis.recovery.replan import Replan
from rampart.actors.runtime.actor import Actor, on
from tests.actors.osmosis.recovery.world import Boss
from tests.osmosis_system import in_system

DOWN = m.Goal(-29.5, -3.0, Mode.TAXI)


class Planner(Actor):
    """Answers each goal with a route, unless it is set to be silent."""

    outputs = (topics.ROUTE,)
    way = ((0.0, 0.0), (1.0, 0.0))
    dumb = False

    @on(topics.GOAL)
    def goal(self, message, header):
        if not self.dumb:
            self.publish(topics.ROUTE, m.Route(
                message.mission_id, message.step, message.goal.mode, message.active,
                self.way if message.active else (), "" if self.way else "no way", message.plan))


async def replanning(system, *, mission=True):
    """Start RM6, who commands it, the planner, and a Mission Manager with a mission."""
    boss, planner = Boss(system), system.start("planner", Planner)
    manager = system.start("mission_manager", MissionManager)
    system.start("RM6", Replan)
    await system.settle()
    if mission:
        system.say(topics.MISSION_REQUEST, m.MissionRequest("m1", "A", (DOWN,)))
    await asyncio.sleep(0.5)
    return boss, planner, manager


@in_system(airport=load_airport("vallombre"))
async def test_a_replan_is_done_when_the_new_route_is_there(system):
    boss, _, manager = await replanning(system)
    for decision, plan in ((1, 1), (1, 1), (2, 2)):  # the same command is the same order
        boss.order("RM6", decision)
        await asyncio.sleep(0.5)
        assert manager.state.plan == plan
    boss.release("RM6", decision=3)
    await asyncio.sleep(0.1)
    assert boss.phases == ["idle", "acting", "done", "acting", "done", "idle"]


@pytest.mark.parametrize(("mission", "way", "dumb", "reason"), [
    (False, ((0.0, 0.0),), False, "refused: no mission is under way"),
    (True, (), False, "no route: no way"),
    (True, ((0.0, 0.0),), True, "not done within 2 s: no new route")])
@in_system(airport=load_airport("vallombre"))
async def test_a_replan_without_a_new_route_fails_with_the_reason(
        system, mission, way, dumb, reason):
    boss, planner, _ = await replanning(system, mission=mission)
    planner.way, planner.dumb = way, dumb
    boss.order("RM6")
    await asyncio.sleep(2.2)
    assert boss.phases == ["idle", "acting", "failed"]
    assert boss.reports[-1].message.reason == reason
