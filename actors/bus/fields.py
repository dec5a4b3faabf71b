"""Fields of messages by name: `pose.x_m`, `cells[2].voltage_v`, `ranges_m[min]`.

A path is names separated by dots. Of a list, brackets choose one item by its number (from 0; -1
is the last), the least or greatest (`[min]`, `[max]`), or how many there are (`[len]`).
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Sequence
from enum import Enum
from typing import Any

import msgspec
from msgspec import inspect

NUMBER, TEXT, TRUTH = "number", "text", "truth"
ANYTHING = (NUMBER, TEXT, TRUTH)
"""Kinds of fields."""

_STEP = re.compile(r"\.?([A-Za-z_]\w*)|\[(-?\d+|min|max|len)\]")
_FOLDS: dict[str, Callable[[Any], Any]] = {"min": min, "max": max, "len": len}
_LISTS = (inspect.VarTupleType, inspect.ListType, inspect.TupleType)
_SIMPLE: dict[type[inspect.Type], str] = {
    inspect.FloatType: NUMBER, inspect.IntType: NUMBER, inspect.BoolType: TRUTH,
    inspect.StrType: TEXT, inspect.EnumType: TEXT, inspect.LiteralType: TEXT}


class Field:
    """A field of the messages of a type.

    Args:
        message: type of the messages.
        path: of the field.

    Attributes:
        kind: "number", "text" or "truth".

    Raises:
        ValueError: there is no such field, or it is none of these; one line.
    """

    def __init__(self, message: type[msgspec.Struct], path: str) -> None:
        self.path = path
        self._steps = _steps(path)
        info: inspect.Type = inspect.type_info(message)
        for step in self._steps:
            info = _follow(_plain(info), step, path)
        kind = _SIMPLE.get(type(_plain(info)))
        if kind is None:
            raise ValueError(f"{path}: not a number, a text or a truth value")
        self.kind = kind

    def beyond(self, message: Any) -> str:
        """Return which item a list of a message is too short for, "" if none is."""
        value = message
        for step in self._steps:
            if isinstance(step, int) and value is not None and not -len(value) <= step < len(value):
                return f"{self.path}: [{step}] of a list of {len(value)} items"
            value = _taken(value, step)
        return ""

    def __call__(self, message: Any) -> Any:
        """Return the field of a message; None where an optional part or an item is missing."""
        value = message
        for step in self._steps:
            value = _taken(value, step)
        return value.value if isinstance(value, Enum) else value


def _taken(value: Any, step: str | int) -> Any:
    if value is None:
        return None
    if isinstance(step, int):
        return value[step] if -len(value) <= step < len(value) else None
    if step in _FOLDS:
        return _FOLDS[step](value) if len(value) or step == "len" else None
    return getattr(value, step)


def _steps(path: str) -> list[str | int]:
    steps: list[str | int] = []
    at = 0
    while at < len(path):
        found = _STEP.match(path, at)
        if found is None or (at == 0 and path[0] == "."):
            raise ValueError(f"{path}: no path of a field, e.g. pose.x_m or ranges_m[0]")
        name, index = found.groups()
        steps.append(name or (index if index in _FOLDS else int(index)))
        at = found.end()
    if not steps:
        raise ValueError("a field has to be named")
    return steps


def _plain(info: inspect.Type) -> inspect.Type:
    """Return a type without what is said of it and without None."""
    if isinstance(info, inspect.Metadata):
        return _plain(info.type)
    if isinstance(info, inspect.UnionType):
        left = [each for each in info.types if not isinstance(each, inspect.NoneType)]
        return _plain(left[0]) if len(left) == 1 else info
    return info


def _follow(info: inspect.Type, step: str | int, path: str) -> inspect.Type:
    if isinstance(step, int) or (step in _FOLDS and isinstance(info, _LISTS)):
        if not isinstance(info, _LISTS):
            raise ValueError(f"{path}: [{step}] of what is no list")
        if step == "len":
            return inspect.IntType()
        fixed = info.item_types if isinstance(info, inspect.TupleType) else ()
        most = len(fixed) if isinstance(info, inspect.TupleType) else info.max_length
        if isinstance(step, int) and most is not None and not -most <= step < most:
            raise ValueError(f"{path}: [{step}]: the list has at most {most} items, expected "
                             f"{-most} to {most - 1}")
        if isinstance(info, inspect.TupleType):
            return fixed[step if isinstance(step, int) else 0]
        return info.item_type
    if not isinstance(info, inspect.StructType):
        raise ValueError(f"{path}: {step} of what has no fields")
    known = {field.name: field.type for field in info.fields}
    if step not in known:
        near = difflib.get_close_matches(step, known, 1)
        hint = f"did you mean {near[0]}?" if near else f"known: {', '.join(known) or 'none'}"
        raise ValueError(f"{path}: {info.cls.__name__} has no field {step!r}; {hint}")
    return known[step]


class Steered:
    """Messages that say where a stick is: one or two numbers, and whether it is held.

    A number is at its greatest where the stick is at 1, at its least where that is at -1: at the
    bounds of its type, which are 1 and -1 where it has none, or at plus and minus its `scale`.

    Args:
        message: type of the messages.
        fields: those of the numbers.
        held: that of the truth value, "" for none.
        scale: for each number what it is at 1; () for the bounds of its type.

    Raises:
        ValueError: no such message can be made; one line.
    """

    def __init__(self, message: type[msgspec.Struct], fields: Sequence[str], held: str = "",
                 scale: Sequence[float] = ()) -> None:
        known = {field.name: field for field in msgspec.structs.fields(message)}
        steered = (*fields, held) if held else tuple(fields)
        for name in steered:
            if name not in known:
                raise ValueError(f"{name}: a whole field of {message.__name__} is right: "
                                 f"{', '.join(known)}")
        if left := [name for name, field in known.items()
                    if field.required and name not in steered]:
            raise ValueError(f"nothing says what {', '.join(left)} of {message.__name__} is; a "
                             "default in its class is right")
        self._message = message
        self._held = held
        self._ends = {name: _ends(known[name].type, scale[i] if scale else None)
                      for i, name in enumerate(fields)}
        for name, (low, high) in self._ends.items():
            for value in (0, low, high):
                try:
                    msgspec.convert(value, known[name].type)
                except ValueError as error:
                    when = "at rest" if value == 0 else "at full stick"
                    raise ValueError(f"{name} = {value:g} {when}: {error}; a scale within its "
                                     "bounds is right") from None

    def __call__(self, position: Sequence[float] | None) -> msgspec.Struct:
        """Return the message of a stick that is held at a position in [-1, 1], None: at rest."""
        said: dict[str, Any] = {self._held: position is not None} if self._held else {}
        for (name, (low, high)), at in zip(self._ends.items(), position or (0, 0), strict=False):
            value = (at * high if at >= 0 else -at * low) + 0.0  # no -0
            said[name] = round(value) if isinstance(high, int) else value
        return self._message(**said)


def _ends(kind: Any, scale: float | None) -> tuple[float, float]:
    """Return what a number is at -1 and at 1, as whole numbers if it is one."""
    info = _plain(inspect.type_info(kind))
    as_said = int if isinstance(info, inspect.IntType) else float
    low, high = getattr(info, "ge", None), getattr(info, "le", None)
    if scale is not None:
        low, high = -scale, scale
    return as_said(-1 if low is None else low), as_said(1 if high is None else high)
