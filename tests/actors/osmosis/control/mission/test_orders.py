"""Orders to the Mission Manager, and the robot's truth in the mission's state: shipped systems."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from itertools import groupby

import pytest

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.control.following.osmosis_control import OsmosisControl
from rampart.actors.osmosis.messages import MissionAction, MissionPhase, Mode
from tests.actors.osmosis.control.world import full_sweep
from tests.actors.osmosis.driven_robot import Driven, driven
from tests.osmosis_system import in_system, shipped_system
from tests.virtual_time import within

AIRPORT = load_airport("vallombre")
START = AIRPORT.start
DOWN = m.Goal(-29.5, -3.0, Mode.TAXI)
ROW = m.Goal(-22.0, -18.5, Mode.TAXI)
STANDING = 0.02


class Operator:
    """Who orders, and what is heard of the mission."""

    def __init__(self, robot: Driven) -> None:
        self.robot = robot
        self.heard = robot.system.hear(topics.MISSION_STATUS)
        self.routes = robot.system.hear(topics.ROUTE)
        self.answers = robot.system.hear(topics.MISSION_ORDER_ANSWER)
        self._orders = 0

    @property
    def status(self) -> m.MissionStatus:
        return self.heard[-1].message

    @property
    def phases(self) -> list[str]:
        return [phase for phase, _ in groupby(h.message.phase.value for h in self.heard)]

    @property
    def place(self) -> tuple[float, float]:
        return self.robot.truth.pose.x_m, self.robot.truth.pose.y_m

    def ask(self, action: MissionAction, reason: str = "a reason") -> None:
        self._orders += 1
        self.robot.system.say(topics.MISSION_ORDER, m.MissionOrder(
            f"o{self._orders}", action, reason, "operator"))

    async def until(self, phase: MissionPhase, within_s: float) -> None:
        await self.robot.until(lambda: self.status.phase is phase, within_s)


@asynccontextmanager
async def under_way(system: str = "osmosis") -> AsyncIterator[Operator]:
    """A shipped system five seconds into a mission, and its operator."""
    async with driven(system) as robot:
        operator = Operator(robot)
        robot.system.say(topics.MISSION_REQUEST, m.MissionRequest("m1", "test", (DOWN, ROW)))
        await asyncio.sleep(5.0)
        yield operator


@within(partial(under_way, "paper"))
async def test_the_robot_obeys_each_order(operator):
    robot = operator.robot
    operator.ask(MissionAction.PAUSE, "aircraft passing")
    await asyncio.sleep(1.5)
    where = operator.place
    await asyncio.sleep(2.0)
    assert operator.place == pytest.approx(where, abs=0.01)
    assert operator.status.phase is MissionPhase.PAUSED
    assert operator.status.reason == "operator: aircraft passing"
    operator.ask(MissionAction.PAUSE)
    operator.ask(MissionAction.RESUME)
    await robot.until(lambda: robot.speed_mps > 0.5)
    assert [answer.message.accepted for answer in operator.answers] == [True, False, True]
    operator.ask(MissionAction.REPLAN)
    await asyncio.sleep(0.5)
    assert operator.routes[-1].message.plan == operator.answers[-1].message.plan == 1
    assert robot.speed_mps > 0.3, "without a stop"
    operator.ask(MissionAction.SKIP, "closed")
    await asyncio.sleep(1.0)
    assert (operator.status.step, operator.status.skipped) == (1, (0,))
    operator.ask(MissionAction.CANCEL, "enough")
    await asyncio.sleep(1.5)
    assert robot.speed_mps < STANDING
    assert operator.status.phase is MissionPhase.CANCELLED


@within(under_way)
async def test_home(operator):
    """The turn on the spot, in which the wheels slip, is held against no position (DM1)."""
    robot = operator.robot
    await asyncio.sleep(6.0)
    operator.ask(MissionAction.HOME, "rain")
    await operator.until(MissionPhase.CANCELLED, 60)
    assert operator.phases == ["running", "returning home", "cancelled"]
    assert operator.status.reason == "returned home, operator: rain"
    assert math.dist(operator.place, (START.x_m, START.y_m)) < 1.1
    await asyncio.sleep(1.0)
    assert robot.speed_mps < STANDING


@within(under_way)
async def test_the_operator_drives_elsewhere_and_hands_back_and_the_mission_goes_on_from_there(
        operator):
    robot = operator.robot
    robot.system.inject(topics.POSE, "drop", 12.0)
    await asyncio.sleep(5.0)
    assert robot.speed_mps < STANDING
    assert operator.status.reason.startswith("held by RM5: DM6: localization not updated")
    operator.ask(MissionAction.RESUME)
    await asyncio.sleep(0.2)
    assert "continues when the robot is released" in operator.answers[-1].message.reason
    where = operator.place
    robot.hold(0.0, 1.0)
    await asyncio.sleep(1.5)
    robot.hold(0.8)
    await asyncio.sleep(4.0)
    assert math.dist(where, operator.place) > 1.0
    assert operator.status.phase is MissionPhase.PAUSED
    robot.let_go()
    routes = len(operator.routes)
    await operator.until(MissionPhase.RUNNING, 10)
    await asyncio.sleep(1.0)
    anew = operator.routes[routes:][-1].message
    assert anew.active
    assert math.dist(anew.waypoints[0], operator.place) < 2.5, "planned from where it is now"
    await robot.until(lambda: robot.speed_mps > 0.5)
    assert operator.phases == ["running", "paused", "running"]


async def stand(system, first: int, last: int) -> None:
    """Let Osmosis Control have its inputs while the robot stands at the start."""
    for i in range(first, last):
        system.say(topics.POSE, m.Pose(START.x_m, START.y_m, START.yaw_rad))
        system.say(topics.SCAN, full_sweep(number=i))
        await asyncio.sleep(0.05)


WAY = ((START.x_m, START.y_m), (START.x_m, START.y_m - 8.0))
ACROSS = (WAY[0], (20.0, 5.0), WAY[1])


@pytest.mark.parametrize("step", [0, 1])
@in_system(system=shipped_system(), airport=AIRPORT)
async def test_a_wrong_route_is_refused_and_a_good_one_for_the_same_goal_driven_on(system, step):
    commands, told = system.hear(topics.COMMAND), system.hear(topics.CONTROL_STATUS)
    system.start("control", OsmosisControl, check_route=True)
    await system.settle()
    await stand(system, 0, 2)
    system.say(topics.ROUTE, m.Route("m1", 0, Mode.TAXI, True, WAY, ""))
    await stand(system, 2, 30)
    system.say(topics.ROUTE, m.Route("m1", step, Mode.TAXI, True, ACROSS, ""))
    await stand(system, 30, 60)
    status, command = told[-1].message, commands[-1].message
    assert "crosses the prohibited area" in status.reason
    assert (status.phase, status.step) == (
        (m.ControlPhase.FOLLOWING, 0) if step == 0 else (m.ControlPhase.REFUSED, 1))
    assert (command.linear_mps > 0.2) is (step == 0)


@in_system(system=shipped_system(), airport=AIRPORT)
async def test_a_route_to_another_goal_is_refused_until_that_is_the_goal(system):
    told = system.hear(topics.CONTROL_STATUS)
    system.start("control", OsmosisControl, check_route=True)
    await system.settle()
    system.say(topics.GOAL, m.GoalOrder("m1", 0, DOWN, True))
    system.say(topics.ROUTE, m.Route("m1", 0, Mode.TAXI, True, WAY, ""))
    for phase in (m.ControlPhase.REFUSED, m.ControlPhase.FOLLOWING):
        await stand(system, 0, 10)
        assert told[-1].message.phase is phase
        system.say(topics.GOAL, m.GoalOrder("m1", 0, m.Goal(*WAY[1], Mode.TAXI), True))
