"""Values at the edges of what a message type allows, found from its annotations.

All are plain (dictionaries, lists, numbers), as they come off the wire, so that a sender is
imitated that does not use the message classes at all.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from random import Random
from typing import Any

import msgspec
from msgspec import inspect

from rampart.actors.bus.envelope import Header
from rampart.actors.bus.topic import Topic
from rampart.actors.osmosis import topics
from rampart.actors.system.topics import system_topics
from rampart.cli import systems
from tests import system_file

Plain = Any
Edge = tuple[str, Plain, bool]
"""Which field, its value, and whether it is within the bounds."""

FLOATS = (math.nan, math.inf, -math.inf, 0.0, -0.0, 5e-324, -1.0, 1.0, 0.5, 1e9, 1.7e308, -1.7e308)

TEXTS = (
    "", "x", "\x1b[2J\x1b]0;title\x07", "two\nlines\r", "\u202edesrever", "\x00", "%s{0}{name}",
    "é€🤖", "null", "[]", "{}", "1", '"text"', "NaN", '{"nodes": 1}', '{"value": {"a": []}}',
    "[" * 400, "/", "..", "a/b", "*", "-1", "true", "1e999",
)

GUARDED = ".set_fields"
"""Fields of any type, whose size the message itself checks (`Injection.__post_init__`)."""


_FLOATS32 = (b"\x00\x00\x00\x00", b"\xff\xff\xff\xff", b"\x00\x00\x80\x7f",
             b"\x00\x00\x40\x40", b"\x00\x00\x80\xff")
_SEQUENCE = (inspect.ListType, inspect.VarTupleType)
_SIZED = (inspect.StrType, inspect.BytesType, inspect.DictType, *_SEQUENCE)
_KNOWN = (inspect.FloatType, inspect.BoolType, inspect.EnumType, inspect.TupleType,
          inspect.StructType)
_EMPTY: tuple[tuple[Any, Plain], ...] = (
    (inspect.FloatType, 0.0), (inspect.BoolType, False), (inspect.StrType, ""),
    (inspect.BytesType, b""), (_SEQUENCE, []), (inspect.DictType, {}), (inspect.AnyType, None))


def all_topics() -> tuple[Topic[Any], ...]:
    """Return the topics of the shipped systems, each key once."""
    found = {topic.key: topic for name in ("paper", "osmosis", "cell")
             for topic in system_topics(systems.load(str(system_file(name))))}
    return tuple({**{topic.key: topic for topic in topics.ALL}, **found}.values())


def unbounded(kind: inspect.Type, path: str = "$") -> Iterator[str]:
    """Yield the path of each whole number, text, array or collection that may be of any size."""
    what = type(kind).__name__.removesuffix("Type")
    if isinstance(kind, inspect.IntType):
        loose = kind.ge is None or kind.le is None
    elif isinstance(kind, _SIZED):
        loose = kind.max_length is None
    elif isinstance(kind, inspect.AnyType):
        loose = not path.endswith(GUARDED)
    else:
        loose = not isinstance(kind, _KNOWN)
    if loose:
        yield f"{path}: {what}"
    for where, part in _parts(kind):
        yield from unbounded(part, path + where)


def _parts(kind: inspect.Type) -> list[tuple[str, inspect.Type]]:
    """Return what a type is made of, each with what it adds to the path."""
    if isinstance(kind, inspect.StructType):
        return [(f".{field.name}", field.type) for field in kind.fields]
    if isinstance(kind, inspect.DictType):
        return [(" key", kind.key_type), ("", kind.value_type)]
    if isinstance(kind, inspect.TupleType):
        return [(f"[{index}]", part) for index, part in enumerate(kind.item_types)]
    if isinstance(kind, _SEQUENCE):
        return [("[]", kind.item_type)]
    return []


def smallest(kind: inspect.Type) -> Plain:
    """Return a value of a type with as little in it as there can be."""
    if isinstance(kind, inspect.IntType):
        return max(0, kind.ge or 0)
    if isinstance(kind, inspect.EnumType):
        return next(iter(kind.cls)).value
    if isinstance(kind, inspect.TupleType):
        return [smallest(part) for part in kind.item_types]
    if isinstance(kind, inspect.StructType):
        return {field.encode_name: smallest(field.type) for field in kind.fields}
    return next(empty for kinds, empty in _EMPTY if isinstance(kind, kinds))


def edges(kind: inspect.Type, path: str = "$") -> Iterator[Edge]:
    """Yield values just inside and just outside of each bound, all else as small as can be."""
    return _EDGES.get(type(kind), _no_edges)(kind, path)


def _no_edges(_kind: inspect.Type, _path: str) -> Iterator[Edge]:
    return iter(())


def _int_edges(kind: inspect.IntType, path: str) -> Iterator[Edge]:
    for bound, beyond in ((kind.ge, -1), (kind.le, 1)):
        if bound is not None:
            yield path, bound, True
            if -(2**63) <= bound + beyond < 2**64:
                yield path, bound + beyond, False


def _float_edges(kind: inspect.FloatType, path: str) -> Iterator[Edge]:
    free = kind.ge is None
    yield path, math.nan, free
    yield path, math.inf, kind.le is None
    yield path, -math.inf, free
    for bound, beyond in ((kind.ge, -math.inf), (kind.le, math.inf)):
        if bound is not None:
            yield path, float(bound), True
            yield path, math.nextafter(bound, beyond), False


def _length_edges(kind: Any, path: str, make: Callable[[int], Plain]) -> Iterator[Edge]:
    yield path, make(kind.max_length or 1), True
    if kind.max_length is not None:
        yield path, make(kind.max_length + 1), False


def _text_edges(kind: inspect.StrType, path: str) -> Iterator[Edge]:
    return _length_edges(kind, path, lambda size: "x" * size)


def _bytes_edges(kind: inspect.BytesType, path: str) -> Iterator[Edge]:
    return _length_edges(kind, path, bytes)


def _enum_edges(kind: inspect.EnumType, path: str) -> Iterator[Edge]:
    yield from ((path, member.value, True) for member in kind.cls)
    yield path, "no such word", False


def _sequence_edges(kind: inspect.VarTupleType, path: str) -> Iterator[Edge]:
    one = smallest(kind.item_type)
    yield from _length_edges(kind, path, lambda size: [one] * size)
    for where, value, fits in edges(kind.item_type, f"{path}[]"):
        yield where, [value], fits


def _tuple_edges(kind: inspect.TupleType, path: str) -> Iterator[Edge]:
    base = smallest(kind)
    for index, part in enumerate(kind.item_types):
        for where, value, fits in edges(part, f"{path}[{index}]"):
            yield where, [*base[:index], value, *base[index + 1:]], fits


def _dict_edges(kind: inspect.DictType, path: str) -> Iterator[Edge]:
    value = smallest(kind.value_type)
    yield from _length_edges(kind, path, lambda size: {f"{n}": value for n in range(size)})
    yield from ((where, {key: value}, fits) for where, key, fits in edges(
        kind.key_type, f"{path} key"))
    yield from ((where, {"x": inner}, fits) for where, inner, fits in edges(kind.value_type, path))


def _struct_edges(kind: inspect.StructType, path: str) -> Iterator[Edge]:
    base = smallest(kind)
    for field in kind.fields:
        for where, value, fits in edges(field.type, f"{path}.{field.name}"):
            yield where, {**base, field.encode_name: value}, fits


def _any_edges(_kind: inspect.AnyType, path: str) -> Iterator[Edge]:
    deep: Plain = 0
    for _ in range(20):
        deep = [deep]
    yield path, [1.0, {"x": "y"}], True
    yield path, deep, False
    yield path, ["x" * 1000] * 400, False


_EDGES: dict[type[inspect.Type], Callable[[Any, str], Iterator[Edge]]] = {
    inspect.IntType: _int_edges, inspect.FloatType: _float_edges, inspect.StrType: _text_edges,
    inspect.BytesType: _bytes_edges, inspect.EnumType: _enum_edges,
    inspect.ListType: _sequence_edges, inspect.VarTupleType: _sequence_edges,
    inspect.TupleType: _tuple_edges, inspect.DictType: _dict_edges,
    inspect.StructType: _struct_edges, inspect.AnyType: _any_edges}


class Drawer:
    """Draws values of types, within their bounds and often at them.

    A field is often what one of the same name was before, or else no two messages would ever be
    about the same thing.

    Args:
        seed: of the dice.
        words: names that mean something to the reader, beside those that do not.

    Attributes:
        wild: whether to draw what no sound sender would say.
    """

    def __init__(self, seed: Any, words: Sequence[str] = ("x",)) -> None:
        self.dice = Random(seed)
        self._words = words
        self._before: dict[str, deque[Plain]] = {}
        self.wild = True
        self._ways: dict[type[inspect.Type], Callable[[Any, int], Plain]] = {
            inspect.IntType: self._int, inspect.FloatType: self._float,
            inspect.BoolType: lambda _kind, _depth: self.dice.random() < 0.5,
            inspect.StrType: self._text, inspect.BytesType: self._bytes,
            inspect.EnumType: lambda kind, _depth: self.dice.choice(list(kind.cls)).value,
            inspect.ListType: self._sequence, inspect.VarTupleType: self._sequence,
            inspect.TupleType: lambda kind, depth: [
                self.value(part, depth) for part in kind.item_types],
            inspect.DictType: self._dict, inspect.StructType: self._struct,
            inspect.AnyType: self._any}

    def remember(self, body: dict[str, Plain]) -> None:
        """Take the fields of a message for ones that others may say again."""
        for name, value in body.items() if isinstance(body, dict) else ():
            self._before.setdefault(name, deque(maxlen=6)).append(value)

    def value(self, kind: inspect.Type, depth: int = 0) -> Plain:
        """Return a value of a type; the deeper in collections, the smaller."""
        return self._ways[type(kind)](kind, depth)

    def _int(self, kind: inspect.IntType, _depth: int) -> int:
        least = -(2**63) if kind.ge is None else kind.ge
        most = 2**63 - 1 if kind.le is None else kind.le
        small = min(most, max(least, self.dice.randrange(6)))
        if not self.wild:
            return small
        return self.dice.choice((small, small, small, small, least, most, most - 1,
                                 self.dice.randint(least, most)))

    def _float(self, kind: inspect.FloatType, _depth: int) -> float:
        least = -math.inf if kind.ge is None else float(kind.ge)
        most = math.inf if kind.le is None else float(kind.le)
        near, dice = self.dice.uniform(-50, 50), self.dice
        if not self.wild:
            return max(least, min(most, dice.choice((near, 0.0, dice.uniform(-1, 1)))))
        value = dice.choice((*FLOATS, near, near, dice.uniform(0, 1), least, most))
        if kind.ge is None or least <= value <= most:
            return value
        return max(least, min(most, near))

    def _text(self, kind: inspect.StrType, _depth: int) -> str:
        longest = kind.max_length or 1000
        if not self.wild or self.dice.random() < 0.6:
            return self.dice.choice(self._words)[:longest]
        robots = "\U0001f916" * min(longest, 5000)
        return self.dice.choice((*TEXTS, "x" * longest, "[" * longest, robots))[:longest]

    def _bytes(self, kind: inspect.BytesType, _depth: int) -> bytes:
        size = self.dice.choice((0, 1, 3, 4, 8, 724, 724, 726, kind.max_length or 1000))
        if not self.wild:
            return struct.pack("<181f", *(self.dice.uniform(0, 8) for _ in range(181)))
        pattern = self.dice.choice((*_FLOATS32, self.dice.randbytes(4)))
        return (pattern * (size // 4 + 1))[:size]

    def _sequence(self, kind: inspect.VarTupleType, depth: int) -> list[Plain]:
        most = kind.max_length or 100
        if self.wild and depth == 0 and self.dice.random() < 0.1:  # as many as there may be
            return [self.value(kind.item_type, 3)] * self.dice.choice((most, most // 2))
        count = min(most, self.dice.choice((0, 0, 1, 1, 2, 3) if depth < 3 else (0, 1)))
        return [self.value(kind.item_type, depth + 1) for _ in range(count)]

    def _dict(self, kind: inspect.DictType, depth: int) -> dict[Plain, Plain]:
        return {self.value(kind.key_type): self.value(kind.value_type, depth + 1)
                for _ in range(self.dice.randrange(3))}

    def _struct(self, kind: inspect.StructType, depth: int) -> dict[str, Plain]:
        return {field.encode_name: self._field(field, depth)
                for field in kind.fields if field.required or self.dice.random() < 0.7}

    def _field(self, field: inspect.Field, depth: int) -> Plain:
        before = self._before.get(field.encode_name)
        if depth == 0 and before and self.dice.random() < 0.4:
            return self.dice.choice(before)  # if it is of another type the message is drawn anew
        return self.value(field.type, depth)

    def _any(self, _kind: inspect.AnyType, _depth: int) -> Plain:
        return self.dice.choice((None, True, 2**63, -1, *FLOATS, "x", b"\x00\x00", [], [[1.0]], {}))


HEADER = inspect.type_info(Header)


def pack(source: str, incarnation: int, sequence: int, stamp: float, body: Plain) -> bytes:
    """Return a payload with a plain body."""
    return msgspec.msgpack.encode((source, incarnation, sequence, stamp, body))
