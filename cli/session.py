"""A tool's session with a run: a client of a router, of which nodes do not notice anything.

A publisher is not notified whether a command arrived. So a command is sent with a check of its
effect, and repeated under the same sequence number until the effect shows. Receivers drop the
copies (see `ArrivalGuard`); a node that has just been restarted receives one of them.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import uuid
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Generic, TypeVar

import msgspec

from rampart.actors.access.register import KeysError, read_register
from rampart.actors.access.rights import OPERATOR, VIEWER
from rampart.actors.bus.bus import Bus, BusError
from rampart.actors.bus.envelope import UNREADABLE, Header, decode, encode
from rampart.actors.bus.recorder_connection import RecorderConnection
from rampart.actors.bus.run_folder import ROUTERS
from rampart.actors.bus.run_info import NoRunError, RunInfo, find_run, find_runs
from rampart.actors.bus.topic import ROOT, Topic
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.bus.zenoh_session import Credentials, credentials_in, key_file
from rampart.actors.runtime.clock import Clock
from rampart.actors.supervision.process_title import process_state
from rampart.cli.output import NoEffectError, UsageError, refusing, warn

T = TypeVar("T")

KEY_VARIABLE = "RAMPART_KEY"

RESEND_S = 0.1
"""Real seconds between copies of a command whose effect does not show."""

_TRIES = 15
"""Queries while a router may be starting."""

OVERHEAD_S = 0.5
"""Real seconds for what does not scale with simulated time: sockets, scheduling."""


async def pause(done: asyncio.Event, real_s: float) -> None:
    """Wait for real seconds, or until an event is set."""
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(done.wait(), real_s)


class Session:
    """A tool's connection to a run.

    Args:
        run: the run.
        bus: access to its bus, opened by `connect`.
        clock: the run's simulated time.
        may_order: False with the certificate of a viewer, whose commands every router drops.
    """

    def __init__(self, run: RunInfo, bus: Bus, clock: Clock, *, may_order: bool = True) -> None:
        self.run = run
        self.clock = clock
        self.name = f"rampart-{uuid.uuid4().hex[:10]}"
        self._bus = bus
        self._sequence = 0
        self._may_order = may_order

    def real_s(self, simulated_s: float) -> float:
        """Return the real seconds to wait for an event that is due in simulated seconds."""
        return simulated_s / self.clock.rate + OVERHEAD_S

    def listen(self, topic: Topic[Any], heard: Callable[[str, Header, Any], None], key: str = "",
               garbage: Callable[[str, bytes, str], None] | None = None) -> None:
        """Subscribe to a topic.

        Args:
            topic: the topic.
            heard: called on the event loop with key (below the root), header and body.
            key: full key expression; "" for all keys of the topic.
            garbage: called with key, payload and reason if a payload does not decode.
        """

        def deliver(full_key: str, payload: bytes) -> None:
            short = full_key.removeprefix(f"{ROOT}/")
            try:
                header, body = decode(topic, payload)
            except UNREADABLE as error:
                if garbage is not None:
                    garbage(short, payload, str(error))
                return
            heard(short, header, body)

        self._bus.subscribe(key or topic.pattern, deliver)

    def overhear(self, topic: Topic[Any], arrived: Callable[[str, bytes], None]) -> None:
        """Subscribe to a topic without decoding, which takes most of the time of a message.

        Args:
            topic: the topic.
            arrived: called with key (below the root) and payload.
        """
        start = len(f"{ROOT}/")
        self._bus.subscribe(topic.pattern, lambda key, load: arrived(key[start:], load))

    async def latest(self, topics: tuple[Topic[Any], ...], timeout_s: float) -> dict[str, Any]:
        """Return topic key → newest body, when all have arrived or after some real seconds."""
        heard = {topic.key: Latest[Any]() for topic in topics}
        for topic in topics:
            self.listen(topic, heard[topic.key].keep)
        await asyncio.gather(*(latest.first(timeout_s) for latest in heard.values()))
        return {key: latest.value for key, latest in heard.items() if latest.value is not None}

    def publish(self, topic: Topic[Any], body: msgspec.Struct) -> None:
        """Send a message once, stamped now; for messages that the caller repeats.

        Raises:
            UsageError: as of `check_may_order`.
        """
        self.check_may_order()
        self._sequence += 1
        self._bus.publish(topic, topic.at(), self._payload(self._sequence, body))

    async def command(self, topic: Topic[Any], body: msgspec.Struct,
                      effect: Callable[[], bool], timeout_s: float) -> bool:
        """Repeat a command until `effect` holds; return False if it does not within real seconds.

        Raises:
            UsageError: as of `check_may_order`, or a value of the message is out of bounds.
        """
        self.check_may_order()
        self._sequence += 1
        sequence = self._sequence
        try:
            decode(topic, self._payload(sequence, body))
        except UNREADABLE as error:
            raise UsageError(f"cannot send this {topic.type.__name__}: {error}") from None
        loop = asyncio.get_running_loop()
        deadline = loop.time() + timeout_s
        resend = loop.time()
        while not effect():
            now = loop.time()
            if now >= deadline:
                return False
            if now >= resend:
                self._bus.publish(topic, topic.at(), self._payload(sequence, body))
                resend = now + RESEND_S
            await asyncio.sleep(0.01)
        return True

    def check_may_order(self) -> None:
        """Refuse to change a run that this tool cannot change.

        Raises:
            UsageError: the run is a replay, or the certificate is a viewer's.
        """
        if self.run.replay_of:
            raise UsageError(f"port {self.run.base_port} is a replay of {self.run.replay_of}: "
                             "no node can obey")
        if not self._may_order:
            raise UsageError("a viewer's certificate cannot change a run; expected an operator's "
                             "(`rampart keys issue --operator NAME`)")

    def _payload(self, sequence: int, body: msgspec.Struct) -> bytes:
        return encode(Header(self.name, 1, sequence, self.clock.now()), body)


class Latest(Generic[T]):
    """The newest message of a topic."""

    def __init__(self) -> None:
        self.value: T | None = None
        self._heard = asyncio.Event()

    def keep(self, _key: str, _header: Header, body: T) -> None:
        """Take a message; for `listen`."""
        self.value = body
        self._heard.set()

    async def first(self, timeout_s: float) -> T | None:
        """Return the newest message, or wait for the first one, at most real seconds."""
        await pause(self._heard, timeout_s)
        return self.value


def tools_credentials(run: RunInfo) -> tuple[Credentials | None, str]:
    """Return the credentials with which a tool joins a run, None without keys, and their kind.

    The file is that of `RAMPART_KEY`. Without this variable it is the first operator's of the run's
    folder of keys, by name, else the first viewer's.

    Raises:
        KeysError: the register cannot be read.
        UsageError: there is no such file, or no operator and no viewer.
    """
    if not run.keys:
        return None, OPERATOR
    register = read_register(Path(run.keys))
    doors = credentials_in(run.keys, "", run.folder, run.ports)
    assert doors is not None  # noqa: S101 for the type checker
    chosen = os.environ.get(KEY_VARIABLE, "")
    people = {name: kind for kind in (OPERATOR, VIEWER) for name in sorted(register.of_kind(kind))}
    if chosen:
        if not os.access(chosen, os.R_OK):
            raise UsageError(f"{KEY_VARIABLE}={chosen}: cannot be read; expected the file of an "
                             "operator or a viewer")
        return replace(doors, own=chosen), people.get(Path(chosen).stem, "")
    for name, kind in people.items():
        own = key_file(run.keys, name)
        if os.access(own, os.R_OK):
            return replace(doors, own=own), kind
    raise UsageError(f"{run.keys}: no certificate of an operator or a viewer; `rampart keys issue "
                     f"--viewer NAME` issues one, or set {KEY_VARIABLE} to its file")


async def _is_answered(bus: Bus) -> bool:
    """Whether any node answers; a tool's certificate admits messages of all nodes."""
    replies: list[str] = []
    for _ in range(_TRIES):
        done = asyncio.Event()

        def replied(key: str, _payload: bytes, done: asyncio.Event = done) -> None:
            replies.append(key)
            done.set()

        bus.latest(f"{ROOT}/**", replied, done.set)
        await done.wait()
        if replies:
            return True
        await asyncio.sleep(RESEND_S)
    return False


