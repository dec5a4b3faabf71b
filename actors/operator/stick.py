"""The stick of a panel: the page that drives, and the messages to the robot.

**A late message must not move the robot.** After a stall a network delivers its backlog in one
burst, and the clock of a browser cannot be trusted. So each answer to a page contains a *ticket*:
the time here. The page sends the newest ticket with its next position, which counts as measured at
that time. `stick_arbitration` decides the rest.
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
"""Real seconds after which a press that has not driven yet is refused: its connection stalls."""

PERIOD_S = 0.1
"""Simulated seconds between messages of a held stick whose topic has no rate."""

_SHORTEST_S = 0.001


class Stick:
    """A panel's stick: publishes its position while a page holds it.

    Pages report less often than a fast robot needs, so the message is repeated at the rate of its
    topic. Each release publishes the message at rest once.

    Args:
        actor: the page's node.
        panel: that declares it.
        changed: called with a page that takes or releases the stick, whether it holds it, and the
            reason of an involuntary release.

    Attributes:
        holder: the page that drives, or None.
        note: text for the pages, "" for none.

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
        """Release the stick, which a page may have held when the last incarnation died."""
        self._publish(None)

    def stop(self) -> None:
        """Release the stick; the node ends."""
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
        """Release the stick if the page that was closed held it."""
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
        """Repeat the position of a held stick, and release it if the holder is silent."""
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
