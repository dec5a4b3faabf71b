"""Limits that keep a flood of messages from filling memory or logs.

State that is kept by names from messages has a maximum size. Output that repeats messages has a
maximum rate. Whatever exceeds a limit is counted, and the owner of the limit reports the count.
"""

from __future__ import annotations

import math
from typing import Generic, TypeVar

K = TypeVar("K")
V = TypeVar("V")


class Remembered(Generic[K, V], dict[K, V]):
    """A dictionary that forgets its oldest key if `[key] = value` exceeds its size.

    Args:
        room: Largest number of keys.

    Attributes:
        forgotten: Number of keys forgotten so far.
    """

    def __init__(self, room: int) -> None:
        super().__init__()
        self.room = room
        self.forgotten = 0

    def __setitem__(self, key: K, value: V) -> None:
        """Set a value; remove the oldest key if this one is new and there is no room."""
        if key not in self and len(self) >= self.room:
            del self[next(iter(self))]
            self.forgotten += 1
        super().__setitem__(key, value)


class RateLimit:
    """Lets a number of events per second pass and counts the others. Pure.

    Args:
        per_s: Events per second of the caller's clock.
    """

    def __init__(self, per_s: int) -> None:
        self._per_s = per_s
        self._begun_s = -math.inf
        self._passed = self._left_out = 0

    def allows(self, now_s: float) -> bool:
        """Whether an event may pass now; it is counted if not."""
        if not 0 <= now_s - self._begun_s < 1.0:
            self._begun_s, self._passed = now_s, 0
        if self._passed >= self._per_s:
            self._left_out += 1
            return False
        self._passed += 1
        return True

    def left_out(self, now_s: float) -> int:
        """Return how many events were stopped since the last call, once their second is over."""
        if not self._left_out or 0 <= now_s - self._begun_s < 1.0:
            return 0
        count, self._left_out = self._left_out, 0
        return count


REPORTS_PER_S = 20
"""Error reports of one node. A node with more reports how many it left out."""

_OFFENDERS = 256
_SLOT_CHARS = 512
_SAME_S = 1.0


class ReportLimit:
    """Limits the error reports of a node: one per kind and second, and a total rate. Pure."""

    def __init__(self) -> None:
        self._sent: Remembered[str, tuple[float, int]] = Remembered(_OFFENDERS)
        self._all = RateLimit(REPORTS_PER_S)

    def stands_for(self, slot: str, now_s: float) -> int:
        """Return how many reports of its kind a report stands for; 0 if it must not leave now."""
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
        """Return how many reports the total rate stopped since the last call."""
        return self._all.left_out(now_s)
