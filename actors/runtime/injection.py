"""Fault injection at the source of messages: a gate in each actor's publish path.

A fault on a topic acts in the process that publishes it, so every reader sees the same fault, and
the real bus carries the result.

A message counts as affected if the gate has changed it. A freeze of a robot that stands still, or a
speed set to its present value, has no effect, and a fault without effect must not count as
survived. The effect on readers is not known here: a duplicate counts although readers refuse it.

`FaultGate` decides what happens to a message, and is pure. `InjectedFaults` has the timers and the
reports of one actor.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random
from typing import Any, Protocol

import msgspec

from rampart.actors.bus.bounds import clip
from rampart.actors.bus.messages import Injection, InjectionReport
from rampart.actors.bus.topic import ROOT, Topic
from rampart.actors.bus.topics import INJECT, INJECTION_REPORT
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.corruption import InjectionError, check_fields, corrupt
from rampart.actors.runtime.timer import Timer

MODES = ("drop", "freeze", "stuck", "delay", "duplicate", "restamp", "corrupt")

MAX_IN_FORCE = 64
"""Injections in force per actor."""

MAX_DELAYED = 10_000
"""Delayed messages per actor; further ones are dropped, and reported."""

UNTOUCHED = (INJECT.key, INJECTION_REPORT.key)
"""Keys of injections and of reports on them, which cannot be disturbed."""


@dataclass(slots=True)
class Outgoing:
    """A message as it leaves the gate: `delay_s` later, `copies` times."""

    body: Any
    stamp: float
    delay_s: float = 0.0
    copies: int = 1


@dataclass(slots=True)
class _Active:
    order: Injection
    key: str
    since_s: float
    draw: Random
    affected: int = 0
    frozen: Outgoing | None = None

    def strikes(self, now_s: float) -> bool:
        """Whether the fault affects a message that leaves now."""
        order = self.order
        period_s = order.on_s + order.off_s
        if period_s > 0 and (now_s - self.since_s) % period_s >= order.on_s:
            return False
        return order.share >= 1.0 or self.draw.random() < order.share


@dataclass(slots=True)
class FaultGate:
    """The injections in force in one actor. Pure: time is an argument, chance is seeded.

    Injections on one topic act in the order in which they were ordered.

    Attributes:
        in_force: injections by id; while it is empty, messages need not pass the gate.
        last: body and stamp of the last message by key, for a freeze to repeat.
    """

    in_force: dict[str, _Active] = field(default_factory=dict)
    last: dict[str, tuple[Any, float]] = field(default_factory=dict)
    _news: list[tuple[Injection, int, str]] = field(default_factory=list)

    def order(self, injection: Injection, now_s: float, kind: type[Any] | None = None) -> str:
        """Put an injection in force; return why it is refused, or "".

        Args:
            injection: replaces an injection with the same id, and continues its count.
            now_s: simulated time.
            kind: type of the topic's messages, to check the fields against.
        """
        if reason := flaw(injection, kind):
            return reason
        before = self.in_force.pop(injection.injection, None)
        self.in_force[injection.injection] = _Active(
            injection, f"{ROOT}/{injection.topic}", now_s, Random(injection.seed),  # noqa: S311
            before.affected if before else 0)
        return ""

    def expire(self, injection: str) -> int:
        """End an injection and return how many messages it changed."""
        active = self.in_force.pop(injection, None)
        return active.affected if active else 0

    def apply(self, key: str, body: Any, stamp: float, now_s: float) -> Outgoing | None:
        """Return the message after the faults in force, or None if it is dropped.

        A fault that does not fit the message leaves it unchanged and ends; `take_news` reports it.
        """
        out = Outgoing(body, stamp)
        for active in [a for a in self.in_force.values() if a.key == key]:
            if not active.strikes(now_s):
                active.frozen = None  # the next freeze repeats the last healthy message
                continue
            try:
                changed = self._disturb(active, out, now_s)
            except InjectionError as error:
                del self.in_force[active.order.injection]
                self._news.append((active.order, active.affected, str(error)))
                continue
            if changed is None or changed != out:
                active.affected += 1
                if active.affected == 1:
                    self._news.append((active.order, active.affected, ""))
            if changed is None:
                return None
            out = changed
        return out

    def take_news(self) -> list[tuple[Injection, int, str]]:
        """Return the injections with a first effect, or an early end: order, count, reason."""
        news, self._news = self._news, []
        return news

    def _disturb(self, active: _Active, out: Outgoing, now_s: float) -> Outgoing | None:
        order = active.order
        match order.mode:
            case "drop":
                return None
            case "delay":
                return Outgoing(out.body, out.stamp, out.delay_s + order.delay_s, out.copies)
            case "duplicate":
                return Outgoing(out.body, out.stamp, out.delay_s, out.copies + 1)
            case "restamp":
                return Outgoing(out.body, out.stamp + order.stamp_s, out.delay_s, out.copies)
            case "corrupt":
                body = corrupt(out.body, order, now_s - active.since_s, active.draw)
                return Outgoing(body, out.stamp, out.delay_s, out.copies)
        if active.frozen is None:
            last = self.last.get(active.key)
            active.frozen = Outgoing(*last) if last else out
        stamp = active.frozen.stamp if order.mode == "freeze" else out.stamp
        return Outgoing(active.frozen.body, stamp, out.delay_s, out.copies)


def flaw(order: Injection, kind: type[Any] | None = None) -> str:
    """Return what is wrong with an injection, in one line, or "".

    Args:
        order: the injection.
        kind: type of the topic's messages; None leaves the fields unchecked.
    """
    reason = _wrong_kind(order) or _wrong_time(order) or _wrong_number(order)
    if not reason and kind is not None and order.mode == "corrupt":
        try:
            check_fields(kind, order)
        except InjectionError as error:
            return str(error)
    return reason


def _wrong_kind(order: Injection) -> str:
    if order.mode not in MODES:
        return f"mode = {order.mode!r}: expected one of {', '.join(MODES)}"
    if order.topic in UNTOUCHED:
        return f"topic = {order.topic!r}: carries injections and cannot be disturbed"
    changes = (order.set_fields, order.ramp_fields, order.add_fields, order.noise_fields,
               order.keep_ends)
    if order.mode == "corrupt" and not any(changes):
        return ("mode = 'corrupt': expected set_fields, ramp_fields, add_fields, noise_fields or "
                "keep_ends")
    return ""


def _wrong_time(order: Injection) -> str:
    if not order.duration_s >= 0:
        return f"duration_s = {order.duration_s:g}: expected 0 or more, inf for permanent"
    for name, value_s in (
            ("delay_s", order.delay_s), ("on_s", order.on_s), ("off_s", order.off_s)):
        if not (value_s >= 0 and math.isfinite(value_s)):
            return f"{name} = {value_s:g}: expected seconds, 0 or more"
    if (order.on_s > 0) != (order.off_s > 0):
        return (f"on_s = {order.on_s:g}, off_s = {order.off_s:g}: expected both above 0 for an "
                "intermittent fault, otherwise both 0")
    if order.mode == "delay" and not order.delay_s > 0:
        return "delay_s = 0: expected seconds above 0 for a delay"
    if not math.isfinite(order.stamp_s) or (order.mode == "restamp" and order.stamp_s == 0):
        return (f"stamp_s = {order.stamp_s:g}: expected finite seconds; for a restamp above 0 "
                "(ahead) or below 0 (behind)")
    return ""


def _wrong_number(order: Injection) -> str:
    if not 0 <= order.share <= 1:
        return f"share = {order.share:g}: expected 0 to 1"
    for what, numbers, least, expected in (
            ("ramp_fields", order.ramp_fields, -math.inf, "finite"),
            ("add_fields", order.add_fields, -math.inf, "finite"),
            ("noise_fields", order.noise_fields, 0.0, "finite, 0 or more")):
        for path, value in numbers.items():
            if not (math.isfinite(value) and value >= least):
                return f"{what} {path!r} = {value:g}: expected a number, {expected}"
    return ""


class Publisher(Protocol):
    """The part of an `Actor` that `InjectedFaults` needs."""

    name: str
    clock: Clock

    def publish(self, topic: Topic[Any], body: msgspec.Struct) -> None:
        """Publish a message through the faults in force."""

    def send(self, topic: Topic[Any], key: str, body: msgspec.Struct, stamp: float,
             copies: int = 1) -> None:
        """Send a message past all injected faults."""

    def call_later(self, delay_s: float, call: Callable[[], None]) -> Timer:
        """Call `call` after `delay_s` simulated seconds."""

    def report_diagnostic(self, context: str, reason: str, offender: str) -> None:
        """Publish an error report."""


class InjectedFaults:
    """The injections of one actor.

    Attributes:
        gate: the injections in force, and the last messages.
    """

    def __init__(self, actor: Publisher) -> None:
        self.gate = FaultGate()
        self._actor = actor
        self._ends: dict[str, Timer] = {}
        self._delayed = 0

    def order(self, order: Injection, topic: Topic[Any]) -> None:
        """Put an injection in force on a topic that the actor publishes, and report it."""
        in_force = self.gate.in_force
        if len(in_force) >= MAX_IN_FORCE and order.injection not in in_force:
            reason = f"{MAX_IN_FORCE} injections are in force, the most; wait for one to end"
        else:
            reason = self.gate.order(order, self._actor.clock.now(), topic.type)
        self._report(order.injection, 0, bool(reason), reason)
        if reason:
            return
        self._cancel_end(order.injection)  # of an earlier order with the same id
        if order.duration_s <= 0:
            self._over(order.injection)
        elif order.duration_s < math.inf:
            self._ends[order.injection] = self._actor.call_later(
                order.duration_s, lambda: self._over(order.injection))

    def send(self, topic: Topic[Any], key: str, body: msgspec.Struct, stamp: float) -> None:
        """Send a message as the injections in force change it."""
        actor = self._actor
        out = self.gate.apply(key, body, stamp, actor.clock.now())
        if out is not None and out.delay_s > 0:
            self._send_later(out.delay_s, lambda: actor.send(
                topic, key, out.body, out.stamp, out.copies))
        elif out is not None:
            actor.send(topic, key, out.body, out.stamp, out.copies)
        for order, affected, reason in self.gate.take_news():
            if reason:
                self._cancel_end(order.injection)
                actor.report_diagnostic("fault injection", reason, order.topic)
            self._report(order.injection, affected, bool(reason), reason)

    def _send_later(self, delay_s: float, send: Callable[[], None]) -> None:
        if self._delayed >= MAX_DELAYED:
            self._actor.report_diagnostic(
                "fault injection", f"{MAX_DELAYED} messages are delayed, the most; one was dropped",
                self._actor.name)
            return

        def due() -> None:
            self._delayed -= 1
            send()

        self._delayed += 1
        self._actor.call_later(delay_s, due)

    def _over(self, injection: str) -> None:
        self._cancel_end(injection)
        self._report(injection, self.gate.expire(injection), True)

    def _report(self, injection: str, affected: int, finished: bool, reason: str = "") -> None:
        self._actor.publish(INJECTION_REPORT, InjectionReport(
            injection, self._actor.name, affected, finished, clip(reason)))

    def _cancel_end(self, injection: str) -> None:
        timer = self._ends.pop(injection, None)
        if timer is not None:
            timer.cancel()
