"""What recovery modules act upon, played by small actors: base, pilot, supervisor, manager."""

from __future__ import annotations

import asyncio
from itertools import groupby

from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.control.pilot.safety_gate import Checks, GateLimits, SafetyGate
from rampart.actors.runtime.actor import Actor, Context, Header, every, on
from rampart.testing import VirtualSystem


class Boss:
    """Sends the given commands to recovery modules, and keeps their reports."""

    def __init__(self, system: VirtualSystem) -> None:
        self.system = system
        self.reports = system.hear(ftm_topics.RECOVERY)

    @property
    def phases(self) -> list[str]:
        """Phases in sequence, repetitions left out."""
        return [phase for phase, _ in groupby(r.message.phase.value for r in self.reports)]

    def order(self, recovery: str, decision: int = 1, nodes: tuple[str, ...] = (),
              reason: str = "a fault") -> None:
        self._command(recovery, fm.RecoveryCommand(True, decision, nodes, reason))

    def release(self, recovery: str, decision: int = 2) -> None:
        self._command(recovery, fm.RecoveryCommand(False, decision, (), "gone"))

    def _command(self, recovery: str, command: fm.RecoveryCommand) -> None:
        self.system.say(ftm_topics.RECOVERY_COMMAND, command, "boss", member=recovery)


class Base(Actor):
    """A Summit XL layer: brake and status. `deaf`: it ignores orders."""

    outputs = (topics.BASE_STATUS,)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.holders: set[str] = set()
        self.deaf = False
        self.orders: list[bool] = []

    @property
    def engaged(self) -> bool:
        return bool(self.holders)

    @on(topics.BRAKE)
    def brake(self, message: m.BrakeCommand, header: Header) -> None:
        self.orders.append(message.engaged)
        if not self.deaf:
            (self.holders.add if message.engaged else self.holders.discard)(header.source)

    @every(0.1)
    def status(self) -> None:
        self.publish(topics.BASE_STATUS, m.BaseStatus(self.engaged, False, 0.0, (0.0,) * 4))


class Pilot(Actor):
    """A Safety Pilot, of which only the orders are there; it may tell of no bound."""

    outputs = (topics.PILOT_STATUS,)
    tells_bound = True

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.gate = SafetyGate(GateLimits(), Checks(), 0.0)
        self.heard = 0

    @on(topics.PILOT_ORDER)
    def order(self, message: m.PilotOrder, header: Header) -> None:
        self.heard += 1
        self.gate.order(header.source, message)
        self.status()

    @every(0.2)
    def status(self) -> None:
        self.publish(topics.PILOT_STATUS, m.PilotStatus(
            self.gate.mode, False, "", 0, self.gate.top_speed_mps if self.tells_bound else 0.0))


class Node(Actor):
    """A node that does nothing but beat."""


class Supervisor(Actor):
    """Respawns what it is asked to, after `delay_s`; `answer` is what it says then."""

    outputs = (ftm_topics.PROCESS_EVENT,)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.answer = "respawned"
        self.delay_s = 0.05
        self.requests: list[fm.RespawnRequest] = []
        self.tasks: list[asyncio.Task[None]] = []

    @on(ftm_topics.RESPAWN)
    def respawn(self, message: fm.RespawnRequest, _header: Header) -> None:
        self.requests.append(message)
        life = self.around.incarnations.get(message.node, 0)
        alive = message.node in self.around.tasks
        if self.answer == "nothing":
            return
        if self.answer != "respawned":
            self._say(message, self.answer, life)
        elif alive and life > message.failed_incarnation:
            self._say(message, "respawned", life)
        else:
            self.tasks.append(asyncio.create_task(self._replace(message, alive)))

    async def _replace(self, message: fm.RespawnRequest, alive: bool) -> None:
        if alive:
            await self.around.kill(message.node)
        await asyncio.sleep(self.delay_s)
        if message.node not in self.around.tasks:
            self.around.start(message.node, Node)
        self._say(message, "respawned", self.around.incarnations[message.node])

    def _say(self, message: fm.RespawnRequest, event: str, incarnation: int) -> None:
        self.publish(ftm_topics.PROCESS_EVENT, fm.ProcessEvent(
            message.node, event, 1, incarnation, message.by, ""))
