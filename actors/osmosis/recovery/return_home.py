"""Return home: the mission is cancelled, and the robot drives to its start.

It is not among the paper's recoveries. With `rampart.actors.detection.link_lost` it brings home a
robot that no operator can reach. Like RM6 it sends an order to the Mission Manager.
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
    """Orders `home`, also for a mission that begins or continues while the cause lasts.

    Without a mission there is nothing to do. When the cause is gone, the robot still drives home
    until an operator gives another order. It fails at its deadline if the Mission Manager has not
    answered or still refuses, as it does until the start of the mission is known.
    """

    outputs = (*RecoveryModule.outputs, topics.MISSION_ORDER)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._why = ""
        self._given, self._asked_s = 0, -math.inf
        self._refused = ""
        self._order: MissionOrder | None = None

    def act(self, command: RecoveryCommand, *, renewed: bool) -> None:
        """Send the order, again after a refusal."""
        self._why = command.reason
        if self.phase is RecoveryPhase.FAILED and renewed:
            self.resume(self._why)
        if self.phase is RecoveryPhase.ACTING and self._order is None:
            self._ask()

    def let_go(self) -> None:
        """Drop the order."""
        self._order = None

    def repeat(self) -> None:
        """Repeat an unanswered order, which counts once by its id."""
        if self._order is not None and self.phase is RecoveryPhase.ACTING:
            self.publish(topics.MISSION_ORDER, self._order)

    def unfinished(self) -> str:
        """Return what is missing."""
        return (f"refused: {self._refused}" if self._refused
                else "no answer from the Mission Manager")

    @on(topics.MISSION_ORDER_ANSWER)
    def answer(self, message: MissionOrderAnswer, _header: Header) -> None:
        """Take the answer."""
        if self._order is None or message.order != self._order.order:
            return
        self._order, self._refused = None, message.reason
        if message.accepted:
            self.degrade("the robot drives home")

    @on(topics.MISSION_STATUS)
    def status(self, message: MissionStatus, header: Header) -> None:
        """Follow the mission, and order home one that can be now."""
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
