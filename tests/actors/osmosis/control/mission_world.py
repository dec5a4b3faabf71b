"""The control actors with the parameters of the full system, and whoever gives them orders."""

from __future__ import annotations

import asyncio
from typing import Any

from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.runtime.actor import Context, on
from rampart.sim.virtual.virtual_bus import VirtualBus
from tests.actors.osmosis.control.test_actors import NODES, Base, House, system
from tests.actors.osmosis.control.world import World

PARAMETERS: dict[str, dict[str, Any]] = {
    "mission_manager": {"held_by": ["RM1", "RM2", "RM5"]},
    "graph_planner": {"replan_after_s": 16.0},
    "osmosis_control": {"check_route": True, "pass_after_s": 5.0},
}


class Operator(Base):
    """The base of the control tests, with a hand on the joystick, on the orders and on RM5.

    `holding` is the recovery that the FTM Manager reports as activated; the Safety Pilot gets its
    order.
    """

    outputs = (*Base.outputs, topics.MISSION_ORDER, topics.GOAL)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.answers: list[m.MissionOrderAnswer] = []
        self.phases: list[str] = []
        self.holding: tuple[str, ...] = ()
        self._orders = 0

    def publish(self, topic, body, stamp=None, name=None):
        if topic is ftm_topics.MANAGER_STATUS:
            views = tuple(fm.DetectionView("DM6", True, "localization not updated", ())
                          for _ in self.holding)
            body = fm.ManagerStatus((), (), self.holding, (), "safety-first", 0, views)
        super().publish(topic, body, stamp, name)

    @on(topics.MISSION_STATUS)
    def mission(self, message, header):
        self.status = message
        if not self.phases or self.phases[-1] != message.phase.value:
            self.phases.append(message.phase.value)

    @on(topics.MISSION_ORDER_ANSWER)
    def answer(self, message, header):
        self.answers.append(message)

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


class FullHouse(House):
    """A house whose nodes have the full system's parameters."""

    base: Operator

    def start(self, name):
        self.lives[name] = self.lives.get(name, 0) + 1
        bus = VirtualBus(self.hub, name, self.lives[name])
        context = Context(name, self.lives[name], self.clock, bus, PARAMETERS.get(name, {}),
                          self.run)
        self.actors[name] = {**NODES, "base": Operator}[name](context)
        self.tasks[name] = asyncio.create_task(self.actors[name].run())


def full_house(world: World) -> FullHouse:
    return FullHouse(world, system())
