"""Did the observer itself run? What did not run cannot say what was missing meanwhile.

A process that was stopped and goes on, alone or with everybody else as when a container is paused,
finds every deadline passed while the proof to the contrary is still under way: mail waits unread,
others go on a little later, links that were silent for too long are opened again. So an observer
that was absent draws no conclusion from that time, and none about others for `GRACE_S` after it.
"""

from __future__ import annotations

import math

ABSENT_S = 0.3
"""An observer that does something at least each 0.2 s and has not for so long was stopped."""

GRACE_S = 1.0
"""Within which the others go on as well, and are heard. Links within a host outlast a pause (see
`rampart.actors.bus.zenoh_session`), so this is the time in which all processes are continued."""

AGAIN_S = 2.0
"""Not sooner does the next absence count: one that is always late is not always excused."""


class Absence:
    """Of one observer. Pure; seconds of the caller's clock.

    Args:
        now_s: Now.
        rate: Seconds of that clock in a real one: the others need real time to go on.
    """

    def __init__(self, now_s: float, rate: float = 1.0) -> None:
        self._ran_s = now_s
        self._rate = max(1.0, rate)
        self._until_s = -math.inf

    def note(self, now_s: float) -> float:
        """Note that the observer runs; return for how long it was absent, 0 if it was not."""
        gap_s, self._ran_s = now_s - self._ran_s, now_s
        if gap_s <= ABSENT_S or now_s <= self._until_s + AGAIN_S * self._rate:
            return 0.0
        self._until_s = now_s + GRACE_S * self._rate
        return gap_s

    def excuses(self, now_s: float) -> bool:
        """Whether it may conclude nothing about others yet."""
        return now_s < self._until_s

    @property
    def until_s(self) -> float:
        """From when on it may."""
        return self._until_s
