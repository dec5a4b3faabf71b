"""A shipped robot in virtual time without a mission, and an operator with a stick."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from contextlib import asynccontextmanager
from typing import Any

from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.testing import VirtualSystem

STICK = "tool"
PERIOD_S = 0.05


class Driven:
    """A robot, and what its operator sees and does."""

    def __init__(self, system: VirtualSystem) -> None:
        self.system = system
        self._truth = system.hear(topics.TRUTH)
        self._manager = system.hear(ftm_topics.MANAGER_STATUS)
        self._stick: m.Joystick | None = None
        self._hand = asyncio.create_task(self._hold())

    async def _hold(self) -> None:
        while True:
            if self._stick is not None:
                self.system.say(topics.JOYSTICK, self._stick, STICK)
            await asyncio.sleep(PERIOD_S)

    def hold(self, forward: float, left: float = 0.0) -> None:
        self._stick = m.Joystick(forward, left, dead_man=True)

    def let_go(self) -> None:
        self._stick = None
        self.system.say(topics.JOYSTICK, m.Joystick(0.0, 0.0, dead_man=False), STICK)

    async def reset(self) -> None:
        """Release the emergency stop as soon as its cause is gone."""
        end_s = self.system.clock.now() + 10.0
        while "RM1" in self.manager.activated:
            assert self.system.clock.now() < end_s, "not released within 10 s"
            self.system.say(ftm_topics.RESET, fm.Reset("RM1", "tester"))
            await asyncio.sleep(0.2)

    async def restart(self, name: str, after_s: float = 0.3) -> None:
        await self.system.kill(name)
        await asyncio.sleep(after_s)
        self.system.start_node(name)

    @property
    def truth(self) -> m.GroundTruth:
        return self._truth[-1].message

    @property
    def speed_mps(self) -> float:
        return math.hypot(self.truth.twist.linear_mps, self.truth.twist.angular_radps)

    @property
    def manager(self) -> fm.ManagerStatus:
        return self._manager[-1].message

    async def until(self, condition: Callable[[], Any], within_s: float = 10.0) -> None:
        end_s = self.system.clock.now() + within_s
        while not condition():
            assert self.system.clock.now() < end_s, f"not within {within_s} s"
            await asyncio.sleep(PERIOD_S)

    async def fastest(self, seconds: float) -> float:
        """Return the highest speed over so many seconds."""
        highest = 0.0
        for _ in range(round(seconds / PERIOD_S)):
            await asyncio.sleep(PERIOD_S)
            highest = max(highest, self.speed_mps)
        return highest

    def end(self) -> None:
        self._hand.cancel()


@asynccontextmanager
async def driven(name: str = "paper", *, without: tuple[str, ...] = ()):
    """Start a shipped system; without a mission the robot stands and waits for its operator."""
    async with VirtualSystem.load(name, seed=1, waits=True) as system:
        robot = Driven(system)
        for node in system.layout.members:
            if node not in ("supervisor", *without):
                system.start_node(node)
        await asyncio.sleep(1.5)
        try:
            yield robot
        finally:
            robot.end()
