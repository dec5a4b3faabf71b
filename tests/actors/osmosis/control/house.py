"""The control actors in virtual time on the shipped airport, and those around them, played."""

from __future__ import annotations

import asyncio
import math
from typing import Any

import numpy as np

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
from rampart.actors.runtime.actor import Actor, Context, every, on
from rampart.manager.spec.mobile_robot import Robot
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.spec.tables import Timing
from rampart.testing import eventually, run
from tests.actors.osmosis.control.world import World
from tests.osmosis_system import System

AIRPORT = load_airport("vallombre")
BROKEN = {"A03": 0.0, "A06": 0.35, "A10": 0.0}
SPEC = SystemSpec(
    "test", "test",
    mobile=Robot(
        length_m=0.72, width_m=0.614, top_speed_mps=1.0, top_turn_rate_radps=2.0,
        hardware_speed_mps=3.0, acceleration_mps2=2.0, braking_mps2=2.0, stop_distance_m=0.8,
        lateral_distance_m=0.3, sensing_range_m=5.0, gps_accuracy_m=0.05,
        corridor_clearance_m=1.5),
    timing=Timing(command_timeout_s=0.9, manager_timeout_s=0.9, scan_timeout_s=0.5))

FULL: dict[str, dict[str, Any]] = {
    "mission_manager": {"held_by": ["RM1", "RM2", "RM5"]},
    "graph_planner": {"replan_after_s": 16.0},
    "osmosis_control": {"check_route": True, "pass_after_s": 5.0},
}
"""Parameters of the full system."""


class Base(Actor):
    """Plays the Summit XL layer, the operator, and the FTM Manager.

    `holding` is the recovery that the FTM Manager reports as activated; the Safety Pilot gets its
    order.
    """

    outputs = (topics.ABSOLUTE_POSE, topics.SCAN, topics.LIGHT, ftm_topics.MANAGER_STATUS,
               topics.MISSION_REQUEST, topics.MISSION_ORDER, topics.PILOT_ORDER, topics.JOYSTICK)
    world: World

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.command = m.BaseCommand(0.0, 0.0)
        self.status: m.MissionStatus | None = None
        self.routes: list[m.Route] = []
        self.answers: list[m.MissionOrderAnswer] = []
        self.phases: list[str] = []
        self.holding: tuple[str, ...] = ()
        self._orders = 0

    @on(topics.BASE_COMMAND)
    def base_command(self, message, header):
        self.command = message

    @on(topics.MISSION_STATUS)
    def mission(self, message, header):
        self.status = message
        if self.phases[-1:] != [message.phase.value]:
            self.phases.append(message.phase.value)

    @on(topics.MISSION_ORDER_ANSWER)
    def answer(self, message, header):
        self.answers.append(message)

    @on(topics.ROUTE)
    def route(self, message, header):
        if not self.routes or message != self.routes[-1]:
            self.routes.append(message)

    @every(0.05)
    def turn(self):
        world = self.world
        world.move(self.command.linear_mps, self.command.angular_radps)
        self.publish(topics.ABSOLUTE_POSE, m.Pose(world.x_m, world.y_m, wrap_angle(world.yaw_rad)))
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
        views = tuple(fm.DetectionView("DM6", True, "localization not updated", ())
                      for _ in self.holding)
        self.publish(ftm_topics.MANAGER_STATUS, fm.ManagerStatus(
            (), (), self.holding, (), "safety-first", 0, views))

    def ask(self, action: m.MissionAction, reason: str = "a reason") -> None:
        self._orders += 1
        self.publish(topics.MISSION_ORDER, m.MissionOrder(
            f"o{self._orders}", action, reason, "operator"))

    def hold(self, recovery: str, mode: m.PilotMode) -> None:
        self.holding = (recovery,)
        self.publish(topics.PILOT_ORDER, m.PilotOrder(True, mode, "DM6"), name=recovery)

    def release(self) -> None:
        for recovery in self.holding:
            self.publish(topics.PILOT_ORDER, m.PilotOrder(False, m.PilotMode.STOP, ""),
                         name=recovery)
        self.holding = ()


NODES = {
    "mission_manager": MissionManager, "graph_planner": GraphPlanner,
    "osmosis_control": OsmosisControl, "safety_pilot": SafetyPilot,
    "localization": Localization, "teleoperation": Teleoperation, "base": Base,
}


class House(System):
    """All nodes; any can be killed and started again."""

    def __init__(self, world: World, parameters: dict[str, dict[str, Any]]) -> None:
        super().__init__(airport=AIRPORT, system=SPEC)
        self.parameters = parameters
        for name in NODES:
            self.revive(name)
        self.base = self.actors["base"]
        self.base.world = world

    def revive(self, name: str) -> None:
        self.start(name, NODES[name], **self.parameters.get(name, {}))

    def request(self, *goals: m.Goal) -> None:
        self.base.publish(topics.MISSION_REQUEST, m.MissionRequest("m1", "test", goals))

    async def until(self, phase: m.MissionPhase, timeout_s: float) -> None:
        """Wait until the mission is in a phase."""
        await eventually(lambda: self.base.phases[-1:] == [phase.value], timeout_s,
                         f"not {phase.value} within {timeout_s} s")


def play(scenario, world=None, parameters=None):
    """Run a scenario coroutine in virtual time; it gets a settled house."""
    async def scene():
        start = AIRPORT.start
        async with House(world or World(start.x_m, start.y_m, start.yaw_rad),
                         parameters or {}) as house:
            await asyncio.sleep(1.0)
            await scenario(house)

    run(scene)
