"""The stick of a panel: which page drives, and the messages that the robot gets of it.

**A late message must not move the robot.** A network that stalls delivers its backlog in one burst,
and the clock of a browser cannot be trusted. So each answer to a page carries a *ticket*: the time
here when it was given. The page returns the newest ticket with its next position, which counts as
measured at that time. `stick_arbitration` decides the rest.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from typing import Any

from rampart.actors.operator.panels import Panel, steered
from rampart.actors.operator.requests import StickRequest
from rampart.actors.operator.stick_arbitration import TIMEOUT_S, TOO_LATE, Ruling, StickArbiter
from rampart.actors.runtime.actor import Actor

PATIENCE_S = 1.0
"""A press that has not driven for so long drives no more: its connection is slow, or was stalled
(real seconds)."""

PERIOD_S = 0.1
"""Simulated seconds between messages of a held stick whose topic has no rate."""

_SHORTEST_S = 0.001


class Stick:
    """A panel's stick: publishes its position again and again while a page holds it.

    At a high rate a page is too slow for the robot; so the message is repeated as often as the rate
    of its topic demands. A release, meant or not, is published once, as the message at rest.

    Args:
        actor: the page's node.
        panel: that declares it.
        changed: called with a page when that holds it or lets go, whether it holds it, and the
            reason of a release that no operator meant.

    Attributes:
        holder: the page that drives, or None.
        note: what the pages are shown of it, "" for nothing.

    Raises:
        ValueError: the node knows no such topic.
    """

    def __init__(self, actor: Actor, panel: Panel,
                 changed: Callable[[int, bool, str], None]) -> None:
        self.holder: int | None = None
        self.note = ""
        self._arbiter = StickArbiter()
        self._actor = actor
        self._topic = actor.chosen_topic(panel.topic)
        self._name = self._topic.member(panel.topic) or None
        self._message = steered(panel, self._topic)
        self._changed = changed
        self._period_s = 1 / self._topic.rate_hz if self._topic.rate_hz > 0 else PERIOD_S
        self._sent_s = -math.inf
        self._at = (0.0, 0.0)
        self._ticking: asyncio.TimerHandle | None = None

    def start(self) -> None:
        """Let go in case a former incarnation died while a page held it."""
        self._publish(None)

    def stop(self) -> None:
        """Let go; the node ends."""
        if self._ticking is not None:
            self._ticking.cancel()
        if self.holder is not None:
            self._publish(None)

    def move(self, page: int, request: StickRequest) -> dict[str, Any]:
        """Take a page's position and return the answer."""
        now_s = asyncio.get_running_loop().time()
        self._obey(self._arbiter.expire(now_s))
        source, text = f"page {page}", ""
        if is_stalled := request.pressed_s > PATIENCE_S and self.holder != page:
            self._arbiter.bar(source)
        ruling = self._arbiter.offer(source, request.held, request.ticket, now_s)
        if ruling.follows:
            self._drive(page, (request.forward, request.left))
        elif ruling.told != TOO_LATE:  # the next one has a ticket
            text = ruling.told
        self._obey(ruling)
        if is_stalled and request.held and self.holder is None:
            text = "let go first, then press again: the connection is slow, or was stalled"
        return {"type": "stick", "panel": request.panel, "drives": ruling.follows, "text": text,
                "ticket": now_s}

    def left(self, page: int) -> None:
        """Take note that a page was closed; if it drove, the robot stops."""
        now_s = asyncio.get_running_loop().time()
        self._obey(self._arbiter.expire(now_s))
        if self._arbiter.offer(f"page {page}", False, now_s, now_s).released:
            self._release("the page that drove was closed")

    def _publish(self, position: tuple[float, float] | None) -> None:
        self._sent_s = self._actor.clock.now()
        self._actor.publish(self._topic, self._message(position), name=self._name)

    def _drive(self, page: int, at: tuple[float, float]) -> None:
        self._at = at
        self._publish(at)
        if self.holder != page:
            self.holder, self.note = page, ""
            self._changed(page, True, "")
        if self._ticking is None:
            self._tick()

    def _tick(self) -> None:
        """Repeat the position of a held stick, and notice a silent holder."""
        loop = asyncio.get_running_loop()
        self._ticking = None
        self._obey(self._arbiter.expire(loop.time()))
        if self.holder is None:
            return
        if self._actor.clock.now() - self._sent_s >= self._period_s:
            self._publish(self._at)
        period_s = min(TIMEOUT_S / 6, self._period_s / self._actor.clock.rate)
        self._ticking = loop.call_later(max(period_s, _SHORTEST_S), self._tick)

    def _obey(self, ruling: Ruling) -> None:
        if ruling.released:
            self._release(f"{ruling.whom} was {ruling.told}" if ruling.whom else "")

    def _release(self, why: str) -> None:
        page, self.holder, self.note = self.holder, None, why
        self._publish(None)
        if page is not None:
            self._changed(page, False, why)
