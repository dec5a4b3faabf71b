"""Corruption of the body of a message, and the check that it fits the message's type.

A field is named by its path, `outer.inner`; a path through a sequence means the field of each
element. Numbers are changed alone, in (nested) sequences, and in `*_f32` fields, which are
little-endian float32 arrays as bytes. A `*_rad` field is an angle: after an addition it is wrapped
to (-pi, pi]. A value that is set is not wrapped, so that an angle out of range can be injected too.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Iterator
from functools import cache
from random import Random
from typing import Any, NamedTuple

import msgspec

from rampart.actors.bus.bounds import bare, narrow_range
from rampart.actors.bus.messages import Injection

Change = Callable[[float], float]


class InjectionError(ValueError):
    """An injection does not fit its message; the text is one line."""


class FieldType(NamedTuple):
    """Type of a field of a message.

    Attributes:
        declared: the declared type.
        element: type of the elements of a (nested) sequence; otherwise the type without bounds.
        metas: bounds of the field and of its elements.
    """

    declared: Any
    element: Any
    metas: tuple[msgspec.Meta, ...]

    @property
    def is_list(self) -> bool:
        """Whether the field is a sequence."""
        return self.element is not bare(self.declared)


@cache
def field_types(kind: Any) -> dict[str, FieldType]:
    """Return the fields of a message type by name; none for another type."""
    found: dict[str, FieldType] = {}
    for field in msgspec.structs.fields(kind) if isinstance(kind, type) and issubclass(
            kind, msgspec.Struct) else ():
        element, metas = field.type, tuple[msgspec.Meta, ...]()
        while True:
            metas += tuple(m for m in getattr(element, "__metadata__", ())
                           if isinstance(m, msgspec.Meta))
            element = bare(element)
            if getattr(element, "__origin__", None) not in (tuple, list):
                break
            element = element.__args__[0]
        found[field.name] = FieldType(field.type, element, metas)
    return found


def field_type(kind: type[Any], path: str) -> FieldType:
    """Return the type of a field of a message type.

    Raises:
        InjectionError: the message lacks the field.
    """
    found = FieldType(kind, kind, ())
    for name in path.split("."):
        fields = field_types(found.element)
        if name not in fields:
            raise InjectionError(f"field {path!r}: unknown in {kind.__name__}; "
                                 f"known: {', '.join(fields) or 'none'}")
        found = fields[name]
    return found


def is_array(name: str, kind: Any) -> bool:
    """Whether a field is a float32 array as bytes."""
    return bare(kind) is bytes and name.endswith("_f32")


def check_fields(kind: type[Any], order: Injection) -> None:
    """Check a corruption against the type of the messages.

    Raises:
        InjectionError: a field does not exist, or the change does not fit its type.
    """
    for path, value in order.set_fields.items():
        _check_value(kind, path, value)
    for what in ("add_fields", "ramp_fields", "noise_fields"):
        for path in getattr(order, what):
            _check_number(kind, path, what, whole=what == "add_fields")
    for path in order.keep_ends:
        field = field_type(kind, path)
        if not is_array(path, field.declared) and not field.is_list:
            raise InjectionError(f"keep_ends {path!r}: expected a list")


def corrupt(body: Any, order: Injection, elapsed_s: float, draw: Random) -> Any:
    """Return a changed copy of a body: fields set, ramped, biased, noisy or shortened.

    Args:
        body: the message.
        order: the changes.
        elapsed_s: simulated seconds since the injection began.
        draw: source of the noise.

    Raises:
        InjectionError: the message lacks a field, or the value does not fit it.
    """
    data = msgspec.to_builtins(body, builtin_types=(bytes,))
    kind: Any = type(body)
    for path, value in order.set_fields.items():
        for holder, name in _places(data, path):
            fill = _is_number(value) and (
                is_array(name, type(holder[name])) or isinstance(holder[name], list | tuple))
            holder[name] = _changed(name, holder[name], lambda _: value) if fill else value  # noqa: B023
    changes: tuple[tuple[dict[str, float], Callable[[float, float], float]], ...] = (
        (order.ramp_fields, lambda x, rate: x + rate * elapsed_s),
        (order.add_fields, lambda x, bias: x + bias),
        (order.noise_fields, lambda x, sigma: x + draw.gauss(0.0, sigma)))
    for fields, change in changes:
        for path, by in fields.items():
            within = narrow_range(field_type(kind, path).metas)
            for holder, name in _places(data, path):
                holder[name] = _changed(
                    name, holder[name], lambda x: _turned(x, change(x, by), within))  # noqa: B023
    for path in order.keep_ends:
        for holder, name in _places(data, path):
            size = 4 if is_array(name, type(holder[name])) else 1
            if len(holder[name]) > 2 * size:
                holder[name] = holder[name][:size] + holder[name][-size:]
    try:
        return msgspec.convert(data, type(body), builtin_types=(bytes,))
    except msgspec.ValidationError as error:
        raise InjectionError(f"corrupt {type(body).__name__}: {error}") from None


def wrap(angle_rad: float) -> float:
    """Return the angle in (-pi, pi]; infinity and NaN stay."""
    if not math.isfinite(angle_rad):
        return angle_rad
    turned = math.remainder(angle_rad, 2 * math.pi)
    return math.pi if turned <= -math.pi else turned


def _turned(true: float, wrong: float, within: tuple[float, float] | None) -> float:
    """Return a wrong number; beyond its range it errs in the other direction, within the range."""
    if within is None or within[0] <= wrong <= within[1] or not math.isfinite(wrong):
        return wrong
    return min(max(true - (wrong - true), within[0]), within[1])


def _changed(name: str, value: Any, change: Change) -> Any:
    """Return a value with each of its numbers changed."""
    if isinstance(value, tuple | list):
        return [_changed(name, v, change) for v in value]
    if is_array(name, type(value)):
        return _changed_array(name, value, change)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InjectionError(f"field {name!r}: expected a number, got {type(value).__name__}")
    changed = change(value)
    if isinstance(value, float):
        return wrap(changed) if name.endswith("_rad") else changed
    if not math.isfinite(changed):
        raise InjectionError(f"field {name!r}: {changed:g}, expected a whole number")
    return round(changed)


def _changed_array(name: str, value: bytes, change: Change) -> bytes:
    numbers = array("f")
    try:
        numbers.frombytes(value)
    except ValueError:
        raise InjectionError(
            f"field {name!r}: {len(value)} bytes, expected a multiple of 4 (float32)") from None
    return array("f", map(change, numbers)).tobytes()


def _places(data: Any, path: str) -> Iterator[tuple[dict[str, Any], str]]:
    """Yield each dictionary that holds the field, with the field's name."""
    *outer, name = path.split(".")
    holders = [data]
    for chunk in outer:
        holders = [inner for holder in holders for inner in _flat(_member(holder, chunk, path))]
    for holder in holders:
        _member(holder, name, path)
        yield holder, name


