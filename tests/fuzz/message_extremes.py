"""Values of the types of messages: small ones, the ones at each bound, and Hypothesis strategies.

All are plain (dictionaries, lists, numbers), as they come off the wire, so they imitate a sender
that does not use the message classes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import Any

import msgspec
from hypothesis import strategies as st
from msgspec import inspect

from rampart.actors.bus.envelope import Header
from rampart.actors.bus.topic import Topic
from rampart.actors.osmosis import topics
from rampart.actors.system.topics import system_topics
from rampart.cli import systems
from tests import system_file

Plain = Any
Edge = tuple[str, Plain, bool]
"""The path of a field, its value, and whether it is within the bounds."""

TEXTS = (
    "", "x", "\x1b[2J\x1b]0;title\x07", "two\nlines\r", "\u202edesrever", "\x00", "%s{0}{name}",
    "é€🤖", "null", "[]", "{}", "1", '"text"', "NaN", '{"nodes": 1}', '{"value": {"a": []}}',
    "[" * 400, "/", "..", "a/b", "*", "-1", "true", "1e999",
)

GUARDED = ".set_fields"
"""Fields of any type, whose size the message itself checks (`Injection.__post_init__`)."""

HEADER = inspect.type_info(Header)
_SEQUENCE = (inspect.ListType, inspect.VarTupleType)
_SIZED = (inspect.StrType, inspect.BytesType, inspect.DictType, *_SEQUENCE)
_KNOWN = (inspect.FloatType, inspect.BoolType, inspect.EnumType, inspect.TupleType,
          inspect.StructType)


@cache
def all_topics() -> tuple[Topic[Any], ...]:
    """Return the topics of the shipped systems, each key once."""
    found = {topic.key: topic for name in ("paper", "osmosis", "cell")
             for topic in system_topics(systems.load(str(system_file(name))))}
    return tuple({**{topic.key: topic for topic in topics.ALL}, **found}.values())


def pack(source: str, incarnation: int, sequence: int, stamp: float, body: Plain) -> bytes:
    """Return a payload with a plain body."""
    return msgspec.msgpack.encode((source, incarnation, sequence, stamp, body))


# -- small values ----------------------------------------------------------------------------------


def filled(  # noqa: PLR0911 a return for each kind of type
        kind: inspect.Type, text: str = "", number: int = 0, items: int = 1, array: bytes = b"",
        ) -> Plain:
    """Return a value of a type from a text, a number and an array; collections have `items`."""

    def inner(part: inspect.Type) -> Plain:
        return filled(part, text, number, items, array)

    match kind:
        case inspect.IntType() | inspect.FloatType():
            least = -math.inf if kind.ge is None else kind.ge
            most = math.inf if kind.le is None else kind.le
            value = min(most, max(least, number))
            return float(value) if isinstance(kind, inspect.FloatType) else value
        case inspect.StrType():
            return text[:kind.max_length]
        case inspect.BytesType():
            return array
        case inspect.BoolType():
            return number > 0
        case inspect.EnumType():
            return list(kind.cls)[number % len(kind.cls)].value
        case inspect.LiteralType():
            return kind.values[0]
        case inspect.UnionType():
            return inner(kind.types[0])
        case inspect.TupleType():
            return [inner(part) for part in kind.item_types]
        case inspect.ListType() | inspect.VarTupleType() | inspect.FrozenSetType():
            return [inner(kind.item_type)] * items
        case inspect.DictType():
            return {inner(kind.key_type): inner(kind.value_type) for _ in range(items)}
        case inspect.StructType():
            fields = {field.encode_name: inner(field.type) for field in kind.fields}
            return list(fields.values()) if kind.array_like else fields
    return None


def smallest(kind: inspect.Type) -> Plain:
    """Return a value of a type with empty texts and collections."""
    return filled(kind, items=0)


def sample(kind: Any) -> Any:
    """Return a small message of a class, with an item in each collection."""
    return msgspec.convert(filled(inspect.type_info(kind), "a", 1), kind, builtin_types=(bytes,))


# -- bounds ----------------------------------------------------------------------------------------


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
    for where, part, _ in _parts(kind):
        yield from unbounded(part, path + where)


def _parts(kind: inspect.Type) -> list[tuple[str, inspect.Type, Callable[[Plain], Plain]]]:
    """Return the parts of a type: path, type, and the smallest whole with a given part."""
    base = smallest(kind)
    match kind:
        case inspect.StructType():
            return [(f".{field.name}", field.type,
                     lambda part, name=field.encode_name: {**base, name: part})
                    for field in kind.fields]
        case inspect.DictType():
            value = smallest(kind.value_type)
            return [(" key", kind.key_type, lambda key: {key: value}),
                    ("", kind.value_type, lambda part: {"x": part})]
        case inspect.TupleType():
            return [(f"[{at}]", part,
                     lambda inner, at=at: [*base[:at], inner, *base[at + 1:]])
                    for at, part in enumerate(kind.item_types)]
        case inspect.ListType() | inspect.VarTupleType():
            return [("[]", kind.item_type, lambda part: [part])]
    return []


def edges(kind: inspect.Type, path: str = "$") -> Iterator[Edge]:
    """Yield values just inside and just outside of each bound, all else as small as can be."""
    for value, fits in _own_edges(kind):
        yield path, value, fits
    for where, part, whole in _parts(kind):
        for inner, value, fits in edges(part, path + where):
            yield inner, whole(value), fits


def _own_edges(kind: inspect.Type) -> Iterator[tuple[Plain, bool]]:
    match kind:
        case inspect.IntType():
            for bound, beyond in ((kind.ge, -1), (kind.le, 1)):
                if bound is not None:
                    yield bound, True
                    if -(2**63) <= bound + beyond < 2**64:
                        yield bound + beyond, False
        case inspect.FloatType():
            yield from ((math.nan, kind.ge is None), (-math.inf, kind.ge is None),
                        (math.inf, kind.le is None))
            for bound, beyond in ((kind.ge, -math.inf), (kind.le, math.inf)):
                if bound is not None:
                    yield from ((float(bound), True), (math.nextafter(bound, beyond), False))
        case inspect.EnumType():
            yield from ((member.value, True) for member in kind.cls)
            yield "no such word", False
        case inspect.AnyType():
            yield from (([1.0, {"x": "y"}], True), (["x" * 1000] * 400, False),
                        ([[[[[[[[[[[[0]]]]]]]]]]]], False))
    if isinstance(kind, _SIZED):
        yield _of_length(kind, kind.max_length or 1), True
        if kind.max_length is not None:
            yield _of_length(kind, kind.max_length + 1), False


def _of_length(kind: inspect.Type, size: int) -> Plain:
    match kind:
        case inspect.StrType():
            return "x" * size
        case inspect.BytesType():
            return bytes(size)
        case inspect.DictType():
            return {f"{number}": smallest(kind.value_type) for number in range(size)}
    return [smallest(kind.item_type)] * size


# -- strategies ------------------------------------------------------------------------------------


def mostly(sane: st.SearchStrategy[Any], wild: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    """Draw one of eight values from the second strategy."""
    return st.sampled_from((sane,) * 7 + (wild,)).flatmap(lambda chosen: chosen)


def values(kind: inspect.Type, words: Sequence[str], most: int = 3  # noqa: PLR0911 a return for each kind of type
           ) -> st.SearchStrategy[Plain]:
    """Draw values of a type, within its bounds and often at them.

    Args:
        kind: the type.
        words: texts that the reader may know.
        most: items of a collection; one of a message may also be full.
    """
    match kind:
        case inspect.IntType():
            least = -(2**63) if kind.ge is None else kind.ge
            last = 2**63 - 1 if kind.le is None else kind.le
            small = st.integers(max(least, min(0, last)), min(last, max(least, 5)))
            return mostly(small, st.integers(least, last) | st.sampled_from((least, last)))
        case inspect.FloatType():
            any_float = st.floats(kind.ge, kind.le)
            near = st.floats(-50, 50)
            return any_float | (near if kind.ge is None and kind.le is None else any_float)
        case inspect.StrType():
            longest = kind.max_length or 1000
            wild = (*TEXTS, "x" * longest, "[" * longest, "\U0001f916" * min(longest, 5000))
            return st.one_of(st.sampled_from(words), st.sampled_from(words), st.sampled_from(wild)
                             ).map(lambda text: text[:longest])
        case inspect.BytesType():
            size = st.sampled_from((0, 724, 1, 3, 4, 8, 726, kind.max_length or 1000))
            pattern = st.sampled_from((b"\x00\x00\x40\x40", bytes(4), b"\xff" * 4,
                                       b"\x00\x00\x80\x7f", b"\x00\x00\x80\xff"))
            return st.builds(lambda size, four: (four * (size // 4 + 1))[:size], size, pattern)
        case inspect.BoolType():
            return st.booleans()
        case inspect.EnumType():
            return st.sampled_from([member.value for member in kind.cls])
        case inspect.TupleType():
            return st.tuples(*(values(part, words, 1) for part in kind.item_types)).map(list)
        case inspect.ListType() | inspect.VarTupleType():
            one, longest = values(kind.item_type, words, 1), kind.max_length or 100
            some = st.lists(one, max_size=min(most, longest))
            return some if most == 1 else mostly(some, one.map(lambda item: [item] * longest))
        case inspect.DictType():
            return st.dictionaries(values(kind.key_type, words, 1),
                                   values(kind.value_type, words, 1), max_size=2)
        case inspect.StructType():
            fields = {field.encode_name: values(field.type, words, most) for field in kind.fields}
            needed = {field.encode_name for field in kind.fields if field.required}
            return st.fixed_dictionaries(
                {name: fields[name] for name in fields if name in needed},
                optional={name: fields[name] for name in fields if name not in needed})
    return st.sampled_from(
        (None, True, 2**63, -1, math.nan, 1.7e308, "x", b"\0\0", [], [[1.0]], {}))
