"""A robot that is to go home: the mission is given up, and the robot drives to where it began.

Not among the paper's recoveries. It is what a robot may do that nobody can reach any more
(`rampart.actors.detection.link_lost`): it neither goes on unwatched nor stays where it is. Like RM6
it asks the Mission Manager, who knows whether there is a mission and where it began.
"""

from __future__ import annotations

import math

from rampart.actors.ftm.messages import RecoveryCommand, RecoveryPhase
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.messages import (
    MissionAction,
    MissionOrder,
    MissionOrderAnswer,
    MissionPhase,
    MissionStatus,
)
from rampart.actors.recovery.module import RecoveryModule
from rampart.actors.runtime.actor import Context, Header, on


class ReturnHome(RecoveryModule):
    """Orders `home`, and sees to it that the robot drives nowhere else while the cause lasts.

    Where no mission is under way there is nothing to bring home. A mission that begins, or goes on,
    in the meantime is ordered home as well. When the cause is gone the robot still drives home: an
    operator who wants something else can say so then. It fails if by its deadline the Mission
    Manager has not answered, or refuses still, as it does until it knows where the mission began.
    """

    outputs = (*RecoveryModule.outputs, topics.MISSION_ORDER)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._why = ""
        self._given, self._asked_s = 0, -math.inf
        self._refused = ""
        self._order: MissionOrder | None = None

    def act(self, command: RecoveryCommand, *, renewed: bool) -> None:
        """Ask, and again what was refused."""
        self._why = command.reason
        if self.phase is RecoveryPhase.FAILED and renewed:
            self.resume(self._why)
        if self.phase is RecoveryPhase.ACTING and self._order is None:
            self._ask()

    def let_go(self) -> None:
        """Ask for nothing any more."""
        self._order = None

    def repeat(self) -> None:
        """Repeat what the Mission Manager has not answered; it takes it for one order."""
        if self._order is not None and self.phase is RecoveryPhase.ACTING:
            self.publish(topics.MISSION_ORDER, self._order)

    def unfinished(self) -> str:
        """Say what is missing."""
        return (f"refused: {self._refused}" if self._refused
                else "no answer from the Mission Manager")

    @on(topics.MISSION_ORDER_ANSWER)
    def answer(self, message: MissionOrderAnswer, _header: Header) -> None:
        """Hear whether the order is obeyed."""
        if self._order is None or message.order != self._order.order:
            return
        self._order, self._refused = None, message.reason
        if message.accepted:
            self.degrade("the robot drives home")

    @on(topics.MISSION_STATUS)
    def status(self, message: MissionStatus, header: Header) -> None:
        """See what became of it, and a mission that can be ordered home now."""
        if self.phase not in {RecoveryPhase.ACTING, RecoveryPhase.DEGRADED} \
                or header.stamp < self._asked_s:
            return
        if message.phase is MissionPhase.RETURNING:
            self.degrade("the robot drives home")
        elif MissionAction.CANCEL not in message.orders:
            self.degrade("no mission is under way")
        elif MissionAction.HOME in message.orders and self._order is None:
            self._ask()

    def _ask(self) -> None:
        self._given, self._asked_s, self._refused = self._given + 1, self.clock.now(), ""
        self._order = MissionOrder(
            f"{self.name}-{self.context.incarnation}-{self.decision}-{self._given}",
            MissionAction.HOME, self._why, self.name)
        if self.phase is not RecoveryPhase.ACTING:
            self.resume(self._why)
        self.publish(topics.MISSION_ORDER, self._order)
