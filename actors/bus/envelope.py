"""The wire format: a msgpack array of header and body, and the guard that checks what arrives.

`[source, incarnation, sequence, stamp, body]`. The guard refuses messages that do not decode,
messages of a superseded incarnation or of one that was never issued, duplicates, and stamps in the
future. A stamp in the future would stay fresh indefinitely and shut out all later messages.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import msgspec

from rampart.actors.bus.bounds import MAX_PAYLOAD_BYTES, Count, Incarnation, Name, Seconds
from rampart.actors.bus.run_folder import Register
from rampart.actors.bus.topic import Qos, Topic

B = TypeVar("B")

UNREADABLE = (ValueError, RecursionError)
"""Errors of decoding foreign bytes: msgspec, invalid UTF-8, deep nesting."""

AHEAD_S = 0.1
"""Largest clock jitter, simulated seconds; a stamp further in the future is wrong."""

_PAUSE_S = 0.25
"""Pause of a source, simulated seconds, after which its issued incarnation is looked up again: its
host may have been lost, and another process started in its place."""

_REMEMBERED_COMMANDS = 64

STRANGERS = 512
"""Most sources outside the system, such as tools, whose state is remembered."""

_KEYS = 256
"""Most keys per source whose state is remembered; the oldest is forgotten first."""


class Header(msgspec.Struct, frozen=True, gc=False):
    """Source and time of a message.

    `incarnation` counts the processes of a node, `sequence` the messages of one process. `stamp` is
    the simulated time at which the content was true (for a sensor: of the measurement).
    """

    source: Name
    incarnation: Incarnation
    sequence: Count
    stamp: Seconds


class Envelope(Header, Generic[B], frozen=True, array_like=True, gc=False):
    """Header and body as they travel."""

    body: B


pack: Callable[[tuple[str, int, int, float, msgspec.Struct]], bytes] = (
    msgspec.msgpack.Encoder().encode)
"""Return the payload for source, incarnation, sequence, stamp and body; faster than `encode`."""

_decoders: dict[type[Any], Callable[[bytes], Envelope[Any]]] = {}


def encode(header: Header, body: msgspec.Struct) -> bytes:
    """Return the payload of one message."""
    return pack((header.source, header.incarnation, header.sequence, header.stamp, body))


def unsendable_place(body: msgspec.Struct) -> str:
    """Return where a message has a value that msgpack cannot encode, such as `$.cells[1]`."""
    try:
        msgspec.convert(msgspec.to_builtins(body, enc_hook=lambda _value: {}), type(body))
    except msgspec.ValidationError as error:
        return str(error).rpartition(" - at ")[2].strip("`")
    return "$"


def decode(topic: Topic[Any], payload: bytes) -> tuple[Header, Any]:
    """Return header and body of a payload.

    Raises:
        ValueError, RecursionError: The payload is too long, or not a message of this topic's type.
    """
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise ValueError(too_long(payload))
    envelope = decoder(topic.type)(payload)
    return envelope, envelope.body


def too_long(payload: bytes) -> str:
    """Return the error text of a payload that is too long."""
    return f"{len(payload)} bytes, expected at most {MAX_PAYLOAD_BYTES}"


def decoder(kind: type[Any]) -> Callable[[bytes], Envelope[Any]]:
    """Return the decoder of payloads with this body; made in 0.1 ms and cached."""
    decode = _decoders.get(kind)
    if decode is None:
        made = msgspec.msgpack.Decoder(Envelope[kind])  # type: ignore[valid-type]
        decode = _decoders[kind] = made.decode
    return decode


@dataclass(slots=True)
class _Source:
    """Messages received from the present incarnation of a source.

    Attributes:
        incarnation: Its number.
        at_s: Time of the last message, simulated seconds.
        newest: Newest sequence number by key, for sensors and states.
        recent: Last sequence numbers by key, for commands.
    """

    incarnation: int
    at_s: float = 0.0
    newest: dict[str, int] = field(default_factory=dict)
    recent: dict[str, deque[int]] = field(default_factory=dict)


class ArrivalGuard:
    """Decides for each arriving payload whether the actor may see it.

    Its memory is bounded: it never forgets nodes of the system, and keeps the last `STRANGERS` of
    all others. So a flood of names cannot bring a superseded node back.

    Args:
        now: Returns simulated seconds.
        members: Names of the nodes of the system.
        crowded: Called for each stranger that is forgotten.
        register: Returns the newest issued incarnation of a node; None if unknown, as for tools.
        command_age_s: Oldest accepted command, simulated seconds. An older one was under way for
            so long that its purpose is past.
    """

    def __init__(self, now: Callable[[], float], members: Collection[str] = (),
                 crowded: Callable[[], None] = lambda: None,
                 register: Register = lambda _node: None, command_age_s: float = math.inf) -> None:
        self._now = now
        self._members = frozenset(members)
        self._crowded = crowded
        self._register = register
        self._command_age_s = command_age_s
        self._sources: dict[str, _Source] = {}
        self._strangers: deque[str] = deque()

    def receiver(self, topic: Topic[Any], take: Callable[[str, Envelope[Any]], None],
                 refuse: Callable[[str, str], None]) -> Callable[[str, bytes], None]:
        """Return the receiver of a topic: a function of key and payload.

        Args:
            topic: The topic.
            take: Called with key and message, unless the message is a duplicate or overtaken.
            refuse: Called with key and reason if the message does not decode, has a stamp in the
                future, is an old command, or comes from a superseded incarnation.
        """
        unpack, kind = decoder(topic.type), topic.type.__name__
        sources, meet, is_command = self._sources, self._meet, topic.qos is Qos.COMMAND
        now, object_to, age_s = self._now, self._object_to, self._command_age_s

        def receive(key: str, payload: bytes) -> None:  # called for every message
            if len(payload) > MAX_PAYLOAD_BYTES:
                refuse(key, f"not a {kind}: {too_long(payload)}")
                return
            try:
                message = unpack(payload)
            except UNREADABLE as error:
                refuse(key, f"not a {kind}: {error}")
                return
            now_s = now()
            ahead_s = message.stamp - now_s  # may be NaN
            if not ahead_s <= AHEAD_S or (is_command and ahead_s < -age_s):
                refuse(key, f"stamped {ahead_s:.2f} s ahead of now" if not ahead_s <= AHEAD_S
                       else f"a command, given {-ahead_s:.2f} s ago")
                return
            source = sources.get(message.source)
            if source is None or source.incarnation != message.incarnation or (
                    now_s - source.at_s > _PAUSE_S):
                if objection := object_to(source, message):
                    refuse(key, objection)
                    return
                if source is None or source.incarnation != message.incarnation:
                    source = meet(message.source, message.incarnation)
            source.at_s = now_s
            sequence = message.sequence
            if is_command:
                recent = source.recent.get(key)
                if recent is None:
                    _make_room(source.recent)
                    recent = source.recent[key] = deque(maxlen=_REMEMBERED_COMMANDS)
                if sequence in recent:
                    return
                recent.append(sequence)
            else:
                newest = source.newest
                before = newest.get(key)
                if before is None:
                    _make_room(newest)
                elif sequence <= before:
                    return
                newest[key] = sequence
            take(key, message)

        return receive

    def _object_to(self, source: _Source | None, message: Header) -> str:
        """Return why an incarnation is not a node's present one; "" if it may be."""
        which = f"incarnation {message.incarnation} of {message.source}"
        if source is not None and message.incarnation < source.incarnation:
            return f"{which} was superseded by {source.incarnation}"
        issued = self._register(message.source)
        if issued is not None and message.incarnation != issued:
            return f"{which}, of which {issued} was issued last"
        return ""

    def _meet(self, name: str, incarnation: int) -> _Source:
        if name not in self._members and name not in self._sources:
            self._strangers.append(name)
            if len(self._strangers) > STRANGERS:
                self._sources.pop(self._strangers.popleft(), None)
                self._crowded()
        source = self._sources[name] = _Source(incarnation)
        return source


def _make_room(by_key: dict[str, Any]) -> None:
    if len(by_key) >= _KEYS:
        del by_key[next(iter(by_key))]
