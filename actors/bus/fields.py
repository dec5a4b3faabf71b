"""Fields of messages by name: `pose.x_m`, `cells[2].voltage_v`, `ranges_m[min]`.

A path is names separated by dots. Brackets choose an item of a list by its number (from 0; -1 is
the last), its least or greatest item (`[min]`, `[max]`), or its length (`[len]`).
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
        message: Type of the messages.
        path: Path of the field.

    Attributes:
        kind: "number", "text" or "truth".

    Raises:
        ValueError: The field does not exist or has another kind.
    """

    def __init__(self, message: type[msgspec.Struct], path: str) -> None:
        self.path = path
        self._steps = _steps(path)
        info: inspect.Type = inspect.type_info(message)
        for step in self._steps:
            info = _follow(_plain(info), step, path)
        kind = _SIMPLE.get(type(_plain(info)))
        if kind is None:
            raise ValueError(f"{path}: expected a number, a text or a truth value")
        self.kind = kind

    def beyond(self, message: Any) -> str:
        """Return which item a list of the message is too short for; "" if all exist."""
        value = message
        for step in self._steps:
            if isinstance(step, int) and value is not None and not -len(value) <= step < len(value):
                return f"{self.path}: no item [{step}], the list has {len(value)}"
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
            raise ValueError(f"{path}: not a path of a field, such as pose.x_m or ranges_m[0]")
        name, index = found.groups()
        steps.append(name or (index if index in _FOLDS else int(index)))
        at = found.end()
    if not steps:
        raise ValueError("expected the name of a field")
    return steps


def _plain(info: inspect.Type) -> inspect.Type:
    """Return a type without its metadata and without None."""
    if isinstance(info, inspect.Metadata):
        return _plain(info.type)
    if isinstance(info, inspect.UnionType):
        left = [each for each in info.types if not isinstance(each, inspect.NoneType)]
        return _plain(left[0]) if len(left) == 1 else info
    return info


def _follow(info: inspect.Type, step: str | int, path: str) -> inspect.Type:
    if isinstance(step, int) or (step in _FOLDS and isinstance(info, _LISTS)):
        if not isinstance(info, _LISTS):
            raise ValueError(f"{path}: cannot take [{step}]: the value is not a list")
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
        raise ValueError(f"{path}: cannot take {step}: the value has no fields")
    known = {field.name: field.type for field in info.fields}
    if step not in known:
        near = difflib.get_close_matches(step, known, 1)
        hint = f"did you mean {near[0]}?" if near else f"known: {', '.join(known) or 'none'}"
        raise ValueError(f"{path}: {info.cls.__name__} has no field {step!r}; {hint}")
    return known[step]


class StickMessages:
    """Makes the messages of a joystick: one or two numbers, and whether the stick is held.

    Full deflection gives a number's greatest or least value: the bounds of its type (1 and -1
    without bounds), or plus and minus its `scale`.

    Args:
        message: Type of the messages.
        fields: Fields of the numbers.
        held: Field of the truth value; "" for none.
        scale: Value of each number at full deflection; () for the bounds of its type.

    Raises:
        ValueError: No such message can be made.
    """

    def __init__(self, message: type[msgspec.Struct], fields: Sequence[str], held: str = "",
                 scale: Sequence[float] = ()) -> None:
        known = {field.name: field for field in msgspec.structs.fields(message)}
        steered = (*fields, held) if held else tuple(fields)
        for name in steered:
            if name not in known:
                raise ValueError(f"{name}: not a field of {message.__name__}; expected one of "
                                 f"{', '.join(known)}")
        if left := [name for name, field in known.items()
                    if field.required and name not in steered]:
            raise ValueError(f"{message.__name__} has no value for {', '.join(left)}; expected a "
                             "default in its class")
        self._message = message
        self._held = held
        self._ends = {name: _ends(known[name].type, scale[i] if scale else None)
                      for i, name in enumerate(fields)}
        for name, (low, high) in self._ends.items():
            for value in (0, low, high):
                try:
                    msgspec.convert(value, known[name].type)
                except ValueError as error:
                    when = "at rest" if value == 0 else "at full deflection"
                    raise ValueError(f"{name} = {value:g} {when}: {error}; expected a scale within "
                                     "its bounds") from None

    def __call__(self, position: Sequence[float] | None) -> msgspec.Struct:
        """Return the message of a stick held at a position in [-1, 1], or at rest (None)."""
        values: dict[str, Any] = {self._held: position is not None} if self._held else {}
        for (name, (low, high)), at in zip(self._ends.items(), position or (0, 0), strict=False):
            value = (at * high if at >= 0 else -at * low) + 0.0  # no -0
            values[name] = round(value) if isinstance(high, int) else value
        return self._message(**values)


def _ends(kind: Any, scale: float | None) -> tuple[float, float]:
    """Return the values of a number at -1 and at 1; integers for an integer field."""
    info = _plain(inspect.type_info(kind))
    number = int if isinstance(info, inspect.IntType) else float
    low, high = getattr(info, "ge", None), getattr(info, "le", None)
    if scale is not None:
        low, high = -scale, scale
    return number(-1 if low is None else low), number(1 if high is None else high)
