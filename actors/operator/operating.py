"""What an operator does from a page, but for missions: drive, choose a strategy, break things.

Thin: `hmi_stick` decides who drives, `hmi_adaptation` and `hmi_injection` keep what waits for an
answer; here are the topics, the timers, and what pages are shown of it.
"""

from __future__ import annotations

import asyncio
import math
from typing import TYPE_CHECKING, Any

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.layout.system_topics import declared_topics, find_topic, published_keys
from rampart.actors.operator.adaptation import ChoiceError, StrategyChoice
from rampart.actors.operator.injection import FaultError, Injections, Order, places
from rampart.actors.operator.requests import (
    AdaptWish,
    EndFaultWish,
    InjectWish,
    RefusedError,
    SignalWish,
    StickWish,
)
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.page.stick import SILENCE_S, TICKET_S, Grip, StickDesk, effect
from rampart.actors.supervision.kill_node import SIGNALS, SignalError, signal_node
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.strategies.registry import STRATEGIES

if TYPE_CHECKING:
    from rampart.actors.operator.state import HmiState
    from rampart.actors.runtime.actor import Actor

OUTPUTS = (topics.JOYSTICK, ftm_topics.ADAPT, bus_topics.INJECTION_REQUEST, topics.ACTUATOR_FAULT)
SHOWN = (ftm_topics.ADAPTATION, bus_topics.INJECTION_RESULT, topics.BASE_STATUS)
"""What is heard for the page alone."""

OperatingWish = StickWish | AdaptWish | SignalWish | InjectWish | EndFaultWish

REPEAT_STICK_S = 0.1
"""Simulated seconds after which a held stick is repeated: at a high rate a page is too slow."""

OVERHEAD_S = 1.0
"""Real seconds granted for what does not run in simulated time: sockets, scheduling, a respawn."""

OWN_DEATH_S = 0.2
"""Real seconds between the answer to whoever kills the HMI itself, and its death."""

_STALE_S = 1.5
"""Simulated seconds after which the Safety Pilot counts as silent; half a real one at least."""

_LET_GO = m.Joystick(0.0, 0.0, dead_man=False)
_DRIVEN_BY = ("teleoperation", "safety_pilot")
"""Nodes between a page's stick and the base."""


