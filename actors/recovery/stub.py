"""A recovery module that takes its time and does nothing."""

from __future__ import annotations

from rampart.actors.ftm.messages import RecoveryCommand, RecoveryPhase
from rampart.actors.recovery.module import RecoveryModule
from rampart.actors.runtime.actor import Context
from rampart.actors.runtime.parameters import amount
from rampart.actors.runtime.timer import Timer


class StubRecovery(RecoveryModule):
    """Acts for a while, and then reports what its parameters say.

    Parameters:
        takes_s: from order to end, seconds; default 0.1.
        ends: "degraded" (default), "done" or "failed".
    """

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._takes_s = amount(self.parameters, "takes_s", 0.1)
        self._ends = RecoveryPhase(self.parameters.get("ends", RecoveryPhase.DEGRADED))
        self._timer: Timer | None = None

    def act(self, command: RecoveryCommand, *, renewed: bool) -> None:  # noqa: ARG002
        """Begin, unless it is under way."""
        if renewed or (self.phase is RecoveryPhase.ACTING and self._timer is None):
            self._timer = self.call_later(self._takes_s, self._finish)

    def let_go(self) -> None:
        """End."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _finish(self) -> None:
        self._timer = None
        if self.phase is not RecoveryPhase.ACTING:
            return
        if self._ends is RecoveryPhase.DONE:
            self.succeed()
        elif self._ends is RecoveryPhase.FAILED:
            self.fail("its parameters say so")
        else:
            self.degrade()
