"""What processes of other hosts publish, for the recording that is made on one.

Processes of this machine hand their messages to the recorder (`recorder_connection`); those of
other hosts cannot. So of what may be said elsewhere, and of that alone, the recorder is a
subscriber on the bus: what crosses the link then is what is recorded. A key may be spoken on from
both sides, so what comes by the bus is left out if its process hands over its messages here. And a
partition is told: from when to when nothing was heard of a host stands in the file.
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
"""Of a host, that are told one by one; with more the last one covers what follows."""

Frame = tuple[float, str, bytes]
"""When, by the monotonic clock; full key; payload."""

_MOST_BYTES = 60_000
_MOST_WAITING = 100_000
_PROCESSES = 4096
_GARBAGE = 64
_RETRY_S = 0.2


class OtherHosts(msgspec.Struct, frozen=True):
    """What is to be heard of other hosts.

    Attributes:
        keys: key expressions of all that may be published there; no key is in two of them.
        guards: by host, whose messages show that it is heard: its supervisor and routers.
        lost_after_s: a host of which nothing came for so many real seconds is not heard.
    """

    keys: tuple[str, ...]
    guards: dict[str, tuple[str, ...]]
    lost_after_s: float


def others_of(layout: Layout) -> OtherHosts | None:
    """Return what there is to be heard of other hosts; None in a system of one."""
    hosts = layout.hosts
    if not hosts.several:
        return None
    own = hosts.supervisors[layout.plan.host]
    names = {supervisor: name for name, supervisor in hosts.called.items()}
    guards = {names[supervisor]: hosts.guards_of(host)
              for host, supervisor in hosts.supervisors.items() if supervisor != own}
    return OtherHosts(distinct(published_elsewhere(layout)), guards, hosts.link.lost_after_s)


def distinct(expressions: Collection[str]) -> tuple[str, ...]:
    """Return the key expressions that no other one includes; everything, if they are too many."""
    if sum(map(len, expressions)) > _MOST_BYTES:
        return (EVERYTHING,)
    wide = [zenoh.KeyExpr(one) for one in expressions if "*" in one]
    return tuple(sorted(
        one for one in expressions
        if not any(str(other) != one and other.includes(one) for other in wide)))


class EachOnce:
    """Leaves out what came by the bus and was handed over here as well. Pure; bounded.

    What was handed over until a time is to be taken before what came by the bus until then.
    """

    def __init__(self) -> None:
        self._here: Remembered[tuple[str, int], None] = Remembered(_PROCESSES)
        self._garbage: Remembered[tuple[str, bytes], None] = Remembered(_GARBAGE)

    def handed_over(self, frames: Iterable[Frame]) -> None:
        """Note what processes of this machine have sent."""
        for _, key, payload in frames:
            header = header_of(payload)
            if header is None:
                self._garbage[key, payload] = None
            else:
                self._here[header.source, header.incarnation] = None

    def from_elsewhere(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, str]]:
        """Yield what was sent by processes of other hosts, with who did; "" of garbage."""
        for frame in frames:
            header = header_of(frame[2])
            if header is None:
                if frame[1:] not in self._garbage:
                    yield frame, ""
            elif (header.source, header.incarnation) not in self._here:
                yield frame, header.source


@dataclass(slots=True)
class _Silence:
    """Of a host: since when, and until when; None if it lasts. Monotonic seconds."""

    from_s: float
    to_s: float | None = None


class Silences:
    """From when to when nothing was heard of other hosts. Pure; times are monotonic seconds.

    Args:
        others: whom it is about.
        begun_s: when hearing began.
    """

    def __init__(self, others: OtherHosts, begun_s: float) -> None:
        self._host_of = {name: host for host, names in others.guards.items() for name in names}
        self._limit_s = others.lost_after_s
        self._heard_s = dict.fromkeys(others.guards, begun_s)
        self._told: dict[str, list[_Silence]] = {host: [] for host in others.guards}

    def heard(self, source: str, at_s: float) -> None:
        """Note that something of a process was heard."""
        host = self._host_of.get(source)
        if host is None:
            return
        told, before_s = self._told[host], self._heard_s[host]
        self._heard_s[host] = max(before_s, at_s)
        if told and told[-1].to_s is None:
            told[-1].to_s = at_s
        elif at_s - before_s > self._limit_s:
            self._add(host, _Silence(before_s, at_s))

    def look(self, now_s: float) -> None:
        """Note who has not been heard for too long."""
        for host, heard_s in self._heard_s.items():
            told = self._told[host]
            if now_s - heard_s > self._limit_s and not (told and told[-1].to_s is None):
                self._add(host, _Silence(heard_s))

    def _add(self, host: str, silence: _Silence) -> None:
        told = self._told[host]
        if len(told) < MOST_SILENCES:
            told.append(silence)
        else:
            told[-1].to_s = silence.to_s

    def record(self, simulated: Callable[[float], float]) -> dict[str, str]:
        """Return what stands in the file, see `bag_writer.UNHEARD`.

        Args:
            simulated: returns the simulated time of a monotonic one.
        """
        return {host: json.dumps([
            [round(simulated(one.from_s), 3),
             None if one.to_s is None else round(simulated(one.to_s), 3)] for one in told])
            for host, told in self._told.items()}


class Ear:
    """Hears on the bus what other hosts publish; opened as soon as a router answers.

    Args:
        others: what.
        dial: endpoints of the routers of this host.
        shown: by what it shows who it is; None in a run without keys.
    """

    def __init__(self, others: OtherHosts, dial: list[str], shown: Credentials | None) -> None:
        self._others = others
        self._dial = dial
        self._shown = shown
        self._session: zenoh.Session | None = None
        self._held: list[zenoh.Subscriber[None]] = []
        self._arrived: deque[Frame] = deque(maxlen=_MOST_WAITING)
        self._next_try_s = 0.0

    def take(self) -> list[Frame]:
        """Return what has come since the last time."""
        if self._session is None:
            self._open()
        return [self._arrived.popleft() for _ in range(len(self._arrived))]

    def close(self) -> None:
        """Hear nothing more."""
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
        with contextlib.suppress(zenoh.ZError, OSError):  # it has ended in this moment
            if dial := answering_first(self._dial):
                self._session = open_session(dial, self._shown)
                self._held = [self._session.declare_subscriber(
                    key, Callback(self._hear, lambda: None, indirect=False))
                    for key in self._others.keys]

    def _hear(self, sample: zenoh.Sample) -> None:  # runs on a Zenoh thread
        self._arrived.append(
            (time.monotonic(), str(sample.key_expr), sample.payload.to_bytes()))
