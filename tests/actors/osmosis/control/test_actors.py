"""The control actors together, on the virtual bus and virtual time, on the shipped airport."""

from __future__ import annotations

import asyncio
import math

import numpy as np
import pytest

from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.airport.photometry import illuminance_per_candela, sensor_position
from rampart.actors.osmosis.control.following.osmosis_control import OsmosisControl
from rampart.actors.osmosis.control.localization.localization import Localization
from rampart.actors.osmosis.control.mission.mission_manager import MissionManager
from rampart.actors.osmosis.control.pilot.safety_pilot import SafetyPilot
from rampart.actors.osmosis.control.planning.graph_planner import GraphPlanner
from rampart.actors.osmosis.control.polyline import wrap_angle
from rampart.actors.osmosis.control.teleoperation.teleoperation import Teleoperation
from rampart.actors.osmosis.messages import Mode
from rampart.actors.runtime.actor import Actor, Context, every, on
from rampart.actors.runtime.clock import Clock
from rampart.manager.spec.mobile_robot import Robot
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.spec.tables import Layers, Timing
from rampart.sim.virtual.virtual_bus import Hub, VirtualBus
from rampart.sim.virtual.virtual_loop import VirtualLoop
from tests.actors.osmosis.control.world import Circle, World
from tests.osmosis_system import run_context

AIRPORT = load_airport("vallombre")
BROKEN = {"A03": 0.0, "A06": 0.35, "A10": 0.0}


def system(**layers: bool) -> SystemSpec:
    robot = Robot(
        length_m=0.72, width_m=0.614, top_speed_mps=1.0, top_turn_rate_radps=2.0,
        hardware_speed_mps=3.0, acceleration_mps2=2.0, braking_mps2=2.0, stop_distance_m=0.8,
        lateral_distance_m=0.3, sensing_range_m=5.0, gps_accuracy_m=0.05,
        corridor_clearance_m=1.5)
    timing = Timing(command_timeout_s=0.9, manager_timeout_s=0.9, scan_timeout_s=0.5)
    return SystemSpec("test", "test", mobile=robot, timing=timing,
                      layers=Layers(**layers))


class Base(Actor):
    """Stands for the Summit XL layer and the FTM Manager's sign of life."""

    outputs = (topics.ABSOLUTE_POSE, topics.SCAN, topics.LIGHT, ftm_topics.MANAGER_STATUS,
               topics.MISSION_REQUEST, topics.PILOT_ORDER, topics.JOYSTICK, topics.COMMAND)
    world: World

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.command = m.BaseCommand(0.0, 0.0)
        self.status: m.MissionStatus | None = None
        self.pilot: m.PilotStatus | None = None
        self.routes: list[m.Route] = []
        self.commands = 0
        self.localized = True

    @on(topics.BASE_COMMAND)
    def base_command(self, message, header):
        self.command = message
        self.commands += 1

    @on(topics.MISSION_STATUS)
    def mission(self, message, header):
        self.status = message

    @on(topics.PILOT_STATUS)
    def pilot_status(self, message, header):
        self.pilot = message

    @on(topics.ROUTE)
    def route(self, message, header):
        if not self.routes or message != self.routes[-1]:
            self.routes.append(message)

    @every(0.05)
    def turn(self):
        world = self.world
        world.move(self.command.linear_mps, self.command.angular_radps)
        if self.localized:
            self.publish(topics.ABSOLUTE_POSE, m.Pose(
                world.x_m, world.y_m, wrap_angle(world.yaw_rad)))
        points = world.scan(rays=181, range_max_m=5.0)
        ranges = np.full(181, 5.0)
        where = np.round((np.arctan2(points[:, 1], points[:, 0]) + 0.75 * math.pi)
                         / (1.5 * math.pi / 180)).astype(int)
        ranges[where] = np.hypot(points[:, 0], points[:, 1])
        self.publish(topics.SCAN, m.LaserScan(
            -0.75 * math.pi, 1.5 * math.pi / 180, 5.0, ranges.astype("<f4").tobytes()))
        sensor = sensor_position(world.x_m, world.y_m, world.yaw_rad)
        self.publish(topics.LIGHT, m.LightSample(sum(
            BROKEN.get(li.name, 0.95) * li.nominal_cd * float(illuminance_per_candela(d))
            for li in AIRPORT.lights if (d := math.dist(sensor, (li.x_m, li.y_m))) < 6.0)))
        self.publish(ftm_topics.MANAGER_STATUS, fm.ManagerStatus((), (), (), (), "safety-first", 0))


