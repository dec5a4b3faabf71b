"""Generates types of ROS 2 from the types of the system's messages, field by field. Pure.

A number becomes float64 or int64, a text or enumeration `string`, a struct a type, a list a
sequence. An optional value becomes a sequence of at most one, a mapping a sequence of `key` and
`value`, and bytes of float32 numbers float32[]. Anything else becomes a `string` of JSON.
"""

from __future__ import annotations

import keyword
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec
import msgspec.inspect as mi
from rosbags.interfaces import Nodetype

from rampart.actors.bus.envelope import Header
from rampart.actors.bus.topic import Topic
from rampart.actors.ros2.ros_clock import NS
from rampart.actors.ros2.translation.types import Types

PACKAGE = "rampart_bus"
"""Package of all generated types."""

_HEADER = "std_msgs/msg/Header"
_NO_NAME = re.compile(r"[^a-z0-9]+")
_F32 = "_f32"


class Made(NamedTuple):
    """A field in ROS 2.

    Attributes:
        what: its type, as `rosbags` describes it.
        write: converts a value.
    """

    what: Any
    write: Callable[[Any], Any]


def _base(name: str, write: Callable[[Any], Any]) -> Made:
    return Made((Nodetype.BASE, (name, 0)), write)


def _as_json(value: Any) -> str:
    return msgspec.json.encode(value).decode()


_BOOL, _FLOAT, _INT = _base("bool", bool), _base("float64", float), _base("int64", int)
_TEXT, _JSON = _base("string", str), _base("string", _as_json)


