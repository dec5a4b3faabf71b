"""Who has a stick, and whether what it says may still be believed; and its messages.

Several pages may be open, one drives: the first that holds its dead man has the stick until it
lets go, closes, or falls silent. The others are told.

**A late message must not move the robot.** A network that stalls delivers what it held back in
one burst, and a browser's clock is not ours. So each answer carries a *ticket*, and a page shows
the newest with its next message: if that was given out too long ago, so was the message, or the
operator sees a robot of long ago. Either way it does not count as held.

Whoever lost the stick while holding it (silent, late, out of bounds), or held it in vain, has to
let go before it can take it: the robot does not start by itself when a connection recovers, nor
because somebody else let go. All this is `StickDesk`, which is pure; `Stick` tells the robot.
"""

from __future__ import annotations

import asyncio
import math
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from rampart.actors.bus.limits import Remembered
from rampart.actors.operator.panels import Panel, steered
from rampart.actors.operator.requests import StickRequest
from rampart.actors.runtime.actor import Actor

SILENCE_S = 0.3
"""A page that was not heard for so long has let go (real seconds)."""

TICKET_S = 0.3
"""So old a ticket is too old: a round trip and the page's period must fit (real seconds)."""

PERIOD_S = 0.1
"""Simulated seconds between messages of a held stick whose topic says no rate."""

_SHORTEST_S = 0.001
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
    """A stick of all pages together. Pages are numbers; times are real seconds.

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


class Stick:
    """A panel's stick: tells the robot where it is, again and again while it is held.

    At a high rate a page is too slow for the robot; so the message is repeated as often as the rate
    of its topic says. Whoever lets go, or is taken to have, is told to the robot once: as the
    message at rest.

    Args:
        actor: the page's node.
        panel: that declares it.
        changed: called with a page when that holds it or lets go, whether it holds it, and the
            reason if nobody meant it.

    Attributes:
        desk: who has it.
        note: what there is to tell of it, "" for nothing.

    Raises:
        ValueError: the node knows no such topic.
    """

    def __init__(self, actor: Actor, panel: Panel,
                 changed: Callable[[int, bool, str], None]) -> None:
        self.desk = StickDesk()
        self.note = ""
        self._actor = actor
        self._topic = actor.chosen_topic(panel.topic)
        self._name = self._topic.member(panel.topic) or None
        self._message = steered(panel, self._topic)
        self._changed = changed
        self._period_s = 1 / self._topic.rate_hz if self._topic.rate_hz > 0 else PERIOD_S
        self._sent_s = -math.inf
        self._ticking: asyncio.TimerHandle | None = None

    def start(self) -> None:
        """Let go in case a former incarnation died while a page held it."""
        self._say(None)

    def stop(self) -> None:
        """Let go; the node ends."""
        if self._ticking is not None:
            self._ticking.cancel()
            self._ticking = None
        if self.desk.holder is not None:
            self._say(None)

    def move(self, page: int, request: StickRequest) -> dict[str, Any]:
        """Take a page's message and return what to tell it."""
        before = self.desk.holder
        answer = self.desk.move(page, request, asyncio.get_running_loop().time())
        if answer.grip is Grip.DRIVES:
            self._drive()
            if before != page:
                self.note = ""
                self._changed(page, True, "")
        elif before is not None and self.desk.holder is None:
            self._release(before, answer.text)
        return {"type": "stick", "panel": request.panel, "grip": answer.grip, "text": answer.text,
                "ticket": answer.ticket}

    def left(self, page: int) -> None:
        """Take note that a page was closed; if it drove, the robot stops."""
        if self.desk.gone(page):
            self._release(page, "the page that drove was closed")

    def _say(self, position: tuple[float, float] | None) -> None:
        self._actor.publish(self._topic, self._message(position), name=self._name)

    def _drive(self) -> None:
        """Publish where it is held, and see to it that it is repeated or missed."""
        loop = asyncio.get_running_loop()
        at = self.desk.position(loop.time())
        if at is not None:
            self._sent_s = self._actor.clock.now()
            self._say(at)
        if self._ticking is None:
            self._tick_later(loop)

    def _tick_later(self, loop: asyncio.AbstractEventLoop) -> None:
        period_s = min(SILENCE_S / 6, self._period_s / self._actor.clock.rate)
        self._ticking = loop.call_later(max(period_s, _SHORTEST_S), self._tick)

    def _tick(self) -> None:
        loop = asyncio.get_running_loop()
        self._ticking = None
        lapsed = self.desk.expire(loop.time())
        if lapsed is not None:
            self._release(lapsed, f"page {lapsed} was silent for {SILENCE_S:g} s")
        if self.desk.holder is not None:
            if self._actor.clock.now() - self._sent_s >= self._period_s:
                self._drive()
            self._tick_later(loop)

    def _release(self, page: int, why: str) -> None:
        """Tell the robot that it was let go, and the pages why if nobody meant it."""
        self._say(None)
        self.note = why
        self._changed(page, False, why)
