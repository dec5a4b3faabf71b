"""Verdict on a run of the warehouse robot."""

from __future__ import annotations

from rampart import Header, Judge, Verdict, on
from warehouse import topics
from warehouse.topics import Truth


class Rounds(Judge):
    """Success: a round of the rack. Safe: it touched nothing."""

    class Parameters(Judge.Parameters, frozen=True):
        """rounds: number of rounds for a success."""

        rounds: float = 1.0

    parameters: Parameters
    margins = {"clearance": "to wall or rack"}
    _clearance_m: float | None = None
    _rounds = 0.0
    _unsafe_s: float | None = None

    @on(topics.TRUTH)
    def truth(self, message: Truth, header: Header) -> None:
        """Note the smallest clearance."""
        self._clearance_m = (message.clearance_m if self._clearance_m is None
                             else min(message.clearance_m, self._clearance_m))
        self._rounds = message.rounds
        if message.clearance_m < 0 and self._unsafe_s is None:
            self._unsafe_s = header.stamp

    def over(self, _now_s: float) -> str | None:
        """Return that the work is done."""
        return "all rounds made" if self._rounds >= self.parameters.rounds else None

    def verdict(self) -> Verdict:
        """Return the verdict so far."""
        success = self._rounds >= self.parameters.rounds
        return Verdict(
            success=success, safe=None if self._clearance_m is None else self._unsafe_s is None,
            reasons=(*(["it touched something"] if self._unsafe_s is not None else []),
                     *([] if success else [f"{self._rounds:g} rounds"])),
            margins={"clearance": self._clearance_m},
            severity=max(0.0, -(self._clearance_m or 0.0)), unsafe_s=self._unsafe_s)
