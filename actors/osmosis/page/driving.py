"""Driving from a page: `stick` decides who drives; here are topics and timers."""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Any

from rampart.actors.bus import messages as bm
from rampart.actors.ftm import messages as fm
from rampart.actors.operator.operating import Operating
from rampart.actors.operator.requests import Request
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.page.requests import StickRequest
from rampart.actors.osmosis.page.stick import SILENCE_S, TICKET_S, Grip, StickDesk, effect

if TYPE_CHECKING:
    from rampart.actors.operator.state import HmiState
    from rampart.actors.runtime.actor import Actor

REPEAT_STICK_S = 0.1
"""Simulated seconds after which a held stick is repeated: at a high rate a page is too slow."""

_STALE_S = 1.5
"""Simulated seconds after which the Safety Pilot counts as silent; half a real one at least."""

_LET_GO = m.Joystick(0.0, 0.0, dead_man=False)
_DRIVEN_BY = ("teleoperation", "safety_pilot")
"""Nodes between a page's stick and the base."""


class Driving(Operating):
    """The operator's hands, on a stick as well.

    Args:
        actor: the page's node.
        state: what its pages are shown; the section "operating" is this one's.
    """

    def __init__(self, actor: Actor, state: HmiState) -> None:
        self._desk = StickDesk()
        self._pilot: m.PilotStatus | None = None
        self._pilot_heard_s = -math.inf
        self._brake = False
        self._dead: tuple[str, ...] = ()
        self._note = ""
        self._sent_s = -math.inf
        self._ticking: asyncio.TimerHandle | None = None
        super().__init__(actor, state)

    def start(self) -> None:
        """Let go of the stick in case a former incarnation died while a page held it."""
        self._actor.publish(topics.JOYSTICK, _LET_GO)

    def stop(self) -> None:
        """Let go of the stick; the node ends."""
        if self._ticking is not None:
            self._ticking.cancel()
            self._ticking = None
        if self._desk.holder is not None:
            self._actor.publish(topics.JOYSTICK, _LET_GO)

    def introduction(self, page: int) -> dict[str, Any]:
        """Return what a page needs to know to offer all this."""
        return {**super().introduction(page), "silence_s": SILENCE_S, "ticket_s": TICKET_S}

    def fulfil(self, request: Request, page: int) -> str | dict[str, Any]:
        """Act on a request of a page and return what to tell it."""
        if not isinstance(request, StickRequest):
            return super().fulfil(request, page)
        before = self._desk.holder
        answer = self._desk.move(page, request, asyncio.get_running_loop().time())
        if answer.grip is Grip.DRIVES:
            self._drive()
            if before != page:
                self._note = ""
                self.show()
        elif before is not None and self._desk.holder is None:
            self._release(answer.text)
        return {"type": "stick", "grip": answer.grip, "text": answer.text, "ticket": answer.ticket}

    def left(self, page: int) -> None:
        """Take note that a page was closed; if it drove, the robot stops."""
        if self._desk.gone(page):
            self._release("the page that drove was closed")

    def _drive(self) -> None:
        """Publish the stick that is held, and see to it that it is repeated or missed."""
        loop = asyncio.get_running_loop()
        at = self._desk.position(loop.time())
        if at is not None:
            self._sent_s = self._now()
            self._actor.publish(topics.JOYSTICK, m.Joystick(*at, dead_man=True))
        if self._ticking is None:
            self._tick_later(loop)

    def _tick_later(self, loop: asyncio.AbstractEventLoop) -> None:
        period_s = min(SILENCE_S / 6, REPEAT_STICK_S / self._actor.clock.rate)
        self._ticking = loop.call_later(period_s, self._tick)

    def _tick(self) -> None:
        loop = asyncio.get_running_loop()
        self._ticking = None
        lapsed = self._desk.expire(loop.time())
        if lapsed is not None:
            self._release(f"page {lapsed} was silent for {SILENCE_S:g} s")
        if self._desk.holder is not None:
            if self._now() - self._sent_s >= REPEAT_STICK_S:
                self._drive()
            self._tick_later(loop)

    def _release(self, why: str) -> None:
        """Tell the robot that the dead man was released, and the pages why if nobody meant it."""
        self._actor.publish(topics.JOYSTICK, _LET_GO)
        self._note = why
        if why:
            self._state.log(self._now(), "note", f"stick released: {why}")
        self.show()

    # -- what it hears --------------------------------------------------------------------------

    def pilot(self, message: m.PilotStatus) -> None:
        """Hear the Safety Pilot."""
        before, self._pilot, self._pilot_heard_s = self._pilot, message, self._now()
        if before != message:
            self.show()

    def base(self, message: m.BaseStatus) -> None:
        """Hear the base: whether its brake is engaged."""
        if message.brake_engaged != self._brake:
            self._brake = message.brake_engaged
            self.show()

    def nodes(self, table: fm.NodeTable) -> None:
        """Hear the supervisor: whether those between stick and wheels run."""
        running = {row.name for row in table.nodes if row.state is fm.NodeState.RUNNING}
        dead = tuple(name for name in _DRIVEN_BY if name not in running)
        if dead != self._dead:
            self._dead = dead
            self.show()

    def diagnostic(self, report: bm.Diagnostic) -> None:
        """Hear why Teleoperation does not follow this stick, e.g. since somebody else drives."""
        if (report.node == _DRIVEN_BY[0] and report.offender == self._actor.name
                and report.context == "joystick"):
            self._note = f"Teleoperation: {report.reason}"
            self.show()

    # -- what it shows --------------------------------------------------------------------------

    def view(self, now_s: float) -> dict[str, Any]:
        """Return the section: who drives, and whether that has an effect, besides the rest."""
        pilot = self._pilot
        patience_s = max(_STALE_S, 0.5 * self._actor.clock.rate)
        works, text = effect(
            pilot_heard=now_s - self._pilot_heard_s <= patience_s, mode=pilot.mode if pilot else "",
            forbids=pilot.forbids if pilot else "", brake=self._brake, dead_nodes=self._dead)
        return {"holder": self._desk.holder, "works": works, "text": text, "note": self._note,
                **super().view(now_s)}
