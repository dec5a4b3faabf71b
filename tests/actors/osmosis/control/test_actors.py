"""The control actors together, on the virtual bus and virtual time, on the shipped airport."""

from __future__ import annotations

import asyncio

import pytest

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.messages import MissionPhase, Mode
from tests.actors.osmosis.control.house import AIRPORT, BROKEN, play
from tests.actors.osmosis.control.world import Circle, World

TO_ROW = m.Goal(-22.0, -18.5, Mode.TAXI)
ROW = m.Goal(23.5, -18.5, Mode.LIGHT_VERIFICATION)


def test_a_mission_is_driven_past_obstacles_and_every_light_is_judged_right():
    world = World(AIRPORT.start.x_m, AIRPORT.start.y_m, AIRPORT.start.yaw_rad,
                  circles=[Circle(-29.1, 0.4, 0.45), Circle(-28.9, -8.0, 0.4)])

    async def scenario(house):
        house.request(TO_ROW, ROW)
        await house.until(MissionPhase.SUCCEEDED, 180)
        status = house.base.status
        assert [li.light for li in status.lights] == [f"A{i:02d}" for i in range(1, 12)]
        for found in status.lights:
            factor = BROKEN.get(found.light, 0.95)
            assert found.ratio == pytest.approx(factor, abs=0.06)
        assert len(status.step_times_s) == 2
        assert world.least_clearance_m >= 0.25
        assert min(AIRPORT.prohibited_distance_m(x, y) for x, y in world.track) > 1.0
        routes = [r for r in house.base.routes if r.active]
        assert [r.step for r in routes] == [0, 1], "one route a step, never a needless other"
        assert len(routes[1].waypoints) == 2, "a straight row"

    play(scenario, world)


def test_planner_control_and_pilot_may_die_in_the_middle_and_the_mission_goes_on():
    async def scenario(house):
        house.request(TO_ROW)
        for name in ("osmosis_control", "graph_planner", "safety_pilot", "localization"):
            await asyncio.sleep(6.0)
            before = house.base.world.y_m
            await house.kill(name)
            await asyncio.sleep(0.3)
            house.revive(name)
            await asyncio.sleep(0.2)
            assert house.base.world.y_m <= before + 0.1, "never back to the start"
        await house.until(MissionPhase.SUCCEEDED, 60)

    play(scenario)


def test_the_joystick_pre_empts_and_hands_back():
    async def scenario(house):
        house.request(TO_ROW)
        await asyncio.sleep(5.0)
        for _ in range(20):
            house.base.publish(topics.JOYSTICK, m.Joystick(0.0, 0.25, True))
            await asyncio.sleep(0.055)  # a control period, and a little for the way
            assert house.base.command == m.BaseCommand(0.0, 0.5)
        house.base.publish(topics.JOYSTICK, m.Joystick(0.0, 0.0, False))
        await house.until(MissionPhase.SUCCEEDED, 90)

    play(scenario)


def test_no_way_fails_the_mission_and_the_robot_stays():
    async def scenario(house):
        house.request(m.Goal(500.0, 0.0, Mode.TAXI))
        await house.until(MissionPhase.FAILED, 5)
        assert "from the graph" in house.base.status.reason
        assert house.base.command == m.BaseCommand(0.0, 0.0)

    play(scenario)
