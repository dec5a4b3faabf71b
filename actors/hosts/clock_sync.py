"""The offset of another host's clock, as an interval that certainly contains it.

A question sent at `sent_s` and answered by `received_s` was answered in between. So the remote
clock, which read `remote_s` then, is ahead by at least remote - received and by at most
remote - sent, whatever the network did. The intervals of several exchanges overlap if each is
widened by the drift since. The overlap is narrow as soon as one question and one answer, of any two
exchanges, were quick (Marzullo and Owicki, 1983). Without an overlap one of the clocks has jumped.
"""

from __future__ import annotations

from collections import deque

DRIFT = 2e-4
"""Seconds per second by which two clocks may drift apart: twice the error of a cheap crystal."""

_WINDOW = 60
"""Exchanges that count."""

_SLEW_S = 0.002
"""Largest correction per exchange, as long as the offset in use may be right."""


class ClockSync:
    """How far another host's monotonic clock is ahead of this one's.

    Args:
        tolerated_s: Error that readers of messages tolerate. A larger proven error is corrected at
            once, since readers would refuse every message of this host meanwhile.

    Attributes:
        offset_s: In use, seconds; moves slowly towards the middle of the interval.
        bound_s: Its largest possible error at the last exchange, if both clocks run evenly.
    """

    def __init__(self, tolerated_s: float = 0.1) -> None:
        self._tolerated_s = tolerated_s
        self.offset_s = 0.0
        self.bound_s = float("inf")
        self._exchanged_s = 0.0
        self._intervals: deque[tuple[float, float, float]] = deque(maxlen=_WINDOW)

    def add_exchange(self, sent_s: float, remote_s: float, received_s: float) -> None:
        """Take one exchange.

        Args:
            sent_s: This clock, when the question was sent.
            remote_s: The other clock, when it was answered.
            received_s: This clock, when the answer arrived.
        """
        drift_s = DRIFT * (received_s - sent_s)
        newest = (received_s, remote_s - received_s - drift_s, remote_s - sent_s + drift_s)
        self._intervals.append(newest)
        low_s = max(low_s - DRIFT * (received_s - at_s) for at_s, low_s, _ in self._intervals)
        high_s = min(high_s + DRIFT * (received_s - at_s) for at_s, _, high_s in self._intervals)
        if low_s > high_s:  # a clock has jumped
            self._intervals.clear()
            self._intervals.append(newest)
            _, low_s, high_s = newest
        step_s = (low_s + high_s) / 2 - self.offset_s
        is_wrong = not low_s - self._tolerated_s <= self.offset_s <= high_s + self._tolerated_s
        if len(self._intervals) > 1 and not is_wrong:
            step_s = min(max(step_s, -_SLEW_S), _SLEW_S)
        self.offset_s += step_s
        self.bound_s = max(high_s - self.offset_s, self.offset_s - low_s)
        self._exchanged_s = received_s

    def bound_at(self, now_s: float) -> float:
        """Return the largest possible error of the offset, some time after the last exchange."""
        return self.bound_s + DRIFT * (now_s - self._exchanged_s)
