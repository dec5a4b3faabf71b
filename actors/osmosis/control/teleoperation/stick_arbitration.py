"""Who has the stick when several want to drive. Pure.

A joystick on this machine, the operator's page and a terminal may all offer positions. The rules:

- Nobody has the stick: whoever holds the dead man gets it.
- Who has it keeps it until letting go, or not being heard for `timeout_s`.
- Who holds the dead man meanwhile is not followed and is told so, once. So is who was lost while
  holding it and comes back. Both have to let go before they can get the stick: a robot must not
  leap because *somebody else* let go, nor because a connection has recovered.
- A position counts from its stamp: what is old when it arrives holds nothing.
- A source that is first heard holding the dead man just after the start may have held it for long:
  this may be a restart. It has to let go first.

Whether a stick may drive after a stop decides the Safety Pilot, by when it was taken in hand.
"""

from __future__ import annotations

import math

import msgspec

from rampart.actors.bus.limits import Remembered
from rampart.actors.osmosis.messages import Joystick

TIMEOUT_S = 0.3
"""Simulated seconds without a position after which a source counts as lost; the Safety Pilot's."""

FIRST_S = 1.0
"""Simulated seconds after the start within which all sources that are held have been heard."""

_REMEMBERED = 64


class Ruling(msgspec.Struct, frozen=True):
    """What follows from an offer, or from the passing of time.

    Attributes:
        stick: position to follow now, or None.
        released: whether the one who had the stick has just let go or was lost: stop.
        told: why a source is not followed, or no longer; "" if there is nothing to say.
        whom: the source that `told` is about.
        since_s: from when the stick that is followed is held.
    """

    stick: Joystick | None = None
    released: bool = False
    told: str = ""
    whom: str = ""
    since_s: float = math.inf


class StickArbiter:
    """Follows one source at a time.

    Args:
        started_s: when it began to hear sources.

    Attributes:
        holder: the source that is followed, or "".
    """

    def __init__(self, started_s: float = -math.inf) -> None:
        self.holder = ""
        self._first_until_s = started_s + FIRST_S
        self._heard_s = self._since_s = -math.inf
        self._rested: dict[str, bool] = Remembered(_REMEMBERED)
        """Sources that were let go when they were heard last."""
        self._barred: dict[str, bool] = Remembered(_REMEMBERED)
        """Sources that have to let go first, and whether they know; the newest are remembered."""

    def offer(self, source: str, stick: Joystick, stamp_s: float, now_s: float) -> Ruling:
        """Take a position from a source.

        Args:
            source: who offers it.
            stick: the position; one that is not finite counts as let go.
            stamp_s: when it was measured.
            now_s: now, on the same clock.
        """
        lost = self.expire(now_s)
        sound = stick.dead_man and math.isfinite(stick.forward) and math.isfinite(stick.left)
        if not sound:
            self._barred.pop(source, None)
            self._rested[source] = True
            if source != self.holder:
                return lost
            self.holder = ""
            return Ruling(released=True)
        if not now_s - stamp_s <= TIMEOUT_S:  # so is a stamp that is no number
            return Ruling(None, lost.released, "its position came too late", source)
        rested = self._rested.pop(source, False) or now_s >= self._first_until_s
        if not self.holder and rested and source not in self._barred:
            self.holder, self._since_s = source, min(stamp_s, now_s)
        if source == self.holder:
            self._heard_s = min(stamp_s, now_s)
            return Ruling(stick, False, lost.told, lost.whom, self._since_s)
        if self._barred.get(source):
            return lost
        self._bar(source, told=True)
        why = f"{self.holder} has the stick" if self.holder else "it has to let go first"
        return Ruling(None, lost.released, f"not followed: {why}", source)

    def expire(self, now_s: float) -> Ruling:
        """Take the stick from a source that has not been heard for too long."""
        if not self.holder or now_s - self._heard_s <= TIMEOUT_S:
            return Ruling()
        source, self.holder = self.holder, ""
        self._bar(source, told=False)
        return Ruling(None, True, f"not heard for {TIMEOUT_S:g} s: counts as let go", source)

    def _bar(self, source: str, *, told: bool) -> None:
        self._barred.pop(source, None)
        self._barred[source] = told
