"""Orders that a recovery module keeps in force: what RM1, RM2, RM5 and RM8 have in common.

They act by giving an order to another node and repeating it, have acted when that node's status
confirms it, and then stay: the robot is in a degraded mode until they are released.

The confirmation may be lost again, when the node that obeyed is respawned. The order is then
given again at once, and only if the status does not come round within the deadline is that a
failure.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from rampart.actors.ftm.messages import RecoveryCommand, RecoveryPhase
from rampart.actors.recovery.module import RecoveryModule

_FAREWELLS = 5
"""How often the end of an order is said: one second long, for a node that is being respawned."""


class HeldOrder:
    """An order that is in force while its module is activated.

    Args:
        module: whose order it is; told of how it goes.
        give: publishes the order with its reason, or its end.
        inherits: an earlier incarnation of the module may have left an order behind.
    """

    def __init__(self, module: RecoveryModule, give: Callable[[bool, str], None], *,
                 inherits: bool) -> None:
        self._module = module
        self._give = give
        self._inherits = inherits
        self.why = ""
        self._farewells = 0
        self._lost_s = math.inf

    def act(self, command: RecoveryCommand, *, renewed: bool) -> None:
        """Give the order, unless it is in force already."""
        self._farewells = 0
        self._inherits = False
        self.why = command.reason
        if self._module.phase is not RecoveryPhase.DEGRADED:
            self._give(True, self.why)
        if renewed and self._module.phase is RecoveryPhase.FAILED:
            self._module.resume(command.reason)

    def let_go(self) -> None:
        """End the order."""
        self._lost_s = math.inf
        self._farewells = _FAREWELLS
        self._give(False, "")

    def stay_idle(self) -> None:
        """End an order that an earlier incarnation may have left behind."""
        if self._inherits:
            self._inherits = False
            self.let_go()

    def repeat(self) -> None:
        """Repeat the order while it is in force, and a while its end."""
        if self._module.activated:
            self._give(True, self.why)
        elif self._farewells > 0:
            self._farewells -= 1
            self._give(False, "")

    def status(self, *, in_force: bool, reason: str, stamp_s: float) -> None:
        """Take note of whether the order is obeyed.

        Args:
            in_force: whether it is.
            reason: in words.
            stamp_s: when that was true; what was true before the order says nothing.
        """
        module = self._module
        if not module.activated or stamp_s < module.ordered_s:
            return
        if in_force:
            self._lost_s = math.inf
            module.degrade(reason)
        elif module.phase is RecoveryPhase.DEGRADED:
            self._lost_s = min(self._lost_s, stamp_s)
            if stamp_s - self._lost_s > module.deadline_s:
                module.fail(f"no longer in force: {reason}")
            else:
                self._give(True, self.why)


class HeldRecovery(RecoveryModule):
    """A recovery that is nothing but such an order; a subclass sets it."""

    order: HeldOrder

    def act(self, command: RecoveryCommand, *, renewed: bool) -> None:
        """Give the order."""
        self.order.act(command, renewed=renewed)

    def let_go(self) -> None:
        """End it."""
        self.order.let_go()

    def stay_idle(self) -> None:
        """End what an earlier incarnation of this module may have left."""
        self.order.stay_idle()

    def repeat(self) -> None:
        """Repeat the order, or its end for a while."""
        self.order.repeat()
