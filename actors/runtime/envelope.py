"""The wire format: a msgpack array of header and body, and the guard that checks what arrives.

`[source, incarnation, sequence, stamp, body]`. The guard refuses what does not decode, what an
older incarnation of a node still sends after its successor was heard, and what comes twice.
"""

from __future__ import annotations

from collections import deque
from typing import Any, Generic, TypeVar

import msgspec

from actors.runtime.topic import Qos, Topic

B = TypeVar("B")

_REMEMBERED_COMMANDS = 64


class Header(msgspec.Struct, frozen=True, gc=False):
    """Who sent a message and when.

    `incarnation` counts the lives of a node; `sequence` the messages of one life; `stamp` is the
    simulated time at which the content was true (for a sensor: when it was measured).
    """

    source: str
    incarnation: int
    sequence: int
    stamp: float


class Envelope(msgspec.Struct, Generic[B], frozen=True, array_like=True, gc=False):
    """Header and body as they travel."""

    source: str
    incarnation: int
    sequence: int
    stamp: float
    body: B


_encoder = msgspec.msgpack.Encoder()
_decoders: dict[type[Any], msgspec.msgpack.Decoder[Any]] = {}


def encode(header: Header, body: msgspec.Struct) -> bytes:
    """Return the payload of one message."""
    return _encoder.encode(
        (header.source, header.incarnation, header.sequence, header.stamp, body)
    )


def decode(topic: Topic[Any], payload: bytes) -> tuple[Header, Any]:
    """Return header and body of a payload.

    Raises:
        msgspec.MsgspecError: the payload is not a message of this topic's type.
    """
    decoder = _decoders.get(topic.type)
    if decoder is None:
        decoder = msgspec.msgpack.Decoder(Envelope[topic.type])  # type: ignore[name-defined]
        _decoders[topic.type] = decoder
    e = decoder.decode(payload)
    return Header(e.source, e.incarnation, e.sequence, e.stamp), e.body


class RejectedError(Exception):
    """A payload that must not reach the actor; the text is the reason."""


class ArrivalGuard:
    """Decides for each arriving payload whether the actor may see it."""

    def __init__(self) -> None:
        self._incarnations: dict[str, int] = {}
        self._last: dict[tuple[str, str], int] = {}
        self._recent: dict[tuple[str, str], deque[int]] = {}

    def admit(self, topic: Topic[Any], key: str, payload: bytes) -> tuple[Header, Any] | None:
        """Return header and body, or None for a duplicate or an overtaken sample.

        Raises:
            RejectedError: it does not decode, or comes from a superseded incarnation.
        """
        try:
            header, body = decode(topic, payload)
        except (msgspec.MsgspecError, RecursionError) as error:
            raise RejectedError(f"not a {topic.type.__name__}: {error}") from None
        newest = self._incarnations.get(header.source, -1)
        if header.incarnation < newest:
            raise RejectedError(
                f"incarnation {header.incarnation} of {header.source} was superseded by {newest}")
        if header.incarnation > newest:
            self._forget(header.source)
            self._incarnations[header.source] = header.incarnation
        channel = (header.source, key)
        if topic.qos is Qos.COMMAND:
            recent = self._recent.setdefault(channel, deque(maxlen=_REMEMBERED_COMMANDS))
            if header.sequence in recent:
                return None
            recent.append(header.sequence)
            return header, body
        if header.sequence <= self._last.get(channel, -1):
            return None
        self._last[channel] = header.sequence
        return header, body

    def _forget(self, source: str) -> None:
        for table in (self._last, self._recent):
            for channel in [c for c in table if c[0] == source]:
                del table[channel]
