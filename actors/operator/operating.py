"""Actions of an operator on every page: drive, choose a strategy, send signals, inject faults.

`injection` keeps the faults that were ordered, and `stick` decides who drives. This module connects
them to topics and to the page. The FTM Manager checks a changed strategy like a new system, and
answers at once, with the reason of a refusal.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import count
from typing import TYPE_CHECKING, Any

import msgspec

from rampart.actors.bus import messages as bm
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.operator import requests
from rampart.actors.operator.injection import Injections, places_of
from rampart.actors.operator.panels import Panel
from rampart.actors.operator.requests import Pending, RefusedError, Request
from rampart.actors.operator.stick import Stick
from rampart.actors.supervision.kill_node import SIGNALS, SignalError, UnknownNodeError, signal_node
from rampart.manager.strategies.registry import STRATEGIES

if TYPE_CHECKING:
    from rampart.actors.operator.state import HmiState
    from rampart.actors.runtime.fault_watch import Order
from rampart.actors.runtime.actor import Actor

OVERHEAD_S = 1.0
"""Real seconds added for sockets, scheduling and restarts, which take no simulated time."""

GIVE_UP_S = 5.0
"""Simulated seconds without an answer after which the choice of a strategy is withdrawn."""

OWN_DEATH_S = 0.2
"""Real seconds between the answer to a page that kills its own node, and the signal."""


class Operating:
    """Actions of an operator; a robot's page may use a derived class.

    Args:
        actor: the page's node.
        state: contents of the page; the section "operating" belongs to this class.
        panels: of the page, with its sticks.

    Attributes:
        drove: called with page, panel, whether the page holds its stick now, and why not.
    """

    def __init__(self, actor: Actor, state: HmiState, panels: Sequence[Panel]) -> None:
        run = actor.context.run
        prefix = f"{run.plan.run_id}/{actor.name}.{actor.context.incarnation}"
        self.drove: Callable[[int, str, bool, str], None] = lambda *_: None
        self._actor = actor
        self._state = state
        overhead_s = OVERHEAD_S * actor.clock.rate
        self._choice = Pending[fm.AdaptationRequest](
            f"{prefix}.s", "not set: no answer from the FTM Manager", GIVE_UP_S + overhead_s)
        try:
            places = places_of(run.system)
        except ValueError:  # a replay, where the robot's own classes are not installed
            places = ()
        self._injections = Injections(f"{prefix}.f", run.plan.faults, places,
                                      (*run.application.topics, *actor.context.topics.values()),
                                      overhead_s)
        self._orders = (f"{prefix}.k{number}" for number in count(1))
        self._elsewhere: frozenset[str] = frozenset()
        self._has_processes = run.plan.launcher_pid > 0  # a replay has none
        self._strategy = ""
        self._sticks = {panel.title: Stick(actor, panel, partial(self._stick_changed, panel.title))
                        for panel in panels if panel.stick}
        state.picture.section("operating")
        self.show()

    def start(self) -> None:
        """Start the sticks, before the page is served."""
        for stick in self._sticks.values():
            stick.start()

    def stop(self) -> None:
        """Stop the sticks."""
        for stick in self._sticks.values():
            stick.stop()

    # -- requests -------------------------------------------------------------------------------

    def introduction(self, page: int) -> dict[str, Any]:
        """Return the message that announces these actions to a page."""
        return {"type": "operating", "page": page, "strategies": [*STRATEGIES],
                "signals": [*SIGNALS] if self._has_processes else [], **self._injections.choice()}

    def fulfil(self, request: Request, page: int) -> str | dict[str, Any]:
        """Act on a request of a page and return the answer.

        Raises:
            RefusedError: it cannot be fulfilled; the text is the reason.
        """
        try:
            match request:
                case requests.StickRequest():
                    return self._stick(request.panel).move(page, request)
                case requests.StrategyRequest():
                    answer = self._choose(request.name)
                case requests.SignalRequest():
                    answer = self._send_signal(request, page)
                case requests.InjectRequest():
                    answer = self._inject(request)
                case requests.EndFaultRequest():
                    self._order(self._injections.end(request.injection, self._now()))
                    answer = "end of the fault requested"
                case _:
                    raise RefusedError("this page does not offer that")
        except SignalError as error:
            raise RefusedError(str(error)) from None
        self.show()
        return answer

    def left(self, page: int) -> None:
        """Release the sticks of a page that was closed."""
        for stick in self._sticks.values():
            stick.left(page)

    def _stick(self, panel: str) -> Stick:
        if panel not in self._sticks:
            raise RefusedError(f"no stick {panel[:40]!r}; known: "
                               f"{', '.join(self._sticks) or 'none'}")
        return self._sticks[panel]

    def _stick_changed(self, panel: str, page: int, held: bool, why: str) -> None:
        self.drove(page, panel, held, why)
        if why:
            self._state.log(self._now(), "note", f"{panel}: stick released: {why}")
        self.show()

    def _choose(self, strategy: str) -> str:
        if strategy not in STRATEGIES:
            raise RefusedError(f"no strategy {strategy[:40]!r}; known: {', '.join(STRATEGIES)}")
        number = self._choice.new_id()
        if strategy == self._strategy:
            raise RefusedError(f"strategy {strategy} is in force already")
        value = msgspec.json.encode({"value": strategy}).decode()
        self._actor.publish(ftm_topics.ADAPT, self._choice.put(
            f"strategy {strategy}",
            fm.AdaptationRequest(number, "set", "strategy", value, "operator"), self._now()))
        return f"strategy {strategy} requested"

    def _send_signal(self, request: requests.SignalRequest, page: int) -> str:
        if not self._has_processes:
            raise SignalError("the nodes of this run have no processes")
        node, name, port = request.node, request.signal, self._actor.context.run.plan.base_port
        if name not in SIGNALS:
            raise SignalError(f"unknown signal {name[:20]!r}; known: {', '.join(SIGNALS)}")
        if node == self._actor.name:  # after the answer to the page
            asyncio.get_running_loop().call_later(
                OWN_DEATH_S, lambda: signal_node(node, name, port))
            done = f"{node}: {name}; the page will reconnect"
        else:
            try:
                victim = signal_node(node, name, port)
                done = f"{node} (pid {victim.pid}): {name}"
            except UnknownNodeError:
                if node not in self._elsewhere:
                    raise
                self._actor.publish(
                    ftm_topics.SIGNAL, fm.SignalOrder(next(self._orders), node, name))
                done = f"{node}: {name}, by the supervisor of its host"
        self._state.log(self._now(), "note", f"page {page} sent {done}")
        return done

    def _inject(self, request: requests.InjectRequest) -> str:
        lasts_s = math.inf if request.permanent else request.duration_s
        ordered = self._injections.order(request.fault, lasts_s, self._now())
        self._order(self._injections.due())
        lasts = ("until its process ends" if math.isinf(ordered.duration_s)
                 else f"for {ordered.duration_s:g} s")
        return f"fault {request.fault} requested, {lasts}"

    def _order(self, orders: Sequence[Order]) -> None:
        for order in orders:
            self._actor.publish(order.topic, order.message)

    # -- messages -------------------------------------------------------------------------------

    def repeat(self) -> None:
        """Repeat unanswered messages, and withdraw those that are too old."""
        now = self._now()
        self._announce(self._choice.expire(now))
        if self._choice.pending is not None:
            self._actor.publish(ftm_topics.ADAPT, self._choice.pending)
        for line in self._injections.expire(now):
            self._announce(line)
        self._order(self._injections.due())
        self.show()

    def answered(self, message: fm.AdaptationAnswer) -> None:
        """Take the manager's answer to a strategy."""
        if self._choice.pending is not None and message.request == self._choice.pending.request:
            self._announce(self._choice.settle() + (
                f" is in force, change {message.version} of the run" if message.accepted
                else f" refused: {message.reason}"))

    def injected(self, message: bm.InjectionReport) -> None:
        """Take a report about a fault."""
        self._announce(self._injections.take(message))
        self.show()

    def manager(self, message: fm.ManagerStatus) -> None:
        """Take the strategy in force."""
        if message.strategy != self._strategy:
            self._strategy = message.strategy
            self.show()

    def nodes(self, table: fm.NodeTable) -> None:
        """Take the nodes on other hosts."""
        own = self._actor.context.run.plan.host
        self._elsewhere = frozenset(row.name for row in table.nodes if row.host != own)

    def diagnostic(self, report: bm.Diagnostic) -> None:
        """Take an error report of a node."""

    # -- the page -------------------------------------------------------------------------------

    def _announce(self, line: str) -> None:
        if line:
            self._state.announce(line, self._now())
            self.show()

    def effect(self, panel: str, now_s: float) -> tuple[bool, str]:  # noqa: ARG002
        """Return whether a panel's stick has an effect now, and a text about that."""
        return True, ""

    def _view_stick(self, panel: str, stick: Stick, now_s: float) -> dict[str, Any]:
        works, text = self.effect(panel, now_s)
        return {"holder": stick.holder, "works": works, "text": text, "note": stick.note}

    def view(self, now_s: float) -> dict[str, Any]:
        """Return the section "operating": sticks, strategy and faults."""
        return {"sticks": {panel: self._view_stick(panel, stick, now_s)
                           for panel, stick in self._sticks.items()},
                "strategy": self._strategy, "strategy_asked": self._choice.pending is not None,
                "faults": self._injections.view()}

    def show(self) -> None:
        """Update the section "operating"."""
        self._state.picture.put("operating", self.view(self._now()))

    def _now(self) -> float:
        return self._actor.clock.now()
