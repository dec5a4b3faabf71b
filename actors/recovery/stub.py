"""Stand-in for a recovery module, which only takes time."""

from __future__ import annotations

from typing import Literal

from rampart.actors.ftm.messages import RecoveryCommand, RecoveryPhase
from rampart.actors.recovery.module import RecoveryModule
from rampart.actors.runtime.actor import Context
from rampart.actors.runtime.timer import Timer
from rampart.manager.spec.tables import NonNegative


class StubRecovery(RecoveryModule):
    """Acts for a while, and then ends as its parameters specify."""

    class Parameters(RecoveryModule.Parameters, frozen=True):
        """Duration and result.

        Attributes:
            takes_s: time from order to end, s.
            ends: phase at the end.
        """

        takes_s: NonNegative = 0.1
        ends: Literal["degraded", "done", "failed"] = "degraded"

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._timer: Timer | None = None

    def act(self, command: RecoveryCommand, *, renewed: bool) -> None:  # noqa: ARG002
        """Begin, unless it acts already."""
        if renewed or (self.phase is RecoveryPhase.ACTING and self._timer is None):
            self._timer = self.call_later(self.parameters.takes_s, self._finish)

    def let_go(self) -> None:
        """End."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _finish(self) -> None:
        self._timer = None
        if self.phase is RecoveryPhase.ACTING:
            ends = RecoveryPhase(self.parameters.ends)
            self._end(ends, "as its parameters specify" if ends is RecoveryPhase.FAILED else "")
