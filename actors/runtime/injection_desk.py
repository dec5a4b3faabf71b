"""What an actor does about fault injections: takes orders, ends them in time, tells what became.

`rampart.actors.runtime.injection` decides what happens to a message; here are the timers and the
reports.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import msgspec

from rampart.actors.bus.bounds import clip
from rampart.actors.bus.messages import Injection, InjectionReport
from rampart.actors.bus.topic import Topic
from rampart.actors.bus.topics import INJECTION_REPORT
from rampart.actors.runtime.injection import FaultGate, News
from rampart.actors.runtime.timer import Timer

if TYPE_CHECKING:
    from rampart.actors.runtime.actor import Actor


MAX_IN_FORCE = 64
"""Injections of one actor at a time."""

MAX_DELAYED = 10_000
"""Messages of one actor that an injection may hold back at a time; more are lost, and reported."""


class InjectionDesk:
    """The injections of one actor.

    Attributes:
        gate: Those in force, and what was sent last.
    """

    def __init__(self, actor: Actor) -> None:
        self.gate = FaultGate()
        self._actor = actor
        self._ends: dict[str, Timer] = {}
        self._delayed = 0

    def order(self, order: Injection) -> None:
        """Put an injection in force, if it concerns a topic that the actor publishes."""
        actor = self._actor
        topic = actor.published(order.topic)
        if topic is None:
            return
        in_force = self.gate.in_force
        if len(in_force) >= MAX_IN_FORCE and order.injection not in in_force:
            reason = f"{MAX_IN_FORCE} injections are in force; wait for one to end"
        else:
            reason = self.gate.order(order, actor.clock.now(), topic.type)
        actor.publish(INJECTION_REPORT, InjectionReport(
            order.injection, actor.name, 0, bool(reason), clip(reason)))
        if reason:
            return
        self._forget_end(order.injection)  # of an earlier order with the same id
        if order.duration_s <= 0:
            self._over(order.injection)
        elif order.duration_s < math.inf:
            self._ends[order.injection] = actor.call_later(
                order.duration_s, lambda: self._over(order.injection))

    def send(self, topic: Topic[Any], key: str, body: msgspec.Struct, stamp: float) -> None:
        """Send what the injections in force leave of a message, when they let it go."""
        actor = self._actor
        out = self.gate.apply(key, body, stamp, actor.clock.now())
        if out is not None and out.delay_s > 0:
            self._send_later(out.delay_s, lambda: actor.send(
                topic, key, out.body, out.stamp, out.copies))
        elif out is not None:
            actor.send(topic, key, out.body, out.stamp, out.copies)
        for news in self.gate.take_news():
            self._tell(news)

    def _send_later(self, delay_s: float, send: Callable[[], None]) -> None:
        if self._delayed >= MAX_DELAYED:
            self._actor.report_diagnostic(
                "fault injection", f"more than {MAX_DELAYED} messages are delayed; one was dropped",
                self._actor.name)
            return

        def due() -> None:
            self._delayed -= 1
            send()

        self._delayed += 1
        self._actor.call_later(delay_s, due)

    def _over(self, injection: str) -> None:
        self._forget_end(injection)
        affected = self.gate.expire(injection)
        self._actor.publish(INJECTION_REPORT, InjectionReport(
            injection, self._actor.name, affected, True, ""))

    def _tell(self, news: News) -> None:
        """Report the first effect of an injection, or that it ended early and why."""
        actor = self._actor
        if news.finished:
            self._forget_end(news.injection)
            actor.report_diagnostic("fault injection", news.reason, news.topic)
        actor.publish(INJECTION_REPORT, InjectionReport(
            news.injection, actor.name, news.affected, news.finished, clip(news.reason)))

    def _forget_end(self, injection: str) -> None:
        timer = self._ends.pop(injection, None)
        if timer is not None:
            timer.cancel()
