"""Who is connected to a web server, and who has to go so that others get in. Pure.

A server has room for so many connections, and a stranger can hold one without saying a word. So

* every connection is let in. If that is one too many, another one is closed: of those that only
  wait, of the source that has most of them, the one that has waited longest. A flood from one
  source thus ends its own connections; a flood from many ends none that is being served;
* a connection that has shown a token is closed after all that have not;
* one that is being served, a page that is open for instance, is never closed for others;
* one that waits longer than `PATIENCE_S` is closed, however busy: a request that comes byte by
  byte, a body without end, a goodbye without an answer;
* one that sends more than a page ever would is closed, served or not; so is one without a token
  whose source asks for more files than all pages would.

A *source* is an address; within this machine, where all have the same one, a user. How many come in
a second is bounded as well, so that the pages that are open have their turn.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable
from typing import Generic, TypeVar

K = TypeVar("K", bound=Hashable)

ROOM = 64
"""Connections at once."""

WAITING_ROOM = 24
"""Of which so many of one source may wait: a browser opens six to load a page."""

PATIENCE_S = 5.0
"""Real seconds in which a request has to be made and answered."""

BYTES_AT_ONCE = 256_000
BYTES_PER_S = 64_000
"""A page that drives sends some 3,000; a hundred requests of the greatest length are 400,000."""

REQUESTS_AT_ONCE = 400
REQUESTS_PER_S = 100
"""Of a source that has shown no token; a page that opens makes some twenty."""

COMING_AT_ONCE = 150
COMING_PER_S = 400
"""Connections that are taken; others wait in the kernel's queue."""

REFUSED_COST = 0.2
"""What one that is sent away at once counts among them."""


class Bucket:
    """Something of which so much may be had at once, and so much more each second."""

    __slots__ = ("_at_s", "_left", "_most", "_per_s")

    def __init__(self, most: float, per_s: float, now_s: float) -> None:
        self._most = most
        self._per_s = per_s
        self._left = most
        self._at_s = now_s

    def take(self, count: float, now_s: float) -> float:
        """Take some, and return after how many seconds that will be allowed: 0 if it is now."""
        self._fill(now_s)
        self._left -= count
        return max(-self._left / self._per_s, 0.0)

    def has(self, count: float, now_s: float) -> bool:
        """Tell whether so much could be taken now; nothing is."""
        self._fill(now_s)
        return self._left >= count

    def _fill(self, now_s: float) -> None:
        gained = max(now_s - self._at_s, 0.0) * self._per_s
        self._at_s = now_s
        self._left = min(self._left + gained, self._most)


class Guest:
    """One connection.

    Attributes:
        source: whom it is counted with.
        known: whether it has shown that it may be here.
        served: how many things are being done for it; 0 while it waits.
        since_s: since when it waits.
    """

    __slots__ = ("_bytes", "_requests", "known", "served", "since_s", "source")

    def __init__(self, source: str, known: bool, requests: Bucket, now_s: float) -> None:
        self.source = source
        self.known = known
        self.served = 0
        self.since_s = now_s
        self._bytes = Bucket(BYTES_AT_ONCE, BYTES_PER_S, now_s)
        self._requests = requests

    def sends(self, count: int, now_s: float) -> bool:
        """Count bytes that it sends; False if that is more than it may."""
        return self._bytes.take(count, now_s) == 0

    def answered(self, now_s: float) -> bool:
        """Count a request that was answered; False if those of its source are too many."""
        self.since_s = now_s
        return self.known or self._requests.take(1, now_s) == 0


class Guests(Generic[K]):
    """All connections, by a key of the caller's; times are real seconds."""

    def __init__(self) -> None:
        self._guests: dict[K, Guest] = {}
        self._requests: dict[str, Bucket] = {}

    def __len__(self) -> int:
        return len(self._guests)

    def came(self, key: K, source: str, *, known: bool, now_s: float) -> tuple[Guest, list[K]]:
        """Let a connection in; return the guest, and who has to go for that: itself, at worst."""
        requests = self._requests.setdefault(
            source, Bucket(REQUESTS_AT_ONCE, REQUESTS_PER_S, now_s))
        guest = self._guests[key] = Guest(source, known, requests, now_s)
        waiting = Counter(g.source for g in self._guests.values() if not g.served)
        crowded = waiting[source] > WAITING_ROOM
        if not crowded and len(self._guests) <= ROOM:
            return guest, []
        candidates = [k for k, g in self._guests.items() if not g.served and k != key
                      and (g.source == source or not crowded)]
        gone = min(candidates, default=key, key=lambda k: self._rank(k, waiting))
        self.left(gone)
        return guest, [gone]

    def left(self, key: K) -> None:
        """Forget a connection that is closed; harmless if it was made to go."""
        gone = self._guests.pop(key, None)
        if gone is not None and all(g.source != gone.source for g in self._guests.values()):
            del self._requests[gone.source]

    def overdue(self, now_s: float) -> list[K]:
        """Return who has waited for too long and has to go."""
        go = [k for k, g in self._guests.items() if not g.served and now_s - g.since_s > PATIENCE_S]
        for key in go:
            self.left(key)
        return go

    def _rank(self, key: K, waiting: Counter[str]) -> tuple[bool, int, float]:
        guest = self._guests[key]
        return guest.known, -waiting[guest.source], guest.since_s
