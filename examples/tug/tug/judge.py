"""Verdict on a run of the tug: trailers delivered, nothing touched, never too fast."""

from __future__ import annotations

import math

from rampart import Header, Judge, Positive, Verdict, on
from tug import topics
from tug.floor import DOCK
from tug.topics import Truth


class Deliveries(Judge):
    """Success: all trailers delivered, and home. Safe: never too near, never too fast."""

    class Parameters(Judge.Parameters, frozen=True):
        """deliveries: number; nearest_m: smallest gap; fastest_mps: largest speed."""

        deliveries: int = 2
        nearest_m: Positive = 0.05
        fastest_mps: Positive = 1.3

    parameters: Parameters
    margins = {"gap": "to the nearest obstacle"}
    _gap_m: float | None = None
    _fastest_mps = 0.0
    _delivered, _home = 0, False
    _unsafe_s: float | None = None
    _narrowest_s: float | None = None

    @on(topics.TRUTH)
    def truth(self, message: Truth, header: Header) -> None:
        """Note the smallest gap and the largest speed."""
        if self._gap_m is None or message.clearance_m < self._gap_m:
            self._gap_m, self._narrowest_s = message.clearance_m, header.stamp
        self._fastest_mps = max(self._fastest_mps, abs(message.speed_mps))
        self._delivered = message.deliveries
        self._home = message.speed_mps < 0.02 and math.dist(DOCK, (message.x_m, message.y_m)) < 0.3
        if self._unsafe_s is None and self._wrong():
            self._unsafe_s = header.stamp

    def over(self, _now_s: float) -> str | None:
        """Return that the work is done."""
        return "all delivered, and home" if self._done() else None

    def verdict(self) -> Verdict:
        """Return the verdict so far."""
        wrong, done = self._wrong(), self._done()
        safe = None if self._gap_m is None else not wrong
        missed = () if done else (f"{self._delivered} delivered, at home: {self._home}",)
        return Verdict(success=done, safe=safe, reasons=(*wrong, *missed),
                       margins={"gap": self._gap_m}, severity=max(0.0, -(self._gap_m or 0.0)),
                       unsafe_s=self._unsafe_s, narrowest_s=self._narrowest_s)

    def _done(self) -> bool:
        return self._delivered >= self.parameters.deliveries and self._home

    def _wrong(self) -> tuple[str, ...]:
        limits, gap_m = self.parameters, self._gap_m
        near = gap_m is not None and gap_m < limits.nearest_m and f"a gap of {gap_m:.2f} m"
        fast = self._fastest_mps > limits.fastest_mps and f"{self._fastest_mps:.2f} m/s"
        return tuple(why for why in (near, fast) if why)
