"""Fields of types of ROS 2, and their values. Pure."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype

from rampart.actors.bus.bounds import clip
from rampart.actors.ros2.translation.expressions import steps
from rampart.actors.ros2.translation.types import Types

BULK = ("uint8", "int8", "byte", "char")
"""A list of these is an image, a point cloud or a map; the system gets its length only."""

LEN = "_len"
"""Suffix of the field with that length."""


class TypeFields:
    """The fields of a type of ROS 2, by path.

    Args:
        types: of ROS 2.
        name: name of the type.

    Raises:
        ValueError: the type is not known.
    """

    def __init__(self, types: Types, name: str) -> None:
        self._types, self._name = types, name
        self.names = [field for field, _ in types.fields(name)]

    def kind(self, path: str, said: str = "") -> str:
        """Return the name of a field's type, with "[]" for a list; "" for a missing `header`.

        Args:
            path: of the field.
            said: expression that contains the path, for messages.

        Raises:
            ValueError: there is no such field.
        """
        what = self._what(path, said)
        return _kind_of(what) if what else ""

    def _what(self, path: str, said: str) -> Any:
        """Return a field's type as `rosbags` describes it; None for a missing `header`."""
        what: Any = (Nodetype.NAME, self._name)
        for step in steps(path, said):
            kind, detail = what
            if isinstance(step, int):
                if kind not in {Nodetype.ARRAY, Nodetype.SEQUENCE}:
                    raise ValueError(f"{said or path!r}: cannot index [{step}]: not a list")
                what = detail[0]
                continue
            if kind != Nodetype.NAME:
                raise ValueError(f"{said or path!r}: no field {step}: not a message")
            name = detail
            known = dict(self._types.fields(name))
            if step not in known:
                if path == step == "header":
                    return None
                raise ValueError(f"{said or path!r}: {name} has no field {step!r}"
                                 f"{near(step, known)}")
            what = known[step]
        return what

    def writer(self, where: str) -> Callable[[Any], Any]:
        """Return a function that converts a value to the type of a field.

        Raises:
            ValueError: there is no such field, or it is a message.
        """
        kind = self.kind(where)
        if kind == "geometry_msgs/msg/Quaternion" or kind.endswith("[]"):
            return partial(self._types.field_like, self._what(where, where))
        if "/" in kind:
            raise ValueError(f"fields: {where} is a {kind}; expected one of its fields")
        if kind.startswith("float"):
            return _finite
        return _ENCODED.get(kind, int)


def _kind_of(what: Any) -> str:
    kind, detail = what
    if kind in {Nodetype.ARRAY, Nodetype.SEQUENCE}:
        return f"{_kind_of(detail[0])}[]"
    return str(detail if kind == Nodetype.NAME else detail[0])


_ENCODED: Mapping[str, Callable[[Any], Any]] = {"string": str, "bool": bool}


def near(name: str, known: Any) -> str:
    """Return the end of an error text: a similar name, or all known names."""
    found = difflib.get_close_matches(name, list(known), 1)
    return f"; did you mean {found[0]}?" if found else f"; known: {', '.join(known) or 'none'}"


def plain(value: Any) -> Any:
    """Return a value of ROS 2 as numbers, texts, lists and dictionaries; long texts are cut."""
    if isinstance(value, str):
        return clip(value)
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list):
        return [plain(item) for item in value]
    fields = getattr(value, "__dataclass_fields__", None)
    if fields is None:
        return value
    found = {}
    for name, field in fields.items():
        if field.type.startswith("ClassVar"):  # a constant
            continue
        inner = getattr(value, name)
        if isinstance(inner, np.ndarray) and inner.dtype in _ONE_BYTE:
            found[f"{name}{LEN}"] = len(inner)
        else:
            found[name] = plain(inner)
    return found


def _finite(value: float) -> float:
    """Return a number; raises ValueError if it is not finite, so that it moves no wheel."""
    if not math.isfinite(value):
        raise ValueError(f"{value}: expected a finite number")
    return float(value)


_ONE_BYTE = (np.uint8, np.int8)


def reads_of(name: str, types: Types, above: str = "") -> dict[str, str]:
    """Return the fields of a type, nested ones included, each with the expression that reads it."""
    found: dict[str, str] = {}
    for field, (kind, detail) in types.fields(name):
        path = f"{above}{field}"
        if kind == Nodetype.NAME:
            found |= reads_of(detail, types, f"{path}.")
        elif kind != Nodetype.BASE and detail[0][1][0] in BULK:
            found[f"{path}{LEN}"] = f"count({path})"
        else:
            found[path] = path
    return found