class StructTypes:
    """Generates types of ROS 2, and encodes messages of them.

    Args:
        types: of ROS 2; generated types are added.
    """

    def __init__(self, types: Types) -> None:
        self._types = types
        self._names: dict[type, str] = {}
        self._taken: set[str] = set()
        self._made: dict[type, Made | None] = {}
        self._defined: dict[str, list[tuple[str, Any]]] = {}

    def encoder(self, topic: Topic[Any]) -> tuple[str, Callable[[Header, Any, int], bytes]]:
        """Return the type of a topic's messages in ROS 2, and a function that encodes them.

        The type has the fields `header`, `node`, `incarnation`, `sequence` and `body`. The function
        takes header, body and stamp in nanoseconds, and raises ValueError if a value does not fit.
        """
        body = self._of(mi.type_info(topic.type))
        name = self._name(f"{topic.type.__name__}Message")
        fields = [("header", (Nodetype.NAME, _HEADER)), ("node", _TEXT.what),
                  ("incarnation", _INT.what), ("sequence", _INT.what)]
        if body is not None:
            fields.append(("body", body.what))
        self._defined[name] = fields
        self._types.define(self._defined)
        self._defined = {}

        def encode(header: Header, content: Any, stamp_ns: int) -> bytes:
            head = self._types.blank(_HEADER)
            head.stamp.sec, head.stamp.nanosec = divmod(max(stamp_ns, 0), NS)
            head.frame_id = topic.frame
            values = {"header": head, "node": header.source, "incarnation": header.incarnation,
                      "sequence": header.sequence}
            if body is not None:
                values["body"] = body.write(content)
            return self._types.encode(name, self._types.new(name, values))

        return name, encode

    def _of(  # noqa: PLR0911 one for each kind of type
            self, kind: mi.Type, name: str = "") -> Made | None:
        """Return the field for a type; None for a struct without fields."""
        match kind:
            case mi.Metadata(type=inner):
                return self._of(inner, name)
            case mi.BoolType():
                return _BOOL
            case mi.FloatType():
                return _FLOAT
            case mi.IntType():
                return _INT
            case mi.StrType():
                return _TEXT
            case mi.BytesType():
                return self._bytes("float32" if name.endswith(_F32) else "uint8")
            case mi.EnumType(cls=cls) if all(isinstance(one.value, str) for one in cls):
                return _base("string", lambda one: one.value)
            case mi.StructType(cls=cls):
                return self._struct(cls, kind)
            case mi.VarTupleType(item_type=item) | mi.ListType(item_type=item) | mi.FrozenSetType(
                    item_type=item) | mi.SetType(item_type=item):
                return self._sequence(item, name)
            case mi.DictType(key_type=key, value_type=value):
                return self._entries(key, value, name)
            case mi.UnionType(types=types):
                return self._optional([one for one in types if not isinstance(one, mi.NoneType)],
                                      len(types), name)
        return _JSON

    def _struct(self, cls: type, kind: mi.StructType) -> Made | None:
        if cls not in self._made:
            self._made[cls] = _JSON  # for a struct that contains itself
            fields = [(field.name, made) for field in kind.fields
                      if (made := self._of(field.type, field.name)) is not None]
            self._made[cls] = self._message(self._name(cls.__name__), [
                (name, made.what, _reader(name, made.write)) for name, made in fields
            ]) if fields else None
        return self._made[cls]

    def _message(self, name: str, parts: list[tuple[str, Any, Callable[[Any], Any]]]) -> Made:
        """Return a new message type from name, type and reader of each field."""
        fields: dict[str, tuple[Any, Callable[[Any], Any]]] = {}
        for part, what, read in parts:
            field = _field_name(part)
            while field in fields:
                field += "2"
            fields[field] = what, read
        self._defined[name] = [(field, what) for field, (what, _) in fields.items()]
        return Made((Nodetype.NAME, name), lambda value: self._types.new(
            name, {field: read(value) for field, (_, read) in fields.items()}))

    def _bytes(self, kind: str) -> Made:
        import numpy as np  # noqa: PLC0415 with the first message

        little = np.dtype(kind).newbyteorder("<")

        def read(value: bytes) -> Any:
            return np.frombuffer(value, little, len(value) // little.itemsize)

        return Made((Nodetype.SEQUENCE, ((Nodetype.BASE, (kind, 0)), 0)), read)

    def _sequence(self, item: mi.Type, name: str, most: int = 0) -> Made | None:
        made = self._of(item, name)
        if made is None:
            return None
        write = made.write
        if made.what[0] == Nodetype.SEQUENCE:  # ROS 2 has no lists of lists
            listed = made
            made = self._message(self._name(f"{_camel(name)}Items"), [
                ("items", listed.what, listed.write)])
            write = made.write
        what = Nodetype.SEQUENCE, (made.what, most)
        kind = made.what[1][0] if made.what[0] == Nodetype.BASE else "string"
        if kind == "string":
            return Made(what, lambda values: [write(value) for value in values])
        return Made(what, lambda values: self._types.numbers(list(map(write, values)), kind))

    def _entries(self, key: mi.Type, value: mi.Type, name: str) -> Made | None:
        keys, values = self._of(key), self._of(value, name)
        if keys is None or values is None:
            return _JSON
        entry = self._message(self._name(f"{_camel(name)}Entry"), [
            ("key", keys.what, lambda pair: keys.write(pair[0])),
            ("value", values.what, lambda pair: values.write(pair[1]))])
        return Made((Nodetype.SEQUENCE, (entry.what, 0)),
                    lambda found: [entry.write(pair) for pair in found.items()])

    def _optional(self, kinds: list[mi.Type], of: int, name: str) -> Made | None:
        if len(kinds) != 1 or len(kinds) == of:
            return _JSON
        made = self._sequence(kinds[0], name, 1)
        return made and Made(made.what, lambda value: made.write(
            () if value is None else (value,)))

    def _name(self, name: str) -> str:
        wanted = chosen = f"{PACKAGE}/msg/{_camel(name)}"
        number = 2
        while chosen in self._taken:
            chosen, number = f"{wanted}Of{number}", number + 1
        self._taken.add(chosen)
        return chosen


def _reader(name: str, write: Callable[[Any], Any]) -> Callable[[Any], Any]:
    return lambda value: write(getattr(value, name))


def _camel(name: str) -> str:
    """Return a name in the form of ROS 2's types."""
    return "".join(part[:1].upper() + part[1:] for part in re.split(r"[^A-Za-z0-9]+", name)
                   ) or "Value"


def _field_name(name: str) -> str:
    """Return a name in the form of ROS 2's fields."""
    name = _NO_NAME.sub("_", name.lower()).strip("_") or "value"
    if not name[0].isalpha():
        name = f"n_{name}"
    return f"{name}_value" if keyword.iskeyword(name) else name