def _member(holder: Any, name: str, path: str) -> Any:
    if not isinstance(holder, dict) or name not in holder:
        raise InjectionError(f"field {path!r}: unknown")
    return holder[name]


def _flat(value: Any) -> Iterator[Any]:
    if isinstance(value, tuple | list):
        for element in value:
            yield from _flat(element)
    else:
        yield value


def _check_number(kind: type[Any], path: str, what: str, *, whole: bool) -> None:
    leaf = field_type(kind, path).element
    if leaf is float or is_array(path, leaf) or (whole and leaf is int):
        return
    raise InjectionError(f"{what} {path!r}: {getattr(leaf, '__name__', leaf)}, expected a "
                         f"{'number' if whole else 'float'}")


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _check_value(kind: type[Any], path: str, value: Any) -> None:
    field = field_type(kind, path)
    if is_array(path, field.declared):
        if isinstance(value, bool) or not isinstance(value, bytes | int | float):
            raise InjectionError(f"set_fields {path!r} = {value!r}: expected a number that fills "
                                 "the array, or its bytes")
        return
    try:  # a number fills a sequence
        msgspec.convert(value, field.element if _is_number(value) else field.declared,
                        builtin_types=(bytes,))
    except msgspec.ValidationError as error:
        raise InjectionError(f"set_fields {path!r} = {value!r}: {error}") from None
