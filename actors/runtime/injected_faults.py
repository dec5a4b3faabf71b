"""The faults injected into one actor: ordered, put upon what it publishes, ended in time, reported.

`rampart.actors.runtime.injection` decides what happens to a message; here are the timers and the
reports.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Protocol

import msgspec

from rampart.actors.bus.bounds import clip
from rampart.actors.bus.messages import Injection, InjectionReport
from rampart.actors.bus.topic import Topic
from rampart.actors.bus.topics import INJECTION_REPORT
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.injection import FaultGate
from rampart.actors.runtime.timer import Timer

MAX_IN_FORCE = 64
"""Injections of one actor at a time."""

MAX_DELAYED = 10_000
"""Messages of one actor that an injection may hold back at a time; more are lost, and reported."""


class Publisher(Protocol):
    """What publishes the messages that faults are put upon; an actor is one."""

    name: str
    clock: Clock

    def publish(self, topic: Topic[Any], body: msgspec.Struct) -> None:
        """Send a message through the faults in force."""

    def send(self, topic: Topic[Any], key: str, body: msgspec.Struct, stamp: float,
             copies: int = 1) -> None:
        """Send a message past all faults."""

    def call_later(self, delay_s: float, call: Callable[[], None]) -> Timer:
        """Have `call` made after `delay_s` simulated seconds."""

    def report_diagnostic(self, context: str, reason: str, offender: str) -> None:
        """Publish an error report."""


class InjectedFaults:
    """The injections of one actor.

    Attributes:
        gate: Those in force, and what was sent last.
    """

    def __init__(self, publisher: Publisher) -> None:
        self.gate = FaultGate()
        self._publisher = publisher
        self._ends: dict[str, Timer] = {}
        self._delayed = 0

    def order(self, order: Injection, topic: Topic[Any]) -> None:
        """Put an injection in force on a topic that the actor publishes, and report it."""
        in_force = self.gate.in_force
        if len(in_force) >= MAX_IN_FORCE and order.injection not in in_force:
            reason = f"{MAX_IN_FORCE} injections are in force; wait for one to end"
        else:
            reason = self.gate.order(order, self._publisher.clock.now(), topic.type)
        self._report(order.injection, 0, bool(reason), reason)
        if reason:
            return
        self._forget_end(order.injection)  # of an earlier order with the same id
        if order.duration_s <= 0:
            self._over(order.injection)
        elif order.duration_s < math.inf:
            self._ends[order.injection] = self._publisher.call_later(
                order.duration_s, lambda: self._over(order.injection))

    def send(self, topic: Topic[Any], key: str, body: msgspec.Struct, stamp: float) -> None:
        """Send what the injections in force leave of a message, when they let it go."""
        publisher = self._publisher
        out = self.gate.apply(key, body, stamp, publisher.clock.now())
        if out is not None and out.delay_s > 0:
            self._send_later(out.delay_s, lambda: publisher.send(
                topic, key, out.body, out.stamp, out.copies))
        elif out is not None:
            publisher.send(topic, key, out.body, out.stamp, out.copies)
        for news in self.gate.take_news():  # the first effect of one, or that it ended early
            if news.finished:
                self._forget_end(news.injection)
                publisher.report_diagnostic("fault injection", news.reason, news.topic)
            self._report(news.injection, news.affected, news.finished, news.reason)

    def _send_later(self, delay_s: float, send: Callable[[], None]) -> None:
        if self._delayed >= MAX_DELAYED:
            self._publisher.report_diagnostic(
                "fault injection", f"more than {MAX_DELAYED} messages are delayed; one was dropped",
                self._publisher.name)
            return

        def due() -> None:
            self._delayed -= 1
            send()

        self._delayed += 1
        self._publisher.call_later(delay_s, due)

    def _over(self, injection: str) -> None:
        self._forget_end(injection)
        self._report(injection, self.gate.expire(injection), True)

    def _report(self, injection: str, affected: int, finished: bool, reason: str = "") -> None:
        self._publisher.publish(INJECTION_REPORT, InjectionReport(
            injection, self._publisher.name, affected, finished, clip(reason)))

    def _forget_end(self, injection: str) -> None:
        timer = self._ends.pop(injection, None)
        if timer is not None:
            timer.cancel()
