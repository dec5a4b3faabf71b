"""Who has the stick, and whether what it says may still be believed. Pure.

Several pages may be open, one drives: the first that holds its dead man has the stick until it
lets go, closes, or falls silent. The others are told.

**A late message must not move the robot.** A network that stalls delivers what it held back in
one burst, and a browser's clock is not ours. So each answer carries a *ticket*, and a page shows
the newest with its next message: if that was given out too long ago, so was the message, or the
operator sees a robot of long ago. Either way it does not count as held.

Whoever lost the stick while holding it (silent, late, out of bounds), or held it in vain, has to
let go before it can take it: the robot does not start by itself when a connection recovers, nor
because somebody else let go.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from enum import StrEnum

from rampart.actors.bus.limits import Remembered
from rampart.actors.osmosis.page.requests import StickRequest

SILENCE_S = 0.3
"""A page that was not heard for so long has let go (real seconds)."""

TICKET_S = 0.3
"""So old a ticket is too old: a round trip and the page's period must fit (real seconds)."""

_KEPT_TICKETS = 64
_ROUNDING = 1e-6


class Grip(StrEnum):
    """What became of a message of the stick."""

    DRIVES = "drives"
    FREE = "free"
    WAITS = "waits"
    TAKEN = "taken"
    LATE = "late"
    LAPSED = "lapsed"
    REFUSED = "refused"


@dataclass(frozen=True, slots=True)
class StickAnswer:
    """What a page is told: its grip, why in words ("" if all is well), and its next ticket."""

    grip: Grip
    text: str
    ticket: int


class StickDesk:
    """The stick of all pages together. Pages are numbers; times are real seconds.

    Attributes:
        holder: the page that has the stick, as far as is known; `expire` first.
    """

    def __init__(self) -> None:
        self.holder: int | None = None
        self._heard_s = -math.inf
        self._at = (0.0, 0.0)
        self._lapsed: set[int] = set()
        self._tickets: defaultdict[int, Remembered[int, float]] = defaultdict(
            lambda: Remembered(_KEPT_TICKETS))  # of each page: when they were given
        self._given = 0

    def position(self, now_s: float) -> tuple[float, float] | None:
        """Return (forward, left) of the stick that is held now, or None."""
        return None if self.holder is None or now_s - self._heard_s > SILENCE_S else self._at

    def move(self, page: int, request: StickRequest, now_s: float) -> StickAnswer:
        """Take a page's message."""
        self.expire(now_s)
        grip, text = self._grip(page, request, now_s) if request.held else (Grip.FREE, "")
        if grip is Grip.DRIVES:
            self.holder, self._heard_s = page, now_s
            self._at = (min(max(request.forward, -1.0), 1.0), min(max(request.left, -1.0), 1.0))
        elif self.holder == page:
            self.holder = None
        if grip in (Grip.LATE, Grip.REFUSED, Grip.TAKEN):
            self._lapsed.add(page)
        elif grip is Grip.FREE:
            self._lapsed.discard(page)
        self._given += 1
        self._tickets[page][self._given] = now_s
        return StickAnswer(grip, text, self._given)

    def expire(self, now_s: float) -> int | None:
        """Take the stick from a page that has fallen silent, and return its number."""
        page = self.holder
        if page is None or now_s - self._heard_s <= SILENCE_S:
            return None
        self.holder = None
        self._lapsed.add(page)
        return page

    def gone(self, page: int) -> bool:
        """Forget a page that was closed; tell whether it had the stick."""
        had = self.holder == page
        if had:
            self.holder = None
        self._lapsed.discard(page)
        self._tickets.pop(page, None)
        return had

    def _grip(self, page: int, request: StickRequest, now_s: float) -> tuple[Grip, str]:
        for name, value in (("forward", request.forward), ("left", request.left)):
            if not abs(value) <= 1.0 + _ROUNDING:
                return Grip.REFUSED, (f"{name} = {value:g}: must be between -1 and 1; "
                                      "the stick was taken from you, let go first")
        if self.holder is not None and self.holder != page:
            return Grip.TAKEN, f"page {self.holder} has the stick"
        if page in self._lapsed:
            return Grip.LAPSED, "let go of the stick and press again"
        if now_s - self._tickets[page].get(request.ticket, -math.inf) > TICKET_S:
            if self.holder == page:
                return Grip.LATE, (f"the connection is slower than {TICKET_S:g} s; "
                                   "the stick was taken from you, let go first")
            return Grip.WAITS, ""
        return Grip.DRIVES, ""


def effect(*, pilot_heard: bool, mode: str, forbids: str, brake: bool, dead_nodes: tuple[str, ...]
           ) -> tuple[bool, str]:
    """Return whether the stick has any effect now, and in words why not, or what it does.

    Args:
        pilot_heard: whether the Safety Pilot was heard lately.
        mode: of the Safety Pilot.
        forbids: why it lets nobody drive, "" if it does.
        brake: whether the base's brake is engaged.
        dead_nodes: which of the nodes between stick and wheels do not run.
    """
    for is_so, why in ((dead_nodes, f"{', '.join(dead_nodes)} does not run"),
                       (not pilot_heard, "the Safety Pilot is not heard"),
                       (brake, "the brake is engaged (emergency stop)"),
                       (forbids, forbids)):
        if is_so:
            return False, f"no effect: {why}"
    if mode == "teleoperation":
        return True, "the robot obeys the stick alone; it stands while you let go"
    return True, "the stick overrides the mission while you hold it; let go and the mission goes on"
