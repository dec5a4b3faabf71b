"""Converts a value of a file to a declared type, or reports which part does not fit.

`msgspec` converts. The report says what was expected: the type in words, its bounds, or the
description in its `msgspec.Meta`.
"""

from __future__ import annotations

from collections.abc import Iterator
from types import UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

import msgspec
from msgspec import inspect

from rampart.manager.spec.tables import Finding

T = TypeVar("T")

_WORDS: dict[type[inspect.Type], str] = {
    inspect.FloatType: "a number", inspect.IntType: "a whole number", inspect.StrType: "a text",
    inspect.BoolType: "true or false", inspect.VarTupleType: "a list",
    inspect.FrozenSetType: "a list", inspect.DictType: "a table", inspect.StructType: "a table"}
_BOUNDS = {"ge": ", {:.10g} or more", "gt": " > {:.10g}", "le": ", at most {:.10g}",
           "lt": ", below {:.10g}", "min_length": ", at least {} long",
           "max_length": ", at most {} long"}


class MisfitError(ValueError):
    """A value does not fit its type; `finding` has its path and what was expected."""

    def __init__(self, finding: Finding) -> None:
        self.finding = finding
        super().__init__(finding.problem)


def read(value: Any, kind: type[T], path: str = "$") -> T:
    """Convert a value to a type; `path` is its place in the file.

    Raises:
        MisfitError: A field is missing, unknown or of the wrong type.
    """
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        raise MisfitError(_find_misfit(value, kind, path, str(error))) from None


def _find_misfit(value: Any, kind: Any, path: str, problem: str) -> Finding:
    """Return the innermost part of a refused value that does not fit."""
    for step, part, wanted in _parts(value, kind):
        try:
            msgspec.convert(part, wanted)
        except msgspec.ValidationError as error:
            return _find_misfit(part, wanted, path + step, str(error))
    for table in _options(kind):
        if isinstance(value, dict) and _is_table(table):
            known = _fields(table)
            for key in value:
                if key not in known:
                    return Finding(f"{path}.{key}", "unknown field; known: "
                                   f"{', '.join(known) or 'none'}", (value[key],))
            if missing := [field.encode_name for field in msgspec.structs.fields(table)
                           if field.required and field.encode_name not in value]:
                return Finding(path, f"required field {missing[0]!r} is missing")
            name, _, why = problem.partition(": ")  # its fields do not agree
            return (Finding(f"{path}.{name}", why, (value[name],)) if name in value
                    else Finding(path, problem, (value,)))
    words = expected(inspect.type_info(kind))
    return Finding(path, f"expected {words}" if words else problem.replace("`", ""), (value,))


def _parts(value: Any, kind: Any) -> Iterator[tuple[str, Any, Any]]:
    """Yield the parts of a value, each with its path in it and its type."""
    for option in _options(kind):
        whole, of = get_origin(option), get_args(option)
        if isinstance(value, dict) and _is_table(option):
            yield from ((f".{name}", value[name], field)
                        for name, field in _fields(option).items() if name in value)
        elif isinstance(value, dict) and whole is dict:
            yield from ((f".{key}", item, of[1]) for key, item in value.items())
        elif isinstance(value, list | tuple) and whole in {tuple, frozenset}:
            yield from ((f"[{place}]", item, of[0]) for place, item in enumerate(value))


def _options(kind: Any) -> Iterator[Any]:
    """Yield the classes that a type allows, with their parameters."""
    if get_origin(kind) is Annotated:
        kind = kind.__origin__
    if get_origin(kind) in {Union, UnionType}:
        for option in get_args(kind):
            yield from _options(option)
    elif isinstance(get_origin(kind) or kind, type):
        yield kind


def _is_table(option: Any) -> bool:
    return isinstance(option, type) and issubclass(option, msgspec.Struct)


def _fields(table: type[msgspec.Struct]) -> dict[str, Any]:
    return {field.encode_name: field.type for field in msgspec.structs.fields(table)}


def expected(kind: inspect.Type) -> str:
    """Return in words which values a type allows, "" if there are no simple words."""
    words = ""
    match kind:
        case inspect.Metadata(extra={"names": what}):
            words = (f"the name of a {what}" if isinstance(kind.type, inspect.StrType)
                     else f"a list of {what} names")
        case inspect.Metadata(extra_json_schema={"description": described}):
            words = described
        case inspect.Metadata():
            words = expected(kind.type)
        case inspect.UnionType():
            words = " or ".join(filter(None, map(expected, kind.types)))
        case inspect.LiteralType():
            words = " or ".join(map(repr, kind.values))
        case inspect.EnumType():
            words = f"one of {', '.join(member.value for member in kind.cls)}"
        case _:
            words = _WORDS.get(type(kind), "") + "".join(
                text.format(bound) for name, text in _BOUNDS.items()
                if (bound := getattr(kind, name, None)) is not None)
    return words
