"""Recoveries that hold an order in force: the forward recoveries RM1, RM2 and RM5.

They act by giving an order to another node and repeating it, have acted when that node's status
confirms it, and then stay: the robot is in a degraded mode until they are released.

The confirmation may be lost again, when the node that obeyed is respawned. The order is then
given again at once, and only if the status does not come round within the deadline is that a
failure.
"""

from __future__ import annotations

import math

from rampart.actors.ftm.messages import RecoveryCommand, RecoveryPhase
from rampart.actors.recovery.module import RecoveryModule
from rampart.actors.runtime.actor import Context

_FAREWELLS = 5
"""How often the end of an order is said: one second long, for whoever is being respawned."""


class HoldingRecovery(RecoveryModule):
    """A recovery that keeps an order in force while it is activated."""

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.why = ""
        self._farewells = 0
        self._lost_s = math.inf
        self._inherits = context.incarnation > 1

    def give_order(self, *, engaged: bool) -> None:
        """Publish the order, or its end."""
        raise NotImplementedError

    def act(self, command: RecoveryCommand, *, renewed: bool) -> None:
        """Give the order, unless it is in force already."""
        self._farewells = 0
        self._inherits = False
        self.why = command.reason
        if self.phase is not RecoveryPhase.DEGRADED:
            self.give_order(engaged=True)
        if renewed and self.phase is RecoveryPhase.FAILED:
            self.resume(command.reason)

    def let_go(self) -> None:
        """End the order."""
        self._lost_s = math.inf
        self._farewells = _FAREWELLS
        self.give_order(engaged=False)

    def stay_idle(self) -> None:
        """End an order that an earlier life of this module may have left behind."""
        if self._inherits:
            self._inherits = False
            self.let_go()

    def repeat(self) -> None:
        """Repeat the order while it is in force, and a while its end."""
        if self.activated:
            self.give_order(engaged=True)
        elif self._farewells > 0:
            self._farewells -= 1
            self.give_order(engaged=False)

    def status(self, *, in_force: bool, reason: str, stamp_s: float) -> None:
        """Take note of whether the order is obeyed.

        Args:
            in_force: whether it is.
            reason: in words.
            stamp_s: when that was true; what was true before the order says nothing.
        """
        if not self.activated or stamp_s < self.ordered_s:
            return
        if in_force:
            self._lost_s = math.inf
            self.degrade(reason)
        elif self.phase is RecoveryPhase.DEGRADED:
            self._lost_s = min(self._lost_s, stamp_s)
            if stamp_s - self._lost_s > self.deadline_s:
                self.fail(f"no longer in force: {reason}")
            else:
                self.give_order(engaged=True)
