"""Messages as far from sense as their types allow."""

from __future__ import annotations

import types
import typing
from collections.abc import Iterator
from typing import Any

import msgspec

MARKUP = "<img src=x onerror=window.broken=1><script>window.broken=1</script>"
LONG = "ы" * 100_000
TEXTS = ("", MARKUP, LONG, "\x1b[2J\r\n\u202e\x00", "__proto__", "constructor")
INTS = (0, -1, 2**63 - 1, -(2**63))
FLOATS = (0.0, float("nan"), float("inf"), -float("inf"), 1e308, -1e308, 5e-324)
_PLAIN: dict[Any, tuple[Any, ...]] = {
    str: TEXTS, int: INTS, float: FLOATS, bool: (False, True), type(None): (None,),
    bytes: (b"", b"\xff" * 7, b"\x00\x00\xc0\x7f" * 1_000, b"\xff\xff\x7f\x7f" * 300),
    Any: (None, *FLOATS, *TEXTS[:2])}
DOCUMENTS = (
    "", "{", "null", "7", "[]", '"text"', "[" * 100_000, "{}", '{"nodes": 7}', '{"nodes": [7]}',
    '{"robot": []}', '{"name": {"a": 1}}', '{"faults": {"a": null}}', '{"timing": 1e308}',
    '{"a": ' + "9" * 400 + "}", '{"mechanism": [{"name": []}]}', '{"orders": 3}', '{"title": null}',
    '{"node": {"name": "x"}}', '{"strategy": ["x"]}', '{"layers": "all"}')


def values_of(kind: Any) -> tuple[Any, ...]:
    """Return extreme values of a type of a message's field."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Annotated:
        return values_of(arguments[0])
    if origin in (typing.Union, types.UnionType):
        return tuple(v for argument in arguments for v in values_of(argument))
    if origin in (tuple, dict):
        return _collections_of(origin, arguments)
    if kind in _PLAIN:
        return _PLAIN[kind]
    return tuple(messages(kind)) if issubclass(kind, msgspec.Struct) else tuple(kind)


def _collections_of(origin: type, arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    if origin is dict:
        return ({}, {str(v): v for v in values_of(arguments[1])})
    if arguments[-1] is ...:
        entries = values_of(arguments[0])
        return ((), entries, (entries[-1],) * 2_000)
    columns = [values_of(argument) for argument in arguments]
    return tuple(tuple(column[i % len(column)] for column in columns)
                 for i in range(max(map(len, columns))))


def messages(kind: type[msgspec.Struct]) -> Iterator[msgspec.Struct]:
    """Yield messages of a type: with all fields extreme in turn, then with one among plain ones."""
    hints = typing.get_type_hints(kind, include_extras=True)
    columns = {name: values_of(hints[name]) for name in kind.__struct_fields__}
    for i in range(max(map(len, columns.values()), default=1)):
        yield kind(**{name: column[i % len(column)] for name, column in columns.items()})
    plain = {name: column[0] for name, column in columns.items()}
    for name, column in columns.items():
        for value in (*column, *(DOCUMENTS if name in ("document", "values") else ())):
            yield kind(**{**plain, name: value})
