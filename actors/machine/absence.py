"""Absence of an observer: a process that did not run itself cannot know what was missing.

A process that was stopped and continues finds every deadline passed. The same holds for all
processes of a container that was paused. But messages wait unread, other processes continue a
little later, and links have to be opened again. So an observer draws no conclusion from the time of
its absence, nor for `GRACE_S` after it.
"""

from __future__ import annotations

import math

ABSENT_S = 0.3
"""An observer that acts at least every 0.2 s was stopped if it has not acted for this long."""

GRACE_S = 1.0
"""Time in which all other processes continue, and send. Links within a host outlast a pause (see
`rampart.actors.bus.zenoh_session`)."""

AGAIN_S = 2.0
"""Least time to the next absence that counts, so an observer that is always late has no excuse."""


class Absence:
    """The absence of one observer. Pure; times are seconds of the caller's clock.

    Args:
        now_s: Now.
        rate: Seconds of that clock per real second: other processes need real time to continue.
    """

    def __init__(self, now_s: float, rate: float = 1.0) -> None:
        self._ran_s = now_s
        self._rate = max(1.0, rate)
        self._until_s = -math.inf

    def note(self, now_s: float) -> float:
        """Note that the observer runs; return how long it was absent, 0 if it was not."""
        gap_s, self._ran_s = now_s - self._ran_s, now_s
        if gap_s <= ABSENT_S or now_s <= self._until_s + AGAIN_S * self._rate:
            return 0.0
        self._until_s = now_s + GRACE_S * self._rate
        return gap_s

    def excuses(self, now_s: float) -> bool:
        """Whether the observer may not draw conclusions yet."""
        return now_s < self._until_s

    @property
    def until_s(self) -> float:
        """When it may draw conclusions again."""
        return self._until_s