class Operating:
    """The operator's hands.

    Args:
        actor: the HMI.
        state: what its pages are shown; the section "operating" is this one's.
    """

    def __init__(self, actor: Actor, state: HmiState) -> None:
        run = actor.context.run
        prefix = f"{run.plan.run_id}/{actor.name}.{actor.context.incarnation}"
        self._actor = actor
        self._state = state
        self._desk = StickDesk()
        overhead_s = OVERHEAD_S * actor.clock.rate
        self._choice = StrategyChoice(f"{prefix}.s", "operator", tuple(STRATEGIES), overhead_s)
        self._injections = Injections(f"{prefix}.f", run.plan.faults, places_of(run.system),
                                      run.application.topics, overhead_s)
        self._has_processes = run.plan.launcher_pid > 0  # a replay has none
        self._pilot: m.PilotStatus | None = None
        self._pilot_heard_s = -math.inf
        self._brake = False
        self._strategy = ""
        self._dead: tuple[str, ...] = ()
        self._note = ""
        self._sent_s = -math.inf
        self._ticking: asyncio.TimerHandle | None = None
        state.picture.section("operating")
        self.show()

    def start(self) -> None:
        """Let go of the stick in case a former life of the HMI died while a page held it."""
        self._actor.publish(topics.JOYSTICK, _LET_GO)

    # -- wishes ---------------------------------------------------------------------------------

    def introduction(self, page: int) -> dict[str, Any]:
        """Return what a page needs to know to offer all this."""
        return {"type": "operating", "page": page, "strategies": list(self._choice.strategies),
                "signals": list(SIGNALS) if self._has_processes else [],
                "silence_s": SILENCE_S, "ticket_s": TICKET_S, **self._injections.choice()}

    def fulfil(self, wish: OperatingWish, page: int) -> str | dict[str, Any]:
        """Act on a wish of a page and return what to tell it.

        Raises:
            RefusedError: it cannot be fulfilled; the text says why.
        """
        try:
            match wish:
                case StickWish():
                    return self._stick(wish, page)
                case AdaptWish():
                    request = self._choice.ask(wish.name, self._strategy, self._now())
                    self._actor.publish(ftm_topics.ADAPT, request)
                    told = f"strategy {wish.name} asked for"
                case SignalWish():
                    told = self._send_signal(wish, page)
                case InjectWish():
                    told = self._inject(wish)
                case EndFaultWish():
                    for order in self._injections.end(wish.injection, self._now()):
                        self._order(order)
                    told = "end of the fault asked for"
        except (ChoiceError, FaultError, SignalError) as error:
            raise RefusedError(str(error)) from None
        self.show()
        return told

    def left(self, page: int) -> None:
        """Take note that a page was closed; if it drove, the robot stops."""
        if self._desk.gone(page):
            self._release("the page that drove was closed")

    def _send_signal(self, wish: SignalWish, page: int) -> str:
        if not self._has_processes:
            raise SignalError("the nodes of this run have no processes that could be signalled")
        node, name, port = wish.node, wish.signal, self._actor.context.run.plan.base_port
        if name not in SIGNALS:
            raise SignalError(f"unknown signal {name[:20]!r}; known: {', '.join(SIGNALS)}")
        if node == self._actor.name:  # whoever asked is to be told first
            asyncio.get_running_loop().call_later(
                OWN_DEATH_S, lambda: signal_node(node, name, port))
            told = f"{node}: {name}; the page will be back"
        else:
            victim = signal_node(node, name, port)
            told = f"{node} (pid {victim.pid}): {name}"
        self._state.log(self._now(), "note", f"page {page} sent {told}")
        return told

    def _inject(self, wish: InjectWish) -> str:
        lasts_s = math.inf if wish.permanent else wish.duration_s
        ordered = self._injections.order(wish.fault, wish.delay_s, lasts_s, self._now())
        self._send_due()
        when = f" in {wish.delay_s:g} s" if wish.delay_s else ""
        lasts = ("until its process ends" if math.isinf(ordered.duration_s)
                 else f"for {ordered.duration_s:g} s")
        return f"fault {wish.fault} asked for{when}, {lasts}"

    def _send_due(self) -> None:
        for order in self._injections.due(self._now()):
            self._order(order)

    def _order(self, order: Order) -> None:
        self._actor.publish(order.topic, order.message)

    # -- the stick ------------------------------------------------------------------------------

    def _stick(self, wish: StickWish, page: int) -> dict[str, Any]:
        loop = asyncio.get_running_loop()
        before = self._desk.holder
        answer = self._desk.move(page, wish, loop.time())
        if answer.grip is Grip.DRIVES:
            self._drive()
            if before != page:
                self._note = ""
                self.show()
        elif before is not None and self._desk.holder is None:
            self._release(answer.text)
        return {"type": "stick", "grip": answer.grip, "text": answer.text, "ticket": answer.ticket}

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

    def stop(self) -> None:
        """Let go of the stick; the HMI ends."""
        if self._ticking is not None:
            self._ticking.cancel()
            self._ticking = None
        if self._desk.holder is not None:
            self._actor.publish(topics.JOYSTICK, _LET_GO)

    # -- what it hears --------------------------------------------------------------------------

    def repeat(self) -> None:
        """Send again what was not answered, and give up on what never will be."""
        now = self._now()
        self._announce(self._choice.expire(now))
        if self._choice.pending is not None:
            self._actor.publish(ftm_topics.ADAPT, self._choice.pending)
        for told in self._injections.expire(now):
            self._announce(told)
        self._send_due()
        self.show()

    def answered(self, message: fm.AdaptationAnswer) -> None:
        """Hear whether a strategy was accepted."""
        self._announce(self._choice.answer(message))

    def injected(self, message: bm.InjectionReport) -> None:
        """Hear what came of a fault."""
        self._announce(self._injections.hear(message))
        self.show()

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

    def manager(self, message: fm.ManagerStatus) -> None:
        """Hear the FTM Manager: its strategy."""
        if message.strategy != self._strategy:
            self._strategy = message.strategy
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

    def _announce(self, told: str) -> None:
        if told:
            self._state.announce(told, self._now())
            self.show()

    def show(self) -> None:
        """Show pages who drives, whether that has an effect, the strategy and the faults."""
        now = self._now()
        pilot = self._pilot
        patience_s = max(_STALE_S, 0.5 * self._actor.clock.rate)
        works, text = effect(
            pilot_heard=now - self._pilot_heard_s <= patience_s,
            mode=pilot.mode if pilot else "", forbids=pilot.forbids if pilot else "",
            brake=self._brake, dead_nodes=self._dead)
        pending = self._choice.pending
        self._state.picture.put("operating", {
            "holder": self._desk.holder, "works": works, "text": text, "note": self._note,
            "strategy": self._strategy, "strategy_asked": bool(pending),
            "faults": self._injections.view(now)})

    def _now(self) -> float:
        return self._actor.clock.now()


def places_of(system: SystemSpec) -> tuple[str, ...]:
    """Return the keys at which the page offers to inject: the common ones, then the robot's own."""
    known = declared_topics(system)
    common = places(known, [n.name for n in system.nodes],
                    [d.name for d in system.detections], [r.name for r in system.recoveries])
    own = [key for key in published_keys(system) if find_topic(key, known) is None]
    return (*common, *own)
