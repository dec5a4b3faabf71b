"""The actor: one mailbox, one message at a time, in three phases.

Set-up opens the bus, subscribes, calls `on_start`. Running takes one item after the other from
the mailbox: messages, timer ticks, changes of peers. Teardown calls `on_stop` and leaves the
bus. Handlers are plain functions and run to their end before the next item, so an actor's state
needs no lock and its code no `await`.

A handler that raises ends the actor: the error is reported on `diagnostic/NAME`, `on_failure`
is called, and the process exits non-zero so that its supervisor starts a fresh one. The
heartbeat is an item of the same mailbox: a handler that never returns silences it, although the
process and its liveliness token live on.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, TypeVar

import msgspec

from rampart.actors.bus.bounds import MAX_PAYLOAD_BYTES, clip
from rampart.actors.bus.bus import Bus
from rampart.actors.bus.envelope import STRANGERS, ArrivalGuard, Envelope, Header, pack, too_long
from rampart.actors.bus.limits import RateLimit, ReportLimit
from rampart.actors.bus.messages import Diagnostic, Heartbeat, Hello, Injection
from rampart.actors.bus.run_folder import Register
from rampart.actors.bus.topic import Qos, Topic
from rampart.actors.bus.topics import DIAGNOSTIC, HEARTBEAT, HELLO, INJECT, INJECTION_REPORT
from rampart.actors.run.run_context import RunContext
from rampart.actors.runtime.checkpoint import CheckpointStore, Keeper, NoCheckpoints, S, StateFormat
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.injection_desk import InjectionDesk
from rampart.actors.runtime.mailbox import Mailbox
from rampart.actors.runtime.parameters import read_parameters
from rampart.actors.runtime.timer import Timer

__all__ = ["Actor", "Context", "Header", "every", "on"]

F = TypeVar("F", bound=Callable[..., None])

BASE_OUTPUTS: tuple[Topic[Any], ...] = (HEARTBEAT, HELLO, DIAGNOSTIC, INJECTION_REPORT)
"""What every actor publishes besides its own outputs."""

BASE_INPUTS: tuple[Topic[Any], ...] = (INJECT, HELLO)
"""What every actor hears besides its own inputs: injections from tools, hellos from partners."""

_REPEATED_SOON_HZ = 7.0
"""A state that is repeated this often anyway is not repeated for a newcomer."""

_HELLOS_PER_S = 100
"""More newcomers in a simulated second than a system has nodes are no newcomers."""

_STRANGE_HELLOS_PER_S = 5
"""Of those that are no nodes of the system."""

# What an actor is doing. Numbers, because they are compared and set for each message.
_RESTING = 0
"""Nothing, and what comes goes through the mailbox."""
_IDLE = 1
"""Nothing, and what comes may be handled without a stay in the mailbox."""
_AWAKE = 2
"""It handles an item, is about to, or has not started yet."""


@dataclass(frozen=True, slots=True)
class Context:
    """What an actor gets from whoever starts it.

    Attributes:
        name: the node's name, unique in the system.
        incarnation: which life of the node this is, counted from 1.
        clock: simulated time.
        bus: this actor's access to the bus, not yet open.
        parameters: the node's parameters, as the system spec gives them or read already.
        run: what all actors of the run have in common, loaded once.
        pid: number of the process that it lives in.
        checkpoints: where this node's state is kept.
        heartbeat_period_s: simulated seconds between two heartbeats.
        failed: told of the error that ends the actor, while its peers still believe that it lives.
        register: returns the incarnation of a node that was issued last, None if it is not known.
        members: names of all nodes of the system; what others make it remember is bounded.
    """

    name: str
    incarnation: int
    clock: Clock
    bus: Bus
    parameters: Mapping[str, Any] | msgspec.Struct = field(default_factory=dict)
    run: RunContext = field(default_factory=RunContext)
    pid: int = field(default_factory=os.getpid)
    checkpoints: CheckpointStore = field(default_factory=NoCheckpoints)
    heartbeat_period_s: float = 0.1
    failed: Callable[[Exception], None] = lambda _error: None
    register: Register = lambda _node: None
    members: frozenset[str] = frozenset()


def on(topic: Topic[Any]) -> Callable[[F], F]:
    """Declare a method as the handler of a topic: `handler(self, message, header)`."""

    def mark(function: F) -> F:
        function.__dict__.setdefault("_rampart_topics", []).append(topic)
        return function

    return mark


def every(period_s: float) -> Callable[[F], F]:
    """Declare a method to be called each `period_s` simulated seconds, first after one period."""

    def mark(function: F) -> F:
        function.__dict__["_rampart_period_s"] = period_s
        return function

    return mark


class Actor:
    """Base of every node, detection module, recovery module and manager.

    Class attributes:
        outputs: topics it publishes; publishing another one raises.
        Parameters: what the system spec may say of it, by field: type, range and default. One that
            says more derives its own from that of its base class.
    """

    class Parameters(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
        """None, unless a subclass declares some."""

    parameters: Parameters
    outputs: ClassVar[tuple[Topic[Any], ...]] = ()
    _handlers: ClassVar[tuple[tuple[Topic[Any], str], ...]] = ()
    _periodic: ClassVar[tuple[tuple[float, str], ...]] = ()

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        handlers: dict[tuple[str, str], tuple[Topic[Any], str]] = {}
        periodic: dict[str, float] = {}
        for base in reversed(cls.__mro__):
            for name, member in vars(base).items():
                for topic in getattr(member, "_rampart_topics", ()):
                    handlers[(topic.key, name)] = (topic, name)
                if hasattr(member, "_rampart_period_s"):
                    periodic[name] = member._rampart_period_s
        cls._handlers = (
            (INJECT, "_on_injection"), (HELLO, "_on_hello"), *handlers.values())
        cls._periodic = tuple((period, name) for name, period in periodic.items())

    def __init__(self, context: Context) -> None:
        self.context = context
        self.name = context.name
        self._incarnation = context.incarnation
        self.clock = context.clock
        self.parameters = read_parameters(
            self.Parameters, context.parameters, context.name, "parameters")
        self._bus = context.bus
        self._guard = ArrivalGuard(
            context.clock.now, context.members, self._crowded, context.register)
        self._injections = InjectionDesk(self)
        self._in_force = self._injections.gate.in_force
        self._last_sent = self._injections.gate.last
        self._keeper = Keeper(
            context.checkpoints, lambda line: self.report_diagnostic("checkpoint", line, self.name),
            context.clock.now, expected=context.incarnation > 1)
        self._mailbox = Mailbox(on_overflow=self._overflowed, on_item=self._wake)
        self._waiting = self._mailbox.waiting
        self._ended: asyncio.Future[None] | None = None
        self._stance = _RESTING
        self._on_hold = False
        self._pace_s = 0.0
        self._sequence = 0
        self._progress = 0
        self._rejected = 0
        self._timer_count = 0
        self._stopping = False
        self._abandoned = False
        self._timers: set[asyncio.TimerHandle] = set()
        self._tickers: list[_Ticker] = []
        self._reports = ReportLimit()
        self._hellos = RateLimit(_HELLOS_PER_S)
        self._strange_hellos = RateLimit(_STRANGE_HELLOS_PER_S)
        self._answer_due = False
        self._states: dict[str, tuple[Topic[Any], msgspec.Struct, float]] = {}
        self._outlets: dict[str | tuple[str, str], tuple[str, bool]] = {}
        self._may_publish = {t.key for t in (*self.outputs, *BASE_OUTPUTS)}

    # -- what a subclass may override -----------------------------------------------------------

    @classmethod
    def names(
        cls, topic: Topic[Any], name: str, parameters: Any  # noqa: ARG003
    ) -> tuple[str, ...] | None:
        """Which members of an input family a node hears, None for all.

        Args:
            topic: one of its inputs.
            name: of the node.
            parameters: of the node, as its class's `Parameters`.
        """
        return None

    @classmethod
    def output_names(
        cls, topic: Topic[Any], name: str, parameters: Any  # noqa: ARG003
    ) -> tuple[str, ...] | None:
        """Which members of an output family a node publishes, likewise; None for any."""
        return (name,)

    @classmethod
    def watches(cls, name: str, parameters: Any) -> tuple[str, ...]:  # noqa: ARG003
        """Nodes whose life and death `on_peer` reports."""
        return ()

    @classmethod
    def inputs(cls) -> tuple[Topic[Any], ...]:
        """Topics it has handlers for, those of every actor included."""
        return tuple(dict.fromkeys(topic for topic, _ in cls._handlers))

    def listens(self, topic: Topic[Any]) -> bool:  # noqa: ARG002
        """Whether this life of the node, as it was started, has any use for one of its inputs."""
        return True

    def on_start(self) -> None:
        """Runs on the loop when the bus is open, before the first message. A raise ends it."""

    def on_stop(self) -> None:
        """Runs on the loop after the last item, bus still open, also after a failure."""

    def on_failure(self, error: BaseException) -> None:
        """Runs on the loop after a handler raised, before `on_stop`. A raise here is ignored."""

    def on_peer(self, node: str, incarnation: int, alive: bool) -> None:
        """Runs as a mailbox item when a watched node appears or vanishes."""

    # -- what a subclass calls ------------------------------------------------------------------

    def publish(
        self, topic: Topic[Any], body: msgspec.Struct, stamp: float | None = None,
        name: str | None = None,
    ) -> None:
        """Send a message.

        Args:
            topic: one of `outputs`.
            body: message of the topic's type.
            stamp: simulated time at which the content was true; now if omitted.
            name: member of a topic family; this node's name if omitted.

        Raises:
            ValueError: the topic is not declared in `outputs`.
        """
        key, is_kept = self._outlets.get(
            topic.key if name is None else (topic.key, name)) or self._outlet(topic, name)
        if stamp is None:
            stamp = self.clock.now()
        if is_kept:
            self._states[key] = (topic, body, stamp)
        if self._in_force:
            self._injections.send(topic, key, body, stamp)
        else:
            self.send(topic, key, body, stamp)

    def _outlet(self, topic: Topic[Any], name: str | None) -> tuple[str, bool]:
        """Return the key of a topic, and whether its last message is kept for newcomers."""
        if topic.key not in self._may_publish:
            raise ValueError(f"{type(self).__name__} publishes {topic.key}, "
                             "which its outputs do not declare")
        outlet = (topic.at(name or self.name) if topic.is_family else topic.at(),
                  topic.qos is Qos.STATE and topic.rate_hz < _REPEATED_SOON_HZ)
        self._outlets[topic.key if name is None else (topic.key, name)] = outlet
        return outlet

    def has_readers(self, topic: Topic[Any]) -> bool:
        """Whether somebody may be listening to one of its topics, as far as the bus can know."""
        key, _ = self._outlets.get(topic.key) or self._outlet(topic, None)
        return self._bus.has_readers(key)

    def call_later(self, delay_s: float, call: Callable[[], None]) -> Timer:
        """Have `call` made as a mailbox item after `delay_s` simulated seconds."""
        timer = Timer(call)
        self._timer_count += 1
        slot = f"later {self._timer_count}"
        due = self.clock.source_time(self.clock.now() + delay_s)
        handle = self._at(due, lambda: self._tick(slot, timer.fire))

        def release() -> None:
            handle.cancel()
            self._timers.discard(handle)

        timer.arm(release)
        return timer

    def kept(self, form: StateFormat[S]) -> S | None:
        """Return the state to go on from, in `on_start`: the newest sound one, or None."""
        return self._keeper.kept(form)

    def keep(self, form: StateFormat[S], state: S) -> None:
        """Keep the whole state; to be called before the messages that follow from it are sent.

        On return it survives this process. What goes wrong is reported and does not raise: the
        node goes on without.
        """
        self._keeper.keep(form, state)

    def report_diagnostic(self, context: str, reason: str, offender: str) -> None:
        """Publish an error report: one a second per context and offender, and few in all."""
        count = self._reports.stands_for(f"{context} {offender}", self.clock.now())
        if count:
            self.publish(DIAGNOSTIC, Diagnostic(
                self.name, clip(context), clip(reason), clip(offender), count))

    def stop(self) -> None:
        """End the actor after the items that already wait."""
        self._mailbox.put_latest("stop", self._stop)

    def abandon(self) -> None:
        """Have nothing more run when its task is cancelled: in virtual time what SIGKILL does."""
        self._abandoned = True

    def hold(self, held: bool) -> None:
        """Handle nothing while held: in virtual time what SIGSTOP and a wedged loop do."""
        self._on_hold = held
        if self._stance == _IDLE:
            self._stance = _RESTING
        self._wake()

    def slow_down(self, pace_s: float) -> None:
        """Take so many virtual seconds for each item, as on a machine that is overloaded."""
        self._pace_s = pace_s
        if self._stance == _IDLE:
            self._stance = _RESTING

    # -- the three phases -----------------------------------------------------------------------

    async def run(self) -> None:
        """Live from set-up to teardown.

        Raises:
            BusError: the bus could not be opened.
            Exception: whatever a handler raised.
        """
        await self._bus.open()
        self._ended = asyncio.get_running_loop().create_future()
        self._stance = _AWAKE  # nothing is handled before `on_start`
        try:
            self._set_up()
            self._stance = _RESTING
            self._wake()
            await self._ended
        except asyncio.CancelledError:
            raise
        except Exception as error:
            self._fail(error)
            raise
        finally:
            await self._tear_down()

    def _wake(self) -> None:
        """See to it that the mailbox is worked off.

        Not at once if messages arrive in bursts: what is overtaken within one need not be handled.
        """
        if self._stance != _AWAKE and self._ended is not None:
            self._stance = _AWAKE
            if self._bus.bursts:
                self._ended.get_loop().call_soon(self._work)
            else:
                self._work()

    def _rest(self) -> None:
        """The mailbox is empty. Whether the next item may be handled without a stay in it?"""
        self._stance = _RESTING if (
            self._bus.bursts or self._on_hold or self._pace_s
            or self._ended is None or self._ended.done()) else _IDLE

    def _handle(self, item: Callable[[], None]) -> None:
        """Handle an item at once, being idle, and then what it has put into the mailbox."""
        self._stance = _AWAKE
        try:
            item()
        except Exception as error:
            self._broken(error)
            return
        self._progress += 1
        if self._waiting:
            self._work()
        else:
            self._stance = _IDLE

    def _broken(self, error: Exception) -> None:
        if self._ended is not None:
            self._ended.set_exception(error)
        self._rest()

    def _work(self) -> None:
        mailbox, ended = self._mailbox, self._ended
        if ended is None or ended.done() or self._on_hold:
            self._rest()
            return
        try:
            while mailbox.waiting and not self._stopping:
                mailbox.take()()
                self._progress += 1
                if self._pace_s:
                    ended.get_loop().call_later(self._pace_s, self._work)
                    return  # still awake: whatever arrives meanwhile waits
        except Exception as error:
            ended.set_exception(error)
        if self._stopping and not ended.done():
            ended.set_result(None)
        self._rest()

    def _set_up(self) -> None:
        for topic, method in self._handlers:
            if not self.listens(topic):
                continue
            handler = getattr(self, method)
            names = self.names(topic, self.name, self.parameters) if topic.is_family else None
            keys = [topic.at(n) for n in names] if names is not None else [topic.pattern]
            for key in keys:
                self._bus.subscribe(topic, key, self._receiver(topic, handler))
        for node in self.watches(self.name, self.parameters):
            self._bus.watch(node, self._peer_changed)
        self.on_start()
        self.publish(HELLO, Hello())
        self._beat()
        self._start_timer(self.context.heartbeat_period_s, "_beat")
        for period_s, method in self._periodic:
            self._start_timer(period_s, method)

    async def _tear_down(self) -> None:
        for handle in self._timers:
            handle.cancel()
        self._timers.clear()
        for ticker in self._tickers:
            ticker.cancel()
        if self._abandoned:
            return
        try:
            self.on_stop()
        finally:
            self._keeper.close()
            await self._bus.close()

    def _stop(self) -> None:
        self._stopping = True

    def _fail(self, error: Exception) -> None:
        try:
            self._reports.clear()
            self.report_diagnostic("handler failed", f"{type(error).__name__}: {error}", self.name)
            self._keeper.failed()
            self.on_failure(error)
        except Exception as second:  # the first error is the one that counts
            error.add_note(f"and while reporting it: {second!r}")
        self.context.failed(error)

    # -- mail -----------------------------------------------------------------------------------

    def _receiver(
        self, topic: Topic[Any], handler: Callable[[Any, Header], None]
    ) -> Callable[[str, bytes], None]:
        command, name, waiting = topic.qos is Qos.COMMAND, handler.__name__, self._waiting
        members, mailbox = self.context.members, self._mailbox

        def take(key: str, message: Envelope[Any]) -> None:
            if self._stance == _IDLE:  # as `_handle`, once more because it is run so often
                self._stance = _AWAKE
                try:
                    handler(message.body, message)
                except Exception as error:
                    self._broken(error)
                    return
                self._progress += 1
                if waiting:
                    self._work()
                else:
                    self._stance = _IDLE
            elif command:
                mailbox.put(lambda: handler(message.body, message),
                            reserved=not members or message.source in members)
            else:
                mailbox.put_message(f"{key} {name}", lambda: handler(message.body, message),
                                    reserved=not members or message.source in members)

        return self._guard.receiver(topic, take, self._reject)

    def _reject(self, key: str, reason: str) -> None:
        self._rejected += 1
        self.report_diagnostic("payload rejected", reason, key)

    def _peer_changed(self, node: str, incarnation: int, alive: bool) -> None:
        self._mailbox.put_message(
            f"peer {node} {incarnation} {alive}", lambda: self.on_peer(node, incarnation, alive))

    def _overflowed(self, _item: Any) -> None:
        self.report_diagnostic("mailbox full", "a message was refused", self.name)

    def _crowded(self) -> None:
        self.report_diagnostic("many sources", f"more than {STRANGERS} that are no nodes of the "
                               "system; those heard first are forgotten", self.name)

    def send(
        self, topic: Topic[Any], key: str, body: msgspec.Struct, stamp: float, copies: int = 1
    ) -> None:
        """Send a message as it is, past all fault injections; `publish` is what actors call."""
        self._sequence = sequence = self._sequence + 1
        self._last_sent[key] = (body, stamp)
        payload = pack((self.name, self._incarnation, sequence, stamp, body))
        if len(payload) > MAX_PAYLOAD_BYTES:  # no reader would take it
            self.report_diagnostic("not sent", too_long(payload), key)
            return
        for _ in range(copies):
            self._bus.publish(topic, key, payload)

    # -- timers ---------------------------------------------------------------------------------

    def _at(self, when: float, call: Callable[[], None]) -> asyncio.TimerHandle:
        loop = asyncio.get_running_loop()
        handle: asyncio.TimerHandle

        def fire() -> None:
            self._timers.discard(handle)
            call()

        handle = loop.call_at(when, fire)
        self._timers.add(handle)
        return handle

    def _start_timer(self, period_s: float, method: str) -> None:
        ticker = _Ticker(self, period_s, method)
        self._tickers.append(ticker)
        ticker.arm(self.clock.now() + period_s)

    def _tick(self, slot: str, call: Callable[[], None]) -> None:
        if self._stance == _IDLE:
            self._handle(call)
        else:
            self._mailbox.put_latest(slot, call)

    def _beat(self) -> None:
        context = self.context
        self.publish(HEARTBEAT, Heartbeat(
            context.pid, self._progress, context.heartbeat_period_s, self._rejected,
            self._mailbox.overflowed))
        left_out = self._reports.left_out(self.clock.now())
        if left_out:
            self.report_diagnostic(
                "diagnostics", f"{left_out} more reports were left out", self.name)

    # -- newcomers ------------------------------------------------------------------------------

    def _on_hello(self, _hello: Hello, header: Header) -> None:
        if header.source == self.name or self._answer_due:
            return
        members = self.context.members
        known = not members or header.source in members
        if (self._hellos if known else self._strange_hellos).allows(self.clock.now()):
            self._repeat_states()
        else:  # one answer for all of them, when the flood has lasted a second
            self._answer_due = True
            self.call_later(1.0, self._repeat_states)

    def _repeat_states(self) -> None:
        self._answer_due = False
        for key, (topic, body, stamp) in list(self._states.items()):
            if self._in_force:
                self._injections.send(topic, key, body, stamp)
            else:
                self.send(topic, key, body, stamp)

    # -- fault injection ------------------------------------------------------------------------

    def _on_injection(self, order: Injection, _header: Header) -> None:
        self._injections.order(order)

    def published(self, key: str) -> Topic[Any] | None:
        """Return the topic of a key below `rampart/`, if this actor publishes it."""
        for topic in (*self.outputs, *BASE_OUTPUTS):
            if not topic.is_family and topic.key == key:
                return topic
            if topic.is_family:
                names = self.output_names(topic, self.name, self.parameters)
                head, tail = topic.key.split("{name}")
                member = key[len(head):len(key) - len(tail)] if tail else key[len(head):]
                if key.startswith(head) and key.endswith(tail) and (
                        names is None or member in names):
                    return topic
        return None


class _Ticker:
    """A periodic timer of an actor. One that is late skips; it does not catch up."""

    __slots__ = (
        "_actor", "_call", "_cancelled", "_clock", "_due_s", "_period_s", "_post_at", "_slot")

    def __init__(self, actor: Actor, period_s: float, method: str) -> None:
        loop = asyncio.get_running_loop()
        self._actor = actor
        self._clock = actor.clock
        self._post_at = getattr(loop, "post_at", loop.call_at)  # cheaper, on a virtual loop
        self._period_s = period_s
        self._call = getattr(actor, method)
        self._slot = f"timer {method}"
        self._due_s = 0.0
        self._cancelled = False

    def arm(self, due_s: float) -> None:
        """Tick next at a simulated time."""
        self._due_s = due_s
        self._post_at(self._clock.source_time(due_s), _Ticker._fire, self, None)

    def cancel(self) -> None:
        """Tick no more."""
        self._cancelled = True

    def _fire(self, _nothing: None) -> None:
        if self._cancelled:
            return
        clock, actor = self._clock, self._actor
        now_s, next_s = clock.now(), self._due_s + self._period_s
        self._due_s = due_s = next_s if next_s > now_s else now_s + self._period_s
        self._post_at(clock.source_time(due_s), _Ticker._fire, self, None)
        if actor._stance == _IDLE:
            actor._handle(self._call)
        else:
            actor._mailbox.put_latest(self._slot, self._call)