NODES = {
    "mission_manager": MissionManager, "graph_planner": GraphPlanner,
    "osmosis_control": OsmosisControl, "safety_pilot": SafetyPilot,
    "localization": Localization, "teleoperation": Teleoperation, "base": Base,
}


class House:
    """All nodes as tasks; any can be killed and started again."""

    def __init__(self, world: World, spec: SystemSpec) -> None:
        self.hub = Hub()
        self.clock = Clock(0.0, 1.0, asyncio.get_running_loop().time)
        self.run = run_context(airport=AIRPORT, system=spec)
        self.lives: dict[str, int] = {}
        self.actors: dict[str, Actor] = {}
        self.tasks: dict[str, asyncio.Task] = {}
        for name in NODES:
            self.start(name)
        self.base = self.actors["base"]
        self.base.world = world

    def start(self, name):
        self.lives[name] = self.lives.get(name, 0) + 1
        bus = VirtualBus(self.hub, name, self.lives[name])
        context = Context(name, self.lives[name], self.clock, bus, {}, self.run)
        self.actors[name] = NODES[name](context)
        self.tasks[name] = asyncio.create_task(self.actors[name].run())

    async def kill(self, name):
        self.tasks[name].cancel()
        await asyncio.gather(self.tasks[name], return_exceptions=True)

    async def until(self, condition, timeout_s):
        end = self.clock.now() + timeout_s
        while not condition():
            for name, task in self.tasks.items():
                assert not task.done() or task.cancelled(), f"{name}: {task.exception()!r}"
            if self.clock.now() > end:
                return False
            await asyncio.sleep(0.1)
        return True

    def request(self, *goals, mission_id="m1"):
        self.base.publish(topics.MISSION_REQUEST, m.MissionRequest(mission_id, "test", goals))

    async def close(self):
        for task in self.tasks.values():
            task.cancel()
        await asyncio.gather(*self.tasks.values(), return_exceptions=True)


def play(scenario, world=None, **layers):
    """Run a scenario coroutine in virtual time; it gets a settled house."""
    async def run():
        house = House(world or World(AIRPORT.start.x_m, AIRPORT.start.y_m, AIRPORT.start.yaw_rad),
                      system(**layers))
        try:
            await asyncio.sleep(1.0)
            await scenario(house)
        finally:
            await house.close()

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        runner.run(run())


TO_ROW = m.Goal(-22.0, -18.5, Mode.TAXI)
ROW = m.Goal(23.5, -18.5, Mode.LIGHT_VERIFICATION)


def phase(house):
    return house.base.status.phase if house.base.status else m.MissionPhase.IDLE


def test_a_mission_is_driven_past_obstacles_and_every_light_is_judged_right():
    world = World(AIRPORT.start.x_m, AIRPORT.start.y_m, AIRPORT.start.yaw_rad,
                  circles=[Circle(-29.1, 0.4, 0.45), Circle(-28.9, -8.0, 0.4)])

    async def scenario(house):
        house.request(TO_ROW, ROW)
        assert await house.until(lambda: phase(house) is m.MissionPhase.SUCCEEDED, 180)
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
            house.start(name)
            await asyncio.sleep(0.2)
            assert house.base.world.y_m <= before + 0.1, "never back to the start"
        assert await house.until(lambda: phase(house) is m.MissionPhase.SUCCEEDED, 60)

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
        assert await house.until(lambda: phase(house) is m.MissionPhase.SUCCEEDED, 90)

    play(scenario)


def test_no_way_fails_the_mission_and_the_robot_stays():
    async def scenario(house):
        house.request(m.Goal(500.0, 0.0, Mode.TAXI))
        assert await house.until(lambda: phase(house) is m.MissionPhase.FAILED, 5)
        assert "from the graph" in house.base.status.reason
        assert house.base.command == m.BaseCommand(0.0, 0.0)

    play(scenario)
