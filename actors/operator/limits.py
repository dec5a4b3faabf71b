"""How many messages a page may send: a bucket that fills with time. Pure.

A page that drives and draws sends some 45 messages a second. One that sends far more is not used by
a person: it is told once, what is too much is dropped unread, and if it goes on it is closed.
"""

from __future__ import annotations

from enum import Enum

RATE_HZ = 100.0
"""Messages that a page may send each real second."""

BURST = 100
"""Messages that it may send at once after a pause."""

PATIENCE = 300
"""Messages too many after which it is closed; forgotten as fast as the bucket fills."""


class Verdict(Enum):
    """What to do with a message."""

    READ = "read"
    TELL = "drop it and say why"
    DROP = "drop it"
    CLOSE = "close the page"


class MessageBudget:
    """The messages of one page.

    Args:
        now_s: real seconds.
    """

    def __init__(self, now_s: float) -> None:
        self._filled_s = now_s
        self._left = float(BURST)
        self._excess = 0.0
        self._told = False

    def spend(self, now_s: float) -> Verdict:
        """Count a message that arrives now and say what to do with it."""
        gained = max(now_s - self._filled_s, 0.0) * RATE_HZ
        self._filled_s = max(now_s, self._filled_s)
        self._left = min(self._left + gained, BURST)
        self._excess = max(self._excess - gained, 0.0)
        if self._left >= 1.0:
            self._left -= 1.0
            self._told = self._told and self._excess > 0.0
            return Verdict.READ
        self._excess += 1.0
        if self._excess > PATIENCE:
            return Verdict.CLOSE
        if self._told:
            return Verdict.DROP
        self._told = True
        return Verdict.TELL
