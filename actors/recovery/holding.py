"""Base of recoveries that keep an order in force: RM1, RM2, RM5 and RM8.

They give an order to another node and repeat it. When the status of that node confirms it, the
robot is in a degraded mode until the recovery is released.

If the node is respawned, the confirmation is lost. The order is then given again at once; it is a
failure only if it is not confirmed within the deadline.
"""

from __future__ import annotations

import math

from rampart.actors.ftm.messages import RecoveryCommand, RecoveryPhase
from rampart.actors.recovery.module import RecoveryModule
from rampart.actors.runtime.actor import Context

_ENDINGS = 5
"""Repetitions of the end of an order: one second, for a node that is being respawned."""


class HeldRecovery(RecoveryModule):
    """A recovery whose order is in force while the module is activated.

    A subclass gives the order in `give`, and calls `confirm` with each status of the other node.
    """

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.why = ""
        self._inherits = context.incarnation > 1  # an earlier incarnation may have left an order
        self._endings = 0
        self._lost_s = math.inf

    def give(self, in_force: bool, why: str) -> None:
        """Publish the order with its reason, or its end."""
        raise NotImplementedError

    def confirm(self, *, in_force: bool, reason: str, stamp_s: float) -> None:
        """Note whether the order is in force.

        Args:
            in_force: Whether it is.
            reason: For people.
            stamp_s: When that was true; a time before the order does not count.
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
                self.give(True, self.why)

    def act(self, command: RecoveryCommand, *, renewed: bool) -> None:
        """Give the order, unless it is in force already."""
        self._endings = 0
        self._inherits = False
        self.why = command.reason
        if self.phase is not RecoveryPhase.DEGRADED:
            self.give(True, self.why)
        if renewed and self.phase is RecoveryPhase.FAILED:
            self.resume(command.reason)

    def let_go(self) -> None:
        """End the order."""
        self._lost_s = math.inf
        self._endings = _ENDINGS
        self.give(False, "")

    def stay_idle(self) -> None:
        """End an order that an earlier incarnation may have left."""
        if self._inherits:
            self._inherits = False
            self.let_go()

    def repeat(self) -> None:
        """Repeat the order while it is in force, and then its end for a second."""
        if self.activated:
            self.give(True, self.why)
        elif self._endings > 0:
            self._endings -= 1
            self.give(False, "")
