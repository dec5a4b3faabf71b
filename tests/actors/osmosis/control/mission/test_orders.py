"""Orders to the Mission Manager, and the robot's truth in the mission's state: whole chains."""

from __future__ import annotations

import asyncio
import math

import pytest

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.messages import MissionAction, MissionPhase, Mode, PilotMode
from tests.actors.osmosis.control import house
from tests.actors.osmosis.control.house import AIRPORT

START = AIRPORT.start
DOWN = m.Goal(-29.5, -3.0, Mode.TAXI)
ROW = m.Goal(-22.0, -18.5, Mode.TAXI)


def play(scenario):
    house.play(scenario, DOWN, ROW)


def place(house):
    return house.base.world.x_m, house.base.world.y_m


def standing(house):
    return house.base.command == m.BaseCommand(0.0, 0.0)


def test_pause_and_resume():
    async def scenario(house, operator):
        operator.ask(MissionAction.PAUSE, "aircraft passing")
        await asyncio.sleep(1.5)
        assert standing(house)
        assert operator.status.phase is MissionPhase.PAUSED
        assert operator.status.reason == "operator: aircraft passing"
        where = place(house)
        await asyncio.sleep(5.0)
        assert place(house) == pytest.approx(where, abs=0.01)
        operator.ask(MissionAction.PAUSE)
        operator.ask(MissionAction.RESUME)
        await house.until(MissionPhase.SUCCEEDED, 90)
        assert [a.accepted for a in operator.answers] == [True, False, True]
        assert operator.answers[1].reason == (
            "the mission is already paused, operator: aircraft passing")

    play(scenario)


def test_home():
    async def scenario(house, operator):
        await asyncio.sleep(6.0)
        operator.ask(MissionAction.HOME, "rain")
        await house.until(MissionPhase.CANCELLED, 60)
        assert operator.phases == ["idle", "running", "returning home", "cancelled"]
        assert operator.status.reason == "returned home, operator: rain"
        assert math.dist(place(house), (START.x_m, START.y_m)) < 1.1
        await asyncio.sleep(1.0)
        assert standing(house)

    play(scenario)


def test_another_plan_then_the_next_goal_and_then_none():
    async def scenario(house, operator):
        operator.ask(MissionAction.REPLAN)
        await asyncio.sleep(0.5)
        assert operator.routes[-1].plan == operator.answers[-1].plan == 1
        assert operator.status.phase is MissionPhase.RUNNING
        assert operator.command.linear_mps > 0.3, "without a stop"
        operator.ask(MissionAction.SKIP, "closed")
        await asyncio.sleep(1.0)
        assert (operator.status.step, operator.status.skipped) == (1, (0,))
        operator.ask(MissionAction.CANCEL, "enough")
        await asyncio.sleep(1.5)
        assert standing(house)
        assert operator.status.phase is MissionPhase.CANCELLED

    play(scenario)


def test_the_operator_drives_elsewhere_and_hands_back_and_the_mission_goes_on_from_there():
    async def scenario(house, operator):
        operator.hold("RM5", PilotMode.TELEOPERATION)
        await asyncio.sleep(2.0)
        assert standing(house)
        assert operator.status.reason == "held by RM5: DM6: localization not updated"
        operator.ask(MissionAction.RESUME)
        await asyncio.sleep(0.2)
        assert "continues when the robot is released" in operator.answers[-1].reason
        where = place(house)
        for forward, left, ticks in ((0.0, 1.0, 60), (0.8, 0.0, 120)):
            for _ in range(ticks):
                operator.publish(topics.JOYSTICK, m.Joystick(forward, left, True))
                await asyncio.sleep(0.05)
        moved_m = math.dist(where, place(house))
        assert moved_m > 2.0
        assert operator.status.phase is MissionPhase.PAUSED
        operator.publish(topics.JOYSTICK, m.Joystick(0.0, 0.0, False))
        routes = len(operator.routes)
        operator.release()
        await asyncio.sleep(1.0)
        anew = operator.routes[routes:][-1]
        assert anew.active
        assert math.dist(anew.waypoints[0], place(house)) < 2.5, "planned from where it is now"
        await house.until(MissionPhase.SUCCEEDED, 120)
        assert operator.phases == ["idle", "running", "paused", "running", "succeeded"]

    play(scenario)


@pytest.mark.parametrize("step", [0, 1])
def test_a_wrong_route_is_refused_and_a_good_one_for_the_same_goal_driven_on(step):
    async def scenario(house, operator):
        control, good = house.actors["osmosis_control"], operator.routes[-1]
        await house.kill("graph_planner")
        bad = ((-29.0, 5.0), (20.0, 5.0), good.waypoints[-1])
        control.route(m.Route(good.mission_id, step, good.mode, True, bad, ""), None)
        await asyncio.sleep(1.5)
        told = control.core.status
        assert "crosses the prohibited area" in told.reason
        if step == good.step:
            assert told.phase is m.ControlPhase.FOLLOWING
            assert operator.command.linear_mps > 0.2
        else:
            assert (told.phase, told.step) == (m.ControlPhase.REFUSED, step)
            assert standing(house)

    play(scenario)