def _why_unanswered(run: RunInfo, shown: Credentials) -> str:
    name = Path(shown.own).stem
    known = read_register(Path(run.keys)).identities.get(name)
    why = ("its certificate is revoked" if known and known.revoked else
           "expected an operator or a viewer" if known and known.kind not in {OPERATOR, VIEWER}
           else "it was issued after the routers started, is revoked, or has been replaced")
    return (f"{shown.own}: the routers of the run send {name} no messages: {why}; they read the "
            "register when they start: kill-node router_a; kill-node router_b")


def days_left(run: RunInfo) -> dict[str, tuple[float, str]]:
    """Return process → days until its certificate expires, and the time of expiry.

    The time is UTC in ISO 8601. The result is empty without keys, and if the folder of keys or
    `cryptography` is missing.
    """
    if not run.keys:
        return {}
    try:
        from rampart.actors.access import key_folder  # noqa: PLC0415 of an extra

        found = key_folder.lifetimes(Path(run.keys), (*ROUTERS, *run.nodes))
    except (ImportError, KeysError, OSError):
        return {}
    return {name: (round(key_folder.days_left(until), 2), until.isoformat())
            for name, until in found.items()}


def first_to_expire(run: RunInfo) -> dict[str, Any]:
    """Return `name`, `days_left` and `not_after` of the certificate that expires first; or {}."""
    found = days_left(run)
    if not found:
        return {}
    name = min(found, key=lambda name: found[name])
    return {"name": name, "days_left": found[name][0], "not_after": found[name][1]}


