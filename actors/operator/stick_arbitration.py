"""Who has the stick when several want to drive, and for how long. Pure.

Pages of one node compete for its sticks; the node, a joystick and a terminal compete for a robot's
teleoperation. One set of rules decides both:

- No source has the stick: the source that holds its dead man gets it.
- It keeps the stick until it lets go, or its newest position is older than `TIMEOUT_S`.
- A source that holds its dead man meanwhile is not followed, and neither is a source that was lost
  while it held the stick. Both have to let go first: a robot must not start because another
  operator let go, nor because a connection has recovered.
- A position counts from its stamp: a position that arrives late holds nothing.
- A source that begins with a held dead man may have held it for long, since its connection or this
  node is new: it has to let go first.

The Safety Pilot decides whether a stick may drive after a stop, by the time it was taken in hand.
"""

from __future__ import annotations

import math

import msgspec

from rampart.actors.bus.limits import Remembered

TIMEOUT_S = 0.3
"""Seconds without a position after which a source counts as lost; the Safety Pilot's."""

FIRST_S = 1.0
"""Seconds after the start within which the positions of all held sources have arrived."""

TOO_LATE = "its position came too late"
LET_GO = "not followed: let go first, then press again"

_REMEMBERED = 64


class Ruling(msgspec.Struct, frozen=True):
    """What follows from an offer, or from the passing of time.

    Attributes:
        follows: whether the position that was offered is followed.
        released: whether the holder of the stick has just let go or was lost: stop.
        told: why a source is not followed, or no longer; "" if it is.
        whom: the source that `told` is about.
        since_s: since when the stick that is followed is held.
    """

    follows: bool = False
    released: bool = False
    told: str = ""
    whom: str = ""
    since_s: float = math.inf


class StickArbiter:
    """Follows one source at a time. All times are of one clock.

    Args:
        started_s: when the first source could be received; infinity if sources connect later.

    Attributes:
        holder: the source that is followed, or "".
    """

    def __init__(self, started_s: float = math.inf) -> None:
        self.holder = ""
        self._first_until_s = started_s + FIRST_S
        self._newest_s = self._since_s = -math.inf
        self._rested: dict[str, bool] = Remembered(_REMEMBERED)
        """Sources that had let go in their newest position."""
        self._barred: dict[str, bool] = Remembered(_REMEMBERED)
        """Sources that have to let go first; the newest are remembered."""

    def offer(self, source: str, held: bool, stamp_s: float, now_s: float) -> Ruling:
        """Take a position from a source.

        Args:
            source: its name.
            held: whether its dead man is held.
            stamp_s: when the position was measured.
            now_s: now.
        """
        lost = self.expire(now_s)
        if not held:
            self._barred.pop(source, None)
            self._rested[source] = True
            if source != self.holder:
                return lost
            self.holder = ""
            return Ruling(released=True)
        if not now_s - stamp_s <= TIMEOUT_S:  # so is a stamp that is not a number
            return Ruling(False, lost.released, TOO_LATE, source)
        rested = self._rested.pop(source, False) or now_s >= self._first_until_s
        if not self.holder and rested and source not in self._barred:
            self.holder, self._since_s = source, min(stamp_s, now_s)
        if source == self.holder:
            self._newest_s = min(stamp_s, now_s)
            return Ruling(True, False, lost.told, lost.whom, self._since_s)
        self.bar(source)
        why = f"not followed: {self.holder} has the stick" if self.holder else LET_GO
        return Ruling(False, lost.released, why, source)

    def expire(self, now_s: float) -> Ruling:
        """Take the stick from a source that has been silent for too long."""
        if not self.holder or now_s - self._newest_s <= TIMEOUT_S:
            return Ruling()
        source, self.holder = self.holder, ""
        self.bar(source)
        return Ruling(False, True, f"silent for {TIMEOUT_S:g} s: counts as let go", source)

    def bar(self, source: str) -> None:
        """Follow a source only after it has let go."""
        self._barred[source] = True
