"""What keeps a flood of messages from becoming a flood of memory or of lines.

Whatever a node remembers by a name that a message told it has room for so many names and no more,
and whatever it repeats to others leaves so many times a second. What is over the bound is counted,
and the owner of the bound reports the count: nothing disappears unseen.
"""

from __future__ import annotations

import math
from typing import Generic, TypeVar

K = TypeVar("K")
V = TypeVar("V")


class Remembered(Generic[K, V], dict[K, V]):
    """A dictionary with room for so many keys: with one more, the one put in first is forgotten.

    Only `[key] = value` looks at the room.

    Args:
        room: keys at most.

    Attributes:
        forgotten: how many there were no room for.
    """

    def __init__(self, room: int) -> None:
        super().__init__()
        self.room = room
        self.forgotten = 0

    def __setitem__(self, key: K, value: V) -> None:
        """Put a value in, in the place of the oldest if the key is new and there is no room."""
        if key not in self and len(self) >= self.room:
            del self[next(iter(self))]
            self.forgotten += 1
        super().__setitem__(key, value)


class RateLimit:
    """So many a second pass; the others are counted. Pure.

    Args:
        per_s: that pass in a second of the clock whose time is told.
    """

    def __init__(self, per_s: int) -> None:
        self._per_s = per_s
        self._begun_s = -math.inf
        self._passed = self._left_out = 0

    def allows(self, now_s: float) -> bool:
        """Whether one more may pass now; if not it is counted."""
        if not 0 <= now_s - self._begun_s < 1.0:
            self._begun_s, self._passed = now_s, 0
        if self._passed >= self._per_s:
            self._left_out += 1
            return False
        self._passed += 1
        return True

    def left_out(self, now_s: float) -> int:
        """Return how many did not pass since the last time, once their second is over; else 0."""
        if not self._left_out or 0 <= now_s - self._begun_s < 1.0:
            return 0
        count, self._left_out = self._left_out, 0
        return count


REPORTS_PER_S = 20
"""Error reports of one node; a node with more to say says how many it left out."""

_OFFENDERS = 256
_SLOT_CHARS = 512
_SAME_S = 1.0


class ReportLimit:
    """Which error reports leave a node: of one kind one a second, and not too many in all. Pure."""

    def __init__(self) -> None:
        self._sent: Remembered[str, tuple[float, int]] = Remembered(_OFFENDERS)
        self._all = RateLimit(REPORTS_PER_S)

    def stands_for(self, slot: str, now_s: float) -> int:
        """Return how many of its kind a report stands for that leaves now; 0 if it must not."""
        slot = slot[:_SLOT_CHARS]
        last_s, count = self._sent.get(slot, (-math.inf, 0))
        if now_s - last_s < _SAME_S:
            self._sent[slot] = last_s, count + 1
            return 0
        if not self._all.allows(now_s):
            return 0
        self._sent[slot] = now_s, 0
        return count + 1

    def left_out(self, now_s: float) -> int:
        """Return how many reports did not leave since the last time because there were too many."""
        return self._all.left_out(now_s)
