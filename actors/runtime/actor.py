"""The actor: one mailbox, one message at a time, in three phases.

Set-up opens the bus, subscribes and calls `on_start`. Running takes one item after the other from
the mailbox: messages and timer ticks. Teardown calls `on_stop` and closes the bus. Handlers are
plain functions and run to their end before the next item, so an actor's state needs no lock and its
code no `await`.

A handler that raises ends the actor: the error is reported on `diagnostic/NAME`, and the process
exits non-zero, so that its supervisor starts a new one. The heartbeat is an item of the same
mailbox, so a handler that never returns silences it.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any

import msgspec

from rampart.actors.bus.bounds import MAX_PAYLOAD_BYTES, clip
from rampart.actors.bus.envelope import (
    STRANGERS,
    ArrivalGuard,
    Envelope,
    Header,
    pack,
    too_long,
    unsendable_place,
)
from rampart.actors.bus.fields import Field
from rampart.actors.bus.limits import ReportLimit
from rampart.actors.bus.messages import ON_TIME, Diagnostic, Heartbeat, Injection
from rampart.actors.bus.topic import ROOT, Qos, Topic
from rampart.actors.bus.topics import DIAGNOSTIC, HEARTBEAT, INJECT
from rampart.actors.runtime.checkpoint import Keeper, S, StateFormat
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.context import Context
from rampart.actors.runtime.declaration import BASE_INPUTS, BASE_OUTPUTS, Declared, every, on
from rampart.actors.runtime.injection import InjectedFaults
from rampart.actors.runtime.mailbox import IDLE, Dispatcher
from rampart.actors.runtime.parameters import read_parameters
from rampart.actors.runtime.timer import Timer, Timers

__all__ = ["BASE_INPUTS", "BASE_OUTPUTS", "Actor", "Context", "Header", "every", "on"]

_LATE_DIGITS = 3  # milliseconds

_EARLY_S = 0.05
"""Simulated seconds by which a repeated posting may be sent early."""

_PATIENCE_S = 0.02
"""Longest time, simulated seconds, that a restarted node waits for the last messages of its topics.
"""

_OFTEN_HZ, _PERIODS = 7.0, 3
"""On topics this fast, a last message older than three periods is of no use: its publisher is
silent, and only a new message shows that it is not.
"""


def _ignore(_key: str, _reason: str) -> None:
    """A posting that is refused counts as silence."""


def _all_of(handlers: Sequence[Callable[[Any, Header], None]]) -> Callable[[Any, Header], None]:
    """Return one handler that calls several in order."""
    if len(handlers) == 1:
        return handlers[0]

    def handle(message: Any, header: Header) -> None:
        for handler in handlers:
            handler(message, header)

    return handle


class Actor(Declared):
    """Base of every node, detection module, recovery module and manager."""

    context: Context
    name: str
    clock: Clock

    def __init__(self, context: Context) -> None:
        self.context = context
        self.name = context.name
        self._incarnation = context.incarnation
        self.clock = context.clock
        self.parameters = read_parameters(
            self.Parameters, context.parameters, context.name, "parameters")
        self._bus = context.bus
        self._guard = ArrivalGuard(context.clock.now, context.members, self._crowded,
                                   context.register, context.command_age_s)
        self._injections = InjectedFaults(self)
        self._in_force = self._injections.gate.in_force
        self._last_sent = self._injections.gate.last
        self._keeper = Keeper(
            context.checkpoints, lambda line: self.report_diagnostic("checkpoint", line, self.name),
            context.clock.now, expected=context.incarnation > 1 or context.run.plan.part > 0)
        self._dispatcher = Dispatcher(context.bus.bursts, self._overflowed)
        self._timers = Timers(context.clock, self._dispatcher)
        self._queries = 0
        self._is_at_work = False
        self._sequence = 0
        self._beat_due_s = math.inf
        self._late_s = 0.0
        self._rejected = 0
        self._abandoned = False
        self._reports = ReportLimit()
        self._outlets: dict[str | tuple[str, str], str] = {}
        self._may_publish = {t.key for t in (*self.outputs, *BASE_OUTPUTS)}
        self._may_publish.update(
            self.chosen_topic(name.key).key for name in self.named(self.parameters)["published"])
        self._chosen: dict[str, list[Callable[[Any, Header], None]]] = {}
        self._beside: list[Callable[[], None]] = []
        self._sent: dict[str, tuple[msgspec.Struct, float]] = {}
        self._postings: dict[str, Callable[[str, bytes], None]] = {}
        self._last_read: dict[str, bytes] = {}
        self._is_reading = False
        self._has_read_s = -math.inf

    # -- what a subclass may override, besides what `Declared` has ---------------------------------

    def listens(self, topic: Topic[Any]) -> bool:  # noqa: ARG002
        """Whether this process of the node subscribes to one of its inputs."""
        return True

    def reads(self, topic: Topic[Any]) -> Iterable[str]:  # noqa: ARG002
        """Return the keys whose postings it reads, of a family it subscribes to as a whole."""
        return ()

    def on_start(self) -> None:
        """Runs on the loop with the bus open, before the first message. Raising ends the actor."""

    def on_stop(self) -> None:
        """Runs on the loop after the last item, with the bus still open; also after a failure."""

    def is_well(self) -> bool:
        """Whether to send the heartbeat that is due."""
        return True

    # -- what a subclass calls ------------------------------------------------------------------

    def hear_topic(self, key: str, handler: Callable[[Any, Header], None]) -> Topic[Any]:
        """Subscribe to a topic that a parameter names; to be called in `__init__`.

        Args:
            key: value of a parameter of type `TopicHeard`.
            handler: called with message and header.

        Raises:
            ValueError: the system does not have the topic.
        """
        topic = self.chosen_topic(key)
        self._chosen.setdefault(key, []).append(handler)
        return topic

    def hear_after_all(self, topic: Topic[Any], handler: Callable[[Any, Header], None]) -> None:
        """Subscribe from now on to an input that `listens` has left out."""
        self._hear(topic, topic.at(), handler)

    def hear_field(self, name: str, handler: Callable[[Any, Header], None]) -> None:
        """Subscribe to a field that a parameter names; to be called in `__init__`.

        Args:
            name: value of a parameter of type `FieldName`.
            handler: called with the field's value and the header.

        Raises:
            ValueError: the system does not have the topic, or its messages lack the field.
        """
        key, _, path = name.partition(":")
        field = Field(self.chosen_topic(key).type, path)

        def take(message: Any, header: Header) -> None:
            value = field(message)
            if value is None and (why := field.beyond(message)):
                self.report_diagnostic("no such item", why, key)
            handler(value, header)

        self.hear_topic(key, take)

    def chosen_topic(self, key: str) -> Topic[Any]:
        """Return the topic with a key that a parameter names.

        Raises:
            ValueError: the system does not have the topic.
        """
        try:
            return self.context.topics[key]
        except KeyError:
            raise ValueError(f"{self.name}: unknown topic {key!r}") from None

    def publish(self, topic: Topic[Any], body: msgspec.Struct, stamp: float | None = None,
                name: str | None = None) -> None:
        """Publish a message.

        Args:
            topic: one of `outputs`.
            body: message of the topic's type.
            stamp: simulated time at which the content was true; now if omitted.
            name: member of a topic family; this node's name if omitted.

        Raises:
            ValueError: `outputs` does not declare the topic.
        """
        key = self._outlets.get(
            topic.key if name is None else (topic.key, name)) or self._outlet(topic, name)
        if stamp is None:
            stamp = self.clock.now()
        (self._injections.send if self._in_force else self.send)(topic, key, body, stamp)

    def _outlet(self, topic: Topic[Any], name: str | None) -> str:
        if topic.key not in self._may_publish:
            raise ValueError(f"{type(self).__name__} publishes {topic.key}, "
                             "which its outputs do not declare")
        outlet = topic.at(name or self.name) if topic.is_family else topic.at()
        self._outlets[topic.key if name is None else (topic.key, name)] = outlet
        return outlet

    def read_postings(self) -> None:
        """Handle new postings; to be called before a conclusion is drawn from silence."""
        if self._is_reading:  # called by the handler of a posting
            return
        self._is_reading, self._has_read_s = True, self.clock.now()
        for key, receive in self._postings.items():
            payload = self._bus.posted(key)
            if payload is not None and payload != self._last_read.get(key):
                self._last_read[key] = payload
                receive(key, payload)
        self._is_reading = False

    def came_s(self, header: Header) -> float:
        """Return the arrival time of the message in hand; of a posting, when it was posted."""
        now_s = self.clock.now()
        return min(header.stamp, now_s) if self._is_reading else now_s

    def has_readers(self, topic: Topic[Any]) -> bool:
        """Whether one of its topics may have subscribers, as far as the bus knows."""
        key = self._outlets.get(topic.key) or self._outlet(topic, None)
        return self._bus.has_readers(key)

    def call_later(self, delay_s: float, call: Callable[[], None]) -> Timer:
        """Call `call` as a mailbox item after `delay_s` simulated seconds."""
        return self._timers.later(delay_s, call)

    def kept(self, form: StateFormat[S]) -> S | None:
        """Return the newest sound state, or None; to be called in `on_start`."""
        return self._keeper.kept(form)

    def keep(self, form: StateFormat[S], state: S) -> None:
        """Save the whole state; to be called before the messages that follow from it are sent.

        After the return the state survives this process. A failure is reported and does not raise.
        """
        self._keeper.keep(form, state)

    def call_soon(self, slot: str, call: Callable[[], None]) -> None:
        """Call `call` as a mailbox item; it replaces a waiting item of the same slot."""
        self._dispatcher.put(slot, call)

    def report_diagnostic(self, context: str, reason: str, offender: str) -> None:
        """Publish an error report, at most once a second per context and offender."""
        count = self._reports.stands_for(f"{context} {offender}", self.clock.now())
        if count:
            self.publish(DIAGNOSTIC, Diagnostic(
                self.name, clip(context), clip(reason), clip(offender), count))

    def stop(self) -> None:
        """End the actor after the items that are waiting."""
        self._dispatcher.stop()

    def renew(self, incarnation: int) -> None:
        """Become another incarnation of the node in the same process."""
        self._incarnation = incarnation
        self.context.renewed(incarnation)

    # -- what happens to its process ------------------------------------------------------------

    def abandon(self) -> None:
        """Run no teardown when the task is cancelled, as after SIGKILL."""
        self._abandoned = True
        self._dispatcher.abandon()

    def hold(self, held: bool) -> None:
        """Handle nothing while held, as after SIGSTOP or in a hang."""
        self._dispatcher.hold(held)

    def slow_down(self, pace_s: float) -> None:
        """Take `pace_s` virtual seconds for each item, as on an overloaded machine."""
        self._dispatcher.slow_down(pace_s)

    # -- the three phases -----------------------------------------------------------------------

    async def run(self) -> None:
        """Run from set-up to teardown.

        Raises:
            BusError: the bus cannot be opened.
            Exception: raised by a handler.
        """
        await self._bus.open()
        try:
            self._set_up()
            await self._dispatcher.run()
        except Exception as error:
            self._fail(error)
            raise
        finally:
            await self._tear_down()

    def _check_names(self) -> None:
        """Raise TypeError if an attribute of a subclass hides a method."""
        for base in type(self).__mro__:
            for name, member in vars(base).items():
                if inspect.isfunction(member) and not callable(getattr(self, name)):
                    raise TypeError(f"{type(self).__name__}.{name}: {base.__name__} has a method "
                                    "of this name; expected another name for the attribute")

    def _set_up(self) -> None:
        self._check_names()
        declared: dict[str, tuple[Topic[Any], list[Callable[[Any, Header], None]]]] = {}
        for topic, method in self._handlers:
            if self.listens(topic):
                declared.setdefault(topic.key, (topic, []))[1].append(getattr(self, method))
        # One subscription serves all handlers of a topic, also those of `hear_topic`.
        for topic, handlers in declared.values():
            handler = _all_of([*handlers, *self._chosen.pop(topic.key, ())])
            names = self.names(topic, self.name, self.parameters) if topic.is_family else None
            for key in [topic.pattern] if names is None else map(topic.at, names):
                self._hear(topic, key, handler)
        for key, handlers in self._chosen.items():
            topic = self.chosen_topic(key)
            where = topic.pattern if key == topic.key else f"{ROOT}/{key}"
            self._hear(topic, where, _all_of(handlers))
        self.on_start()
        self._beat()
        self._timers.every(self.context.heartbeat_period_s, "_beat", self._beat)
        if self._incarnation == 1 or not self._queries:  # no last messages are awaited
            self._go_to_work()
        else:
            self.call_later(_PATIENCE_S, self._go_to_work)

    def _go_to_work(self) -> None:
        """Start the periodic calls; a restarted node makes the first ones at once."""
        if not self._is_at_work:
            self._is_at_work = True
            for period_s, method in self._periodic:
                call, beat_s = getattr(self, method), self.context.heartbeat_period_s
                if method in self._with_heartbeat and beat_s <= period_s:
                    self._beside.append(call)
                else:
                    self._timers.every(period_s, method, call, at_once=self._incarnation > 1)

    async def _tear_down(self) -> None:
        self._timers.cancel()
        if self._abandoned:
            return
        try:
            self.on_stop()
        finally:
            self._keeper.close()
            await self._bus.close()

    def _fail(self, error: Exception) -> None:
        try:
            self._reports = ReportLimit()  # this report must leave
            self.report_diagnostic("handler failed", f"{type(error).__name__}: {error}", self.name)
            self._keeper.failed()
        except Exception as second:  # `run` raises the first error
            error.add_note(f"while reporting it: {second!r}")
        self.context.failed(error)

    # -- mail -----------------------------------------------------------------------------------

    def _hear(self, topic: Topic[Any], where: str, handler: Callable[[Any, Header], None]) -> None:
        """Subscribe; unless the topic carries commands, ask for its last message too."""
        self._bus.subscribe(where, self._receiver(topic, handler))
        if topic.resend_s:
            for key in self.reads(topic) if "*" in where else (where,):
                self._postings[key] = self._guard.receiver(
                    topic, lambda _key, message: handler(message.body, message), _ignore)
        if topic.qos is not Qos.COMMAND:
            self._queries += 1
            self._bus.latest(where, self._receiver(topic, self._unless_silent(topic, handler)),
                             self._query_ended)

    def _query_ended(self) -> None:
        self._queries -= 1
        if not self._queries:
            self._dispatcher.put("go to work", self._go_to_work)

    def _unless_silent(self, topic: Topic[Any],
                       handler: Callable[[Any, Header], None]) -> Callable[[Any, Header], None]:
        """Return a handler that ignores messages of publishers that have been silent since."""
        if topic.rate_hz < _OFTEN_HZ:
            return handler
        oldest_s = _PERIODS / topic.rate_hz

        def take(message: Any, header: Header) -> None:
            if self.clock.now() - header.stamp <= oldest_s:
                handler(message, header)

        return take

    def _receiver(self, topic: Topic[Any],
                  handler: Callable[[Any, Header], None]) -> Callable[[str, bytes], None]:
        command, members = topic.qos is Qos.COMMAND, self.context.members
        dispatcher = self._dispatcher

        def take(key: str, message: Envelope[Any]) -> None:
            item = partial(handler, message.body, message)
            if dispatcher.stance == IDLE:
                dispatcher.work(item)
                return
            reserved = not members or message.source in members
            dispatcher.put_message(None if command else key, item, reserved=reserved)

        return self._guard.receiver(topic, take, self._reject)

    def _reject(self, key: str, reason: str) -> None:
        self._rejected += 1
        self.report_diagnostic("payload rejected", reason, key)

    def _overflowed(self) -> None:
        self.report_diagnostic("mailbox full", "a message was refused", self.name)

    def _crowded(self) -> None:
        self.report_diagnostic("many sources", f"more than {STRANGERS} sources outside the system; "
                               "the oldest are forgotten", self.name)

    def send(self, topic: Topic[Any], key: str, body: msgspec.Struct, stamp: float,
             copies: int = 1) -> None:
        """Send a message past all injected faults; actors call `publish`."""
        self._sequence = sequence = self._sequence + 1
        self._last_sent[key] = (body, stamp)
        try:
            payload = pack((self.name, self._incarnation, sequence, stamp, body))
        except TypeError as error:
            raise TypeError(f"topic {topic.key}: {unsendable_place(body)}: {error}; expected plain "
                            "values, such as float() or .tolist() of a numpy value") from None
        if len(payload) > MAX_PAYLOAD_BYTES:  # readers would refuse it
            self.report_diagnostic("not sent", too_long(payload), key)
            return
        if topic.resend_s and self._bus.post(key, payload):
            before, now_s = self._sent.get(key), self.clock.now()
            if before is not None and now_s - before[1] < topic.resend_s - _EARLY_S and (
                    not topic.compared or before[0] == body):
                self._bus.record(key, payload)
                return
            self._sent[key] = body, now_s
        for _ in range(copies):
            self._bus.publish(topic, key, payload)

    def _beat(self) -> None:
        context, now_s = self.context, self.clock.now()
        if now_s - self._has_read_s > context.heartbeat_period_s / 2:
            self.read_postings()
        for call in self._beside:
            call()
        late_s = max(self._timers.lateness_s(), now_s - self._beat_due_s)  # it waited for mail too
        self._beat_due_s = now_s + context.heartbeat_period_s
        late_s, self._late_s = max(late_s, self._late_s), late_s  # a reader may miss one heartbeat
        if not self.is_well():
            return
        self.publish(HEARTBEAT, Heartbeat(
            context.pid, self._dispatcher.progress, context.heartbeat_period_s, self._rejected,
            self._dispatcher.overflowed, round(late_s, _LATE_DIGITS) or ON_TIME))
        if left_out := self._reports.left_out(now_s):
            self.report_diagnostic(
                "diagnostics", f"{left_out} more reports were left out", self.name)

    # -- fault injection ------------------------------------------------------------------------

    @on(INJECT)
    def _on_injection(self, order: Injection, _header: Header) -> None:
        topic = self.published(order.topic, self.name, self.parameters) or (
            next((self.context.topics[named.key] for named in
                  self.named(self.parameters)["published"] if named.key == order.topic), None))
        if topic is not None:
            self._injections.order(order, topic)
