"""Fault injection where messages are born: a gate in each actor's publish path.

A fault on a topic acts in the process that publishes it, so every reader sees the same fault,
and it is the real bus that carries (or does not carry) the result.

What counts as affected is a message that left otherwise than it came: a freeze of a robot that
stands still, or a speed set to the value it has anyway, is no effect, and a fault that never had
one must not be counted as survived. What the readers make of it is not known here: a duplicate
counts although it is refused on arrival.

`FaultGate` decides what happens to a message, and is pure; `InjectedFaults` has the timers and the
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
from rampart.actors.bus.topics import INJECT, INJECTION_REPORT, INJECTION_REQUEST, INJECTION_RESULT
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.corruption import InjectionError, check_fields, corrupt
from rampart.actors.runtime.timer import Timer

MODES = ("drop", "freeze", "stuck", "delay", "duplicate", "restamp", "corrupt")

MAX_IN_FORCE = 64
"""Injections of one actor at a time."""

MAX_DELAYED = 10_000
"""Messages of one actor that an injection may hold back at a time; more are lost, and reported."""

UNTOUCHED = (INJECT.key, INJECTION_REPORT.key, INJECTION_REQUEST.key, INJECTION_RESULT.key)
"""Keys that carry injections and their results, and therefore cannot be disturbed."""


@dataclass(slots=True)
class Outgoing:
    """One message as it leaves: `delay_s` later, and `copies` times the same payload."""

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
        """Whether a message that leaves now is one of those to be affected."""
        order = self.order
        period_s = order.on_s + order.off_s
        if period_s > 0 and (now_s - self.since_s) % period_s >= order.on_s:
            return False
        return order.share >= 1.0 or self.draw.random() < order.share


@dataclass(slots=True)
class FaultGate:
    """The injections in force in one actor. Pure: time is an argument, chance is seeded.

    Several on one topic act in the order in which they were ordered.

    Attributes:
        in_force: injections by id; while empty, nothing needs to pass the gate.
        last: body and stamp last sent per key, by any sender, so that a freeze has something
            to repeat.
    """

    in_force: dict[str, _Active] = field(default_factory=dict)
    last: dict[str, tuple[Any, float]] = field(default_factory=dict)
    _news: list[tuple[Injection, int, str]] = field(default_factory=list)

    def order(self, injection: Injection, now_s: float, kind: type[Any] | None = None) -> str:
        """Put an injection in force; return the reason if it cannot be, else an empty text.

        Args:
            injection: takes the place of one with the same id, whose count goes on.
            now_s: now, simulated seconds.
            kind: type of the topic's messages, if known, to check the fields against.
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
        """Return the message as the faults in force leave it, or None if it is dropped.

        A fault that turns out not to fit the message ends here, is told by `take_news`, and
        leaves the message alone.
        """
        out = Outgoing(body, stamp)
        for active in [a for a in self.in_force.values() if a.key == key]:
            if not active.strikes(now_s):
                active.frozen = None  # the next freeze repeats what is healthy now
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
        """Return what had its first effect since, or ended early: with its count, and why."""
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
    """Return what is wrong with an injection, in one line, or an empty text.

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
        return f"mode = {order.mode!r}: must be one of {', '.join(MODES)}"
    if order.topic in UNTOUCHED:
        return f"topic = {order.topic!r}: it carries injections and cannot be disturbed"
    changes = (order.set_fields, order.ramp_fields, order.add_fields, order.noise_fields,
               order.keep_ends)
    if order.mode == "corrupt" and not any(changes):
        return "mode = 'corrupt': no field is set, ramped, added to, made noisy or shortened"
    return ""


def _wrong_time(order: Injection) -> str:
    if not order.duration_s >= 0:
        return f"duration_s = {order.duration_s:g}: must be 0 or more, inf for permanent"
    for name, value_s in (
            ("delay_s", order.delay_s), ("on_s", order.on_s), ("off_s", order.off_s)):
        if not (value_s >= 0 and math.isfinite(value_s)):
            return f"{name} = {value_s:g}: must be seconds, 0 or more"
    if (order.on_s > 0) != (order.off_s > 0):
        return (f"on_s = {order.on_s:g}, off_s = {order.off_s:g}: an intermittent fault needs "
                "both above 0, any other both 0")
    if order.mode == "delay" and not order.delay_s > 0:
        return "delay_s = 0: must be above 0 for a delay"
    if not math.isfinite(order.stamp_s) or (order.mode == "restamp" and order.stamp_s == 0):
        return (f"stamp_s = {order.stamp_s:g}: must be finite seconds, above 0 to stamp ahead, "
                "below 0 behind, not 0 for a restamp")
    return ""


def _wrong_number(order: Injection) -> str:
    if not 0 <= order.share <= 1:
        return f"share = {order.share:g}: must be between 0 and 1"
    for what, numbers, least, right in (
            ("ramp_fields", order.ramp_fields, -math.inf, "finite"),
            ("add_fields", order.add_fields, -math.inf, "finite"),
            ("noise_fields", order.noise_fields, 0.0, "finite, 0 or more")):
        for path, value in numbers.items():
            if not (math.isfinite(value) and value >= least):
                return f"{what} {path!r} = {value:g}: must be {right}"
    return ""


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
        for order, affected, reason in self.gate.take_news():
            if reason:
                self._forget_end(order.injection)
                publisher.report_diagnostic("fault injection", reason, order.topic)
            self._report(order.injection, affected, bool(reason), reason)

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
