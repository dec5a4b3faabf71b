"""What time it is on another host: an interval that certainly holds the offset of two clocks.

A question that is sent at `asked_s` and whose answer comes at `heard_s` was answered in between: so
the other clock, which said `told_s` then, is ahead by at least told - heard and at most told -
asked, whatever the network did. The intervals of several questions have to overlap, each widened by
what the clocks may have drifted since; the overlap is narrow as soon as one question and one
answer, not necessarily of the same exchange, were quick (Marzullo and Owicki, 1983). Where they do
not overlap, one of the two clocks is wrong.
"""

from __future__ import annotations

from collections import deque

DRIFT = 2e-4
"""Seconds a second by which two clocks may drift apart: twice what a cheap crystal may be off."""

_KEPT = 60

_SLEW_S = 0.002
"""By which the clock in use is moved at most, for each exchange, while it may be right."""


class ClockSync:
    """How far another host's monotonic clock is ahead of this one's.

    Args:
        tolerated_s: An error that readers of messages tolerate. A larger one that is proven is put
            right at once: all that is stamped by that clock would be refused meanwhile.

    Attributes:
        offset_s: In use, seconds; moves slowly towards the middle of the interval.
        bound_s: By how much it may be wrong at most, if both clocks run evenly.
    """

    def __init__(self, tolerated_s: float = 0.1) -> None:
        self._tolerated_s = tolerated_s
        self.offset_s = 0.0
        self.bound_s = float("inf")
        self._kept: deque[tuple[float, float, float]] = deque(maxlen=_KEPT)

    def exchanged(self, asked_s: float, told_s: float, heard_s: float) -> None:
        """Take one exchange.

        Args:
            asked_s: This clock, when the question was sent.
            told_s: The other clock, when it was answered.
            heard_s: This clock, when the answer came.
        """
        drift_s = DRIFT * (heard_s - asked_s)  # it was told at some time in between
        self._kept.append((heard_s, told_s - heard_s - drift_s, told_s - asked_s + drift_s))
        low_s, high_s = self._overlap(heard_s)
        if low_s > high_s:
            newest = self._kept[-1]  # a clock has jumped
            self._kept.clear()
            self._kept.append(newest)
            low_s, high_s = newest[1:]
        middle_s = (low_s + high_s) / 2
        step_s = middle_s - self.offset_s
        is_wrong = not low_s - self._tolerated_s <= self.offset_s <= high_s + self._tolerated_s
        if len(self._kept) > 1 and not is_wrong:
            step_s = min(max(step_s, -_SLEW_S), _SLEW_S)
        self.offset_s += step_s
        self.bound_s = max(high_s - self.offset_s, self.offset_s - low_s)

    def bound_at(self, now_s: float) -> float:
        """Return by how much the offset may be wrong, a while after the last exchange."""
        if not self._kept:
            return self.bound_s
        return self.bound_s + DRIFT * (now_s - self._kept[-1][0])

    def _overlap(self, now_s: float) -> tuple[float, float]:
        return (max(low_s - DRIFT * (now_s - at_s) for at_s, low_s, _ in self._kept),
                min(high_s + DRIFT * (now_s - at_s) for at_s, _, high_s in self._kept))
