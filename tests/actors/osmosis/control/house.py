"""The control actors in virtual time on the shipped airport, and those around them, played."""

from __future__ import annotations

import asyncio
from typing import Any

from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.control.following.osmosis_control import OsmosisControl
from rampart.actors.osmosis.control.localization.localization import Localization
from rampart.actors.osmosis.control.mission.mission_manager import MissionManager
from rampart.actors.osmosis.control.pilot.safety_pilot import SafetyPilot
from rampart.actors.osmosis.control.planning.graph_planner import GraphPlanner
from rampart.actors.osmosis.control.polyline import wrap_angle
from rampart.actors.osmosis.control.teleoperation.teleoperation import Teleoperation
from rampart.actors.runtime.actor import Actor, Context, every, on
from rampart.testing import eventually, run
from tests.actors.osmosis.control.laser_sweeps import full_sweep
from tests.actors.osmosis.control.world import World
from tests.osmosis_system import System, shipped_system

AIRPORT = load_airport("vallombre")
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

    outputs = (topics.ABSOLUTE_POSE, topics.SCAN, ftm_topics.MANAGER_STATUS, topics.MISSION_REQUEST,
               topics.MISSION_ORDER, topics.PILOT_ORDER, topics.JOYSTICK)
    world: World

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.command = m.BaseCommand(0.0, 0.0)
        self.status: m.MissionStatus | None = None
        self.routes: list[m.Route] = []
        self.answers: list[m.MissionOrderAnswer] = []
        self.phases: list[str] = []
        self.holding: tuple[str, ...] = ()
        self._orders = self._sweeps = 0

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
        self._sweeps += 1
        self.publish(topics.SCAN, full_sweep(number=self._sweeps))
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
    """All nodes, with the parameters of the full system."""

    def __init__(self) -> None:
        super().__init__(airport=AIRPORT, system=shipped_system())
        for name, actor in NODES.items():
            self.start(name, actor, **FULL.get(name, {}))
        start, self.base = AIRPORT.start, self.actors["base"]
        self.base.world = World(start.x_m, start.y_m, start.yaw_rad)

    async def until(self, phase: m.MissionPhase, timeout_s: float) -> None:
        """Wait until the mission is in a phase."""
        await eventually(lambda: self.base.phases[-1:] == [phase.value], timeout_s,
                         f"not {phase.value} within {timeout_s} s")


def play(scenario, *goals: m.Goal) -> None:
    """Run a scenario coroutine in virtual time, five seconds into a mission."""
    async def scene():
        async with House() as house:
            await asyncio.sleep(1.0)
            house.base.publish(topics.MISSION_REQUEST, m.MissionRequest("m1", "test", goals))
            await asyncio.sleep(5.0)
            await scenario(house, house.base)

    run(scene)