@contextlib.asynccontextmanager
async def connect(port: int | None = None) -> AsyncIterator[Session]:
    """Join the run of this machine, or that on a base port.

    Raises:
        UsageError: there is no run, or there are several and no port is given.
        NoEffectError: its routers send nothing to the holder of this certificate.
    """
    with refusing(NoRunError, BusError, KeysError):
        run = find_run(port)
        shown, kind = tools_credentials(run)
        bus = ZenohBus("", run.endpoints, recorder=RecorderConnection(run.base_port),
                       credentials=shown)
        await bus.open()
    try:
        if shown is not None and not await _is_answered(bus):
            raise NoEffectError(_why_unanswered(run, shown))
        yield Session(run, bus, Clock(run.origin_s, run.rate), may_order=kind != VIEWER)
    finally:
        await bus.close()


LOOK_S = 0.25
"""Real seconds between two checks whether a run has ended or begun."""

_AGAIN_S = 5.0


def is_over(run: RunInfo) -> bool:
    """Whether the launcher of a run has ended; its nodes end with it."""
    return process_state(run.pid) in {"X", "Z"}


async def wait_for_run(port: int | None, stop: asyncio.Event) -> bool:
    """Wait for a run to join; return False if `stop` comes first."""
    while not stop.is_set():
        runs = await asyncio.to_thread(find_runs)
        if any(port in {None, run.base_port} for run in runs):
            return True
        await pause(stop, LOOK_S)
    return False


async def sessions(port: int | None, stop: asyncio.Event) -> AsyncGenerator[Session, None]:
    """Wait for a run and yield its session, and that of each later run.

    The body of the caller's loop ends when `is_over` or `stop` is true.

    Args:
        port: base port of the run, by `--run`; None for the only one.
        stop: ends the iteration.

    Raises:
        UsageError: there are several runs, and no port.
    """
    while await wait_for_run(port, stop):
        try:
            async with connect(port) as session:
                yield session
        except UsageError as error:
            if len(find_runs()) > 1:
                raise UsageError(str(error).replace("--port", "--run")) from None
        except NoEffectError as error:
            warn(str(error))
            await pause(stop, _AGAIN_S)


@contextlib.contextmanager
def stopped_by_signals(stop: asyncio.Event) -> Iterator[None]:
    """Set an event on SIGINT, SIGTERM and SIGHUP."""
    loop = asyncio.get_running_loop()
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # as it is under nohup
        numbers.append(signal.SIGHUP)
    for number in numbers:
        loop.add_signal_handler(number, stop.set)
    try:
        yield
    finally:
        for number in numbers:
            loop.remove_signal_handler(number)
