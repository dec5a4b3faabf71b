"""Messages of other hosts, for the recording that one host makes.

Processes of this machine hand their messages to the recorder (`recorder_connection`); those of
other hosts cannot. So the recorder subscribes on the bus to the keys that other hosts may publish.
Processes of both sides may publish on a key: a message from the bus is left out if its process
hands over its messages here. The file also contains the spans in which a host was silent.
"""

from __future__ import annotations

import contextlib
import json
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass

import msgspec
import zenoh
from zenoh.handlers import Callback

from rampart.actors.access.rights import EVERYTHING, published_elsewhere
from rampart.actors.bus.limits import Remembered
from rampart.actors.bus.zenoh_session import Credentials, answering_first, open_session
from rampart.actors.recording.message_form import header_of
from rampart.actors.system.layout import Layout

MOST_SILENCES = 100
"""Most silences of a host that are kept; after that the last one grows."""

Frame = tuple[float, str, bytes]
"""Monotonic time of sending, full key, payload."""

_MOST_BYTES = 60_000
_MOST_WAITING = 100_000
_PROCESSES = 4096
_GARBAGE = 64
_RETRY_S = 0.2


class OtherHosts(msgspec.Struct, frozen=True):
    """The other hosts, and the keys to subscribe to.

    Attributes:
        keys: key expressions of all that may be published there; no key is in two of them.
        guards: by host, the supervisor and routers whose messages show that it is connected.
        lost_after_s: real seconds without their messages after which a host counts as silent.
    """

    keys: tuple[str, ...]
    guards: dict[str, tuple[str, ...]]
    lost_after_s: float


def others_of(layout: Layout) -> OtherHosts | None:
    """Return the other hosts of a system; None if it has one host."""
    hosts = layout.hosts
    if not hosts.several:
        return None
    own = hosts.supervisors[layout.plan.host]
    names = {supervisor: name for name, supervisor in hosts.called.items()}
    guards = {names[supervisor]: hosts.guards_of(host)
              for host, supervisor in hosts.supervisors.items() if supervisor != own}
    return OtherHosts(distinct(published_elsewhere(layout)), guards, hosts.link.lost_after_s)


def distinct(expressions: Collection[str]) -> tuple[str, ...]:
    """Return the key expressions that no other one includes; `**` if they are too many."""
    if sum(map(len, expressions)) > _MOST_BYTES:
        return (EVERYTHING,)
    wide = [zenoh.KeyExpr(expression) for expression in expressions if "*" in expression]
    return tuple(sorted(
        expression for expression in expressions
        if not any(str(other) != expression and other.includes(expression) for other in wide)))


class EachOnce:
    """Leaves out messages from the bus that were also handed over here. Pure; bounded.

    Call `handed_over` with the messages up to a time before `from_elsewhere` with those of the bus.
    """

    def __init__(self) -> None:
        self._here: Remembered[tuple[str, int], None] = Remembered(_PROCESSES)
        self._garbage: Remembered[tuple[str, bytes], None] = Remembered(_GARBAGE)

    def handed_over(self, frames: Iterable[Frame]) -> None:
        """Take messages of processes of this machine."""
        for _, key, payload in frames:
            header = header_of(payload)
            if header is None:
                self._garbage[key, payload] = None
            else:
                self._here[header.source, header.incarnation] = None

    def from_elsewhere(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, str]]:
        """Yield the messages of other hosts' processes, each with its source; "" for garbage."""
        for frame in frames:
            header = header_of(frame[2])
            if header is None:
                if frame[1:] not in self._garbage:
                    yield frame, ""
            elif (header.source, header.incarnation) not in self._here:
                yield frame, header.source


@dataclass(slots=True)
class _Silence:
    """Begin and end of a host's silence, monotonic seconds; None if it lasts."""

    from_s: float
    to_s: float | None = None


class Silences:
    """Spans in which other hosts were silent. Pure; times are monotonic seconds.

    Args:
        others: the other hosts.
        begun_s: begin of the subscription.
    """

    def __init__(self, others: OtherHosts, begun_s: float) -> None:
        self._host_of = {name: host for host, names in others.guards.items() for name in names}
        self._limit_s = others.lost_after_s
        self._newest_s = dict.fromkeys(others.guards, begun_s)
        self._silences: dict[str, list[_Silence]] = {host: [] for host in others.guards}

    def received(self, source: str, at_s: float) -> None:
        """Take the time of a message of a process."""
        host = self._host_of.get(source)
        if host is None:
            return
        silences, before_s = self._silences[host], self._newest_s[host]
        self._newest_s[host] = max(before_s, at_s)
        if silences and silences[-1].to_s is None:
            silences[-1].to_s = at_s
        elif at_s - before_s > self._limit_s:
            self._add(host, _Silence(before_s, at_s))

    def look(self, now_s: float) -> None:
        """Begin the silences of hosts without recent messages."""
        for host, newest_s in self._newest_s.items():
            silences = self._silences[host]
            if now_s - newest_s > self._limit_s and not (silences and silences[-1].to_s is None):
                self._add(host, _Silence(newest_s))

    def _add(self, host: str, silence: _Silence) -> None:
        silences = self._silences[host]
        if len(silences) < MOST_SILENCES:
            silences.append(silence)
        else:
            silences[-1].to_s = silence.to_s

    def record(self, simulated: Callable[[float], float]) -> dict[str, str]:
        """Return the metadata for the file, see `bag_writer.SILENT`.

        Args:
            simulated: converts monotonic to simulated seconds.
        """
        return {host: json.dumps([
            [round(simulated(silence.from_s), 3),
             None if silence.to_s is None else round(simulated(silence.to_s), 3)]
            for silence in silences]) for host, silences in self._silences.items()}


class BusListener:
    """Subscribes to the messages of other hosts as soon as a router answers.

    Args:
        others: the other hosts.
        dial: endpoints of the routers of this host.
        credentials: of the recorder; None in a run without credentials.
    """

    def __init__(self, others: OtherHosts, dial: list[str], credentials: Credentials | None
                 ) -> None:
        self._others = others
        self._dial = dial
        self._credentials = credentials
        self._session: zenoh.Session | None = None
        self._held: list[zenoh.Subscriber[None]] = []
        self._arrived: deque[Frame] = deque(maxlen=_MOST_WAITING)
        self._next_try_s = 0.0

    def take(self) -> list[Frame]:
        """Return the messages since the last call."""
        if self._session is None:
            self._open()
        return [self._arrived.popleft() for _ in range(len(self._arrived))]

    def close(self) -> None:
        """Close the session."""
        session, self._session = self._session, None
        self._held.clear()
        if session is not None:
            with contextlib.suppress(zenoh.ZError):
                session.close()  # type: ignore[no-untyped-call]

    def _open(self) -> None:
        now_s = time.monotonic()
        if now_s < self._next_try_s:
            return
        self._next_try_s = now_s + _RETRY_S
        with contextlib.suppress(zenoh.ZError, OSError):  # the router has just ended
            if dial := answering_first(self._dial):
                self._session = open_session(dial, self._credentials)
                self._held = [self._session.declare_subscriber(
                    key, Callback(self._receive, lambda: None, indirect=False))
                    for key in self._others.keys]

    def _receive(self, sample: zenoh.Sample) -> None:  # runs on a Zenoh thread
        self._arrived.append(
            (time.monotonic(), str(sample.key_expr), sample.payload.to_bytes()))
