"""The form of a message in a recording: JSON that people read and that gives the payload back.

JSON has no NaN and no infinity, and injected garbage is not a message. So a message whose JSON does
not give its payload byte for byte also has the payload, in base64. That is tried with each message,
except for types where it cannot fail.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, Generic, TypeVar

import msgspec

from rampart.actors.bus.envelope import UNREADABLE, Envelope, Header, decode, pack
from rampart.actors.bus.topic import ROOT, ROS_SIDE, Topic
from rampart.actors.system.topics import find_topic

B = TypeVar("B")


class Recorded(msgspec.Struct, Generic[B], frozen=True, omit_defaults=True):
    """One message of a recording.

    Attributes:
        source: node that sent it; empty for garbage.
        incarnation: incarnation of the node, from 1; 0 for garbage.
        sequence: number of the message in that incarnation, over all keys; 0 for garbage.
        stamp: simulated seconds at which the content was true; null if it is not finite.
        body: the message, with null for numbers that are not finite; absent for garbage.
        raw: payload that was sent, if the other fields do not give it.
        error: why garbage is not a message.
    """

    source: str
    incarnation: int
    sequence: int
    stamp: float | None
    body: B | msgspec.UnsetType = msgspec.UNSET
    raw: bytes | msgspec.UnsetType = msgspec.UNSET
    error: str = ""


_encode = msgspec.json.Encoder().encode
_raw_only = msgspec.json.Decoder(Recorded[msgspec.Raw])


class MessageForm:
    """The form of one topic's messages.

    Args:
        topic: topic of the key; None for a key without one, where each payload with a header is a
            message.
        foreign: whether it is a key of ROS 2, whose messages have no header.
    """

    def __init__(self, topic: Topic[Any] | None, *, foreign: bool = False) -> None:
        kind: Any = topic.type if topic else Any
        self.topic = topic
        self.is_foreign = foreign
        self._decode: Callable[[bytes], Recorded[Any]] = msgspec.json.Decoder(Recorded[kind]).decode
        self._is_plain = topic is not None and _is_plain(topic.type)

    def recorded(self, payload: bytes) -> tuple[bytes, Header | None, Any]:
        """Return JSON, header and body of a payload; header and body of garbage are None."""
        if self.is_foreign:
            return _encode(Recorded("", 0, 0, None, raw=payload)), None, None
        header: Header
        try:
            if self.topic is None:
                envelope = _of_anything.decode(payload)
                header, body = envelope, envelope.body
            else:
                header, body = decode(self.topic, payload)
        except UNREADABLE as error:
            name = self.topic.type.__name__ if self.topic else "message"
            return _encode(Recorded("", 0, 0, None, raw=payload,
                                    error=f"not a {name}: {error}")), None, None
        parts = (header.source, header.incarnation, header.sequence, header.stamp)
        try:
            text = _encode(Recorded(*parts, body))
            if self._is_exact(text, parts, body, payload):
                return text, header, body
            return _encode(Recorded(*parts, body, payload)), header, body
        except (TypeError, ValueError, RecursionError, OverflowError):
            # A field of any type has a value that MessagePack can hold and JSON cannot.
            return _encode(Recorded(*parts, raw=payload)), header, body

    def payload(self, text: bytes) -> bytes:
        """Return the payload that was sent.

        Raises:
            ValueError: it is not a message of a recording, or of another version of this topic.
        """
        if b'"raw":' in text:
            with_raw = _raw_only.decode(text)
            if with_raw.raw is not msgspec.UNSET:
                return with_raw.raw
        found = self._decode(text)
        if found.body is msgspec.UNSET or found.stamp is None:
            raise ValueError("neither body nor payload")
        try:
            return pack((found.source, found.incarnation, found.sequence, found.stamp, found.body))
        except OverflowError as error:  # JSON has larger numbers than MessagePack
            raise ValueError(str(error)) from None

    def _is_exact(self, text: bytes, parts: tuple[str, int, int, float], body: Any,
                  payload: bytes) -> bool:
        """Return whether the JSON gives the payload."""
        if self._is_plain:  # fails only with null for a number that is not finite
            return b"null" not in text and pack((*parts, body)) == payload
        try:
            return self.payload(text) == payload
        except (ValueError, TypeError, RecursionError):
            return False


def header_of(payload: bytes) -> Header | None:
    """Return the header of a payload, or None for garbage."""
    try:
        return _any_message.decode(payload)
    except UNREADABLE:
        return None


_any_message = msgspec.msgpack.Decoder(Envelope[msgspec.Raw])
_of_anything = msgspec.msgpack.Decoder(Envelope[Any])
_encode_msgpack = msgspec.msgpack.Encoder().encode


_form = cache(MessageForm)
_FOREIGN = MessageForm(None, foreign=True)


class Forms:
    """The forms of the messages of a system.

    Args:
        topics: known topics.
    """

    def __init__(self, topics: Sequence[Topic[Any]]) -> None:
        self._topics = topics
        self._forms: dict[str, MessageForm] = {}

    def of(self, key: str) -> MessageForm:
        """Return the form of the messages on a full key."""
        if key not in self._forms:
            self._forms[key] = _FOREIGN if key.startswith(f"{ROS_SIDE}/") else _form(
                find_topic(key.removeprefix(f"{ROOT}/"), self._topics))
        return self._forms[key]


def _is_plain(kind: Any) -> bool:
    """Return whether no field of a type, nested ones included, takes values of any type."""
    if kind is Any:
        return False
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return all(_is_plain(f.type) for f in msgspec.structs.fields(kind))
    return all(_is_plain(part) for part in getattr(kind, "__args__", ()) if part is not Ellipsis)


# -- schemas ---------------------------------------------------------------------------------------

UNITS = {"m": "m", "mm": "mm", "s": "s", "ms": "ms", "us": "µs", "hz": "Hz", "kg": "kg", "n": "N",
         "nm": "N m", "pa": "Pa", "j": "J", "w": "W", "v": "V", "a": "A", "lux": "lx",
         "mps": "m/s", "mps2": "m/s²", "deg": "°", "rad": "rad", "radps": "rad/s",
         "radps2": "rad/s²", "bytes": "B", "mb": "MB", "celsius": "°C", "percent": "%"}
"""Last word of a field name → unit."""

_SCHEMA_KEYS = ("title", "description", "enum", "contentEncoding", "required", "default")


def plain_schema(kind: Any) -> bytes:
    """Return the schema of a struct type for viewers: one object without references and unions.

    Viewers read a schema to find out what can be plotted. Many support only the basic parts of the
    standard: `type`, `properties`, `items`, `enum`. A number whose field name ends in a unit
    (`x_m`, `yaw_rad`) gets it as `unit`.
    """
    schema = msgspec.json.schema(kind)
    return msgspec.json.encode(_plain(schema, schema.get("$defs", {})))


def _plain(node: Any, definitions: dict[str, Any]) -> dict[str, Any]:
    if "$ref" in node:
        return _plain(definitions[node["$ref"].rpartition("/")[2]], definitions)
    if "anyOf" in node:  # a number, or null: viewers plot the number
        return _plain(next(n for n in node["anyOf"] if n.get("type") != "null"), definitions)
    found = {key: node[key] for key in _SCHEMA_KEYS if key in node}
    kind = node.get("type", "string" if _is_text(node.get("enum", ())) else None)
    if kind is not None:
        found["type"] = kind
    if kind == "object":
        found["properties"] = {
            name: _with_unit(name, _plain(part, definitions))
            for name, part in node.get("properties", {}).items()}
        if isinstance(node.get("additionalProperties"), dict):
            found["additionalProperties"] = _plain(node["additionalProperties"], definitions)
    elif kind == "array":
        parts = node.get("prefixItems") or [node.get("items") or {}]
        found["items"] = _plain(parts[0], definitions)  # tuples here are of one type each
    elif kind is None and "enum" in node:
        found["type"] = "integer"
    return found


def _with_unit(name: str, node: dict[str, Any]) -> dict[str, Any]:
    _, _, word = name.rpartition("_")
    kind = node.get("items", node).get("type")
    has_unit = word != name and word in UNITS and kind in {"integer", "number"}
    return {**node, "unit": UNITS[word]} if has_unit else node


def _is_text(values: Any) -> bool:
    return bool(values) and all(isinstance(value, str) for value in values)
