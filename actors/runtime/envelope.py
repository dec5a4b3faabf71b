"""The wire format: a msgpack array of header and body, and the guard that checks what arrives.

`[source, incarnation, sequence, stamp, body]`. The guard refuses what does not decode, what an
older incarnation of a node still sends after its successor was heard, and what comes twice.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import msgspec

from actors.runtime.topic import Qos, Topic

B = TypeVar("B")

_REMEMBERED_COMMANDS = 64
_COMMAND = Qos.COMMAND


class Header(msgspec.Struct, frozen=True, gc=False):
    """Who sent a message and when.

    `incarnation` counts the lives of a node; `sequence` the messages of one life; `stamp` is the
    simulated time at which the content was true (for a sensor: when it was measured).
    """

    source: str
    incarnation: int
    sequence: int
    stamp: float


class Envelope(Header, Generic[B], frozen=True, array_like=True, gc=False):
    """Header and body as they travel."""

    body: B


pack: Callable[[tuple[str, int, int, float, msgspec.Struct]], bytes] = (
    msgspec.msgpack.Encoder().encode)
"""Returns the payload for source, incarnation, sequence, stamp and body: `encode` in a hurry."""

_decoders: dict[type[Any], Callable[[bytes], Envelope[Any]]] = {}


def encode(header: Header, body: msgspec.Struct) -> bytes:
    """Return the payload of one message."""
    return pack((header.source, header.incarnation, header.sequence, header.stamp, body))


def decode(topic: Topic[Any], payload: bytes) -> tuple[Header, Any]:
    """Return header and body of a payload.

    Raises:
        msgspec.MsgspecError: the payload is not a message of this topic's type.
    """
    envelope = (_decoders.get(topic.type) or _decoder(topic.type))(payload)
    return envelope, envelope.body


def _decoder(kind: type[Any]) -> Callable[[bytes], Envelope[Any]]:
    decoder = msgspec.msgpack.Decoder(Envelope[kind])  # type: ignore[valid-type]
    _decoders[kind] = decoder.decode
    return decoder.decode


class RejectedError(Exception):
    """A payload that must not reach the actor; the text is the reason."""


class ArrivalGuard:
    """Decides for each arriving payload whether the actor may see it."""

    def __init__(self) -> None:
        self._incarnations: dict[str, int] = {}
        self._last: dict[tuple[str, str], int] = {}
        self._recent: dict[tuple[str, str], deque[int]] = {}

    def admission(self, topic: Topic[Any]) -> Callable[[str, bytes], Envelope[Any] | None]:
        """Return the check for one topic: of key and payload, as it is made of every message.

        It returns the message, or None for a duplicate or an overtaken sample.

        Raises:
            RejectedError: it does not decode, or comes from a superseded incarnation.
        """
        unpack, kind = _decoders.get(topic.type) or _decoder(topic.type), topic.type.__name__
        incarnations, newest = self._incarnations, self._last
        is_fresh = self._is_fresh_command if topic.qos is _COMMAND else None

        def admit(key: str, payload: bytes) -> Envelope[Any] | None:
            try:
                message = unpack(payload)
            except (msgspec.MsgspecError, RecursionError) as error:
                raise RejectedError(f"not a {kind}: {error}") from None
            source, sequence = message.source, message.sequence
            if message.incarnation != incarnations.get(source, -1):
                self._meet(source, message.incarnation)
            channel = (source, key)
            if is_fresh is not None:
                return message if is_fresh(channel, sequence) else None
            if sequence <= newest.get(channel, -1):
                return None
            newest[channel] = sequence
            return message

        return admit

    def _is_fresh_command(self, channel: tuple[str, str], sequence: int) -> bool:
        recent = self._recent.get(channel)
        if recent is None:
            recent = self._recent[channel] = deque(maxlen=_REMEMBERED_COMMANDS)
        if sequence in recent:
            return False
        recent.append(sequence)
        return True

    def _meet(self, source: str, incarnation: int) -> None:
        """Take another incarnation than before for the valid one, unless it is an older one."""
        newest = self._incarnations.get(source, -1)
        if incarnation < newest:
            raise RejectedError(
                f"incarnation {incarnation} of {source} was superseded by {newest}")
        self._forget(source)
        self._incarnations[source] = incarnation

    def _forget(self, source: str) -> None:
        for table in (self._last, self._recent):
            for channel in [c for c in table if c[0] == source]:
                del table[channel]
