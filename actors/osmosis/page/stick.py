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
from dataclasses import dataclass, field
from enum import StrEnum

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


@dataclass(slots=True)
class _Tickets:
    given: dict[int, float] = field(default_factory=dict)

    def give(self, number: int, now_s: float) -> int:
        self.given[number] = now_s
        if len(self.given) > _KEPT_TICKETS:
            del self.given[next(iter(self.given))]
        return number

    def fresh(self, number: int, now_s: float) -> bool:
        return now_s - self.given.get(number, -math.inf) <= TICKET_S


class StickDesk:
    """The stick of all pages together. Pages are numbers; times are real seconds."""

    def __init__(self) -> None:
        self._holder: int | None = None
        self._heard_s = -math.inf
        self._at = (0.0, 0.0)
        self._lapsed: set[int] = set()
        self._tickets: dict[int, _Tickets] = {}
        self._given = 0

    @property
    def holder(self) -> int | None:
        """The page that has the stick, as far as is known; `expire` first."""
        return self._holder

    def position(self, now_s: float) -> tuple[float, float] | None:
        """Return (forward, left) of the stick that is held now, or None."""
        if self._holder is None or now_s - self._heard_s > SILENCE_S:
            return None
        return self._at

    def move(self, page: int, request: StickRequest, now_s: float) -> StickAnswer:
        """Take a page's message."""
        self.expire(now_s)
        grip, text = self._grip(page, request, now_s) if request.held else (Grip.FREE, "")
        if grip is Grip.DRIVES:
            self._holder, self._heard_s = page, now_s
            self._at = (min(max(request.forward, -1.0), 1.0), min(max(request.left, -1.0), 1.0))
        elif self._holder == page:
            self._holder = None
        if grip in (Grip.LATE, Grip.REFUSED, Grip.TAKEN):
            self._lapsed.add(page)
        elif grip is Grip.FREE:
            self._lapsed.discard(page)
        self._given += 1
        tickets = self._tickets.setdefault(page, _Tickets())
        return StickAnswer(grip, text, tickets.give(self._given, now_s))

    def expire(self, now_s: float) -> int | None:
        """Take the stick from a page that has fallen silent, and return its number."""
        page = self._holder
        if page is None or now_s - self._heard_s <= SILENCE_S:
            return None
        self._holder = None
        self._lapsed.add(page)
        return page

    def gone(self, page: int) -> bool:
        """Forget a page that was closed; tell whether it had the stick."""
        had = self._holder == page
        if had:
            self._holder = None
        self._lapsed.discard(page)
        self._tickets.pop(page, None)
        return had

    def _grip(self, page: int, request: StickRequest, now_s: float) -> tuple[Grip, str]:
        for name, value in (("forward", request.forward), ("left", request.left)):
            if not abs(value) <= 1.0 + _ROUNDING:
                return Grip.REFUSED, (f"{name} = {value:g}: must be between -1 and 1; "
                                      "the stick was taken from you, let go first")
        if self._holder is not None and self._holder != page:
            return Grip.TAKEN, f"page {self._holder} has the stick"
        if page in self._lapsed:
            return Grip.LAPSED, "let go of the stick and press again"
        tickets = self._tickets.get(page)
        if tickets is None or not tickets.fresh(request.ticket, now_s):
            if self._holder == page:
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
    if dead_nodes:
        return False, f"no effect: {', '.join(dead_nodes)} does not run"
    if not pilot_heard:
        return False, "no effect: the Safety Pilot is not heard"
    if brake:
        return False, "no effect: the brake is engaged (emergency stop)"
    if forbids:
        return False, f"no effect: {forbids}"
    if mode == "teleoperation":
        return True, "the robot obeys the stick alone; it stands while you let go"
    return True, "the stick overrides the mission while you hold it; let go and the mission goes on"
