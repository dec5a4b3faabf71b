"""Does the loop of a node turn that has fallen silent?

A node that publishes something each few milliseconds and is silent for three periods may hang. It
may as well wait for a processor, or its messages are lost on the way, as when a router dies. What
the kernel has counted of its main thread tells them apart (`Standstill`), so no silence is needed
that is longer than any lack of processor time or any failover of the bus, and nobody is blamed for
either. What hangs without standing still is found by its missing heartbeat.
"""

from __future__ import annotations

import math

from rampart.actors.machine.patience import PROOF_PERIODS, Standstill, Usage

PERIODS_SILENT = 2
"""After so many without a sign of life the process is looked at, again when a second look may prove
something (`PROOF_PERIODS`), and then twice a period."""


class LoopWatch:
    """One node's loop. Pure; all times are seconds of one clock, simulated ones as a rule.

    Args:
        least_period_s: what is published more often than this is judged as if it were not.

    Attributes:
        sign_s: when the last sign of life came; -inf before the first.
        look_s: when it is to be looked at next; infinite if it is not.
    """

    def __init__(self, least_period_s: float) -> None:
        self.sign_s = -math.inf
        self.look_s = math.inf
        self._least_s = least_period_s
        self._period_s = math.inf
        self._first = True
        self._standstill = Standstill()

    def sign(self, period_s: float, now_s: float) -> None:
        """Take note of a sign of life that comes with a period; of several the shortest counts."""
        period_s = max(period_s, self._least_s)
        if period_s <= self._period_s:
            self._period_s, self.sign_s = period_s, now_s
            self._first = True
            self._standstill.begin()
            self.look_s = now_s + PERIODS_SILENT * period_s

    def forget(self) -> None:
        """Begin anew: another process."""
        self.sign_s, self.look_s = -math.inf, math.inf
        self._period_s = math.inf
        self._standstill.begin()

    def give_up(self) -> None:
        """Look no more before the next sign of life."""
        self.look_s = math.inf

    def look(self, now_s: float, used: Usage) -> str:
        """Return in words how it hangs; "" if it may well turn.

        Args:
            now_s: Now.
            used: By its process so far.
        """
        first, self._first = self._first, False
        self.look_s = now_s + (PROOF_PERIODS if first else 0.5) * self._period_s
        return self._standstill.look(now_s, used, self._period_s)
