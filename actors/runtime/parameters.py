"""A node's parameters from the system spec, one reader per kind of value."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any


def amount(parameters: Mapping[str, Any], name: str, default: float) -> float:
    """Return a parameter that is a number, 0 or more.

    Raises:
        ValueError: it is none; the message names parameter and value.
    """
    value = parameters.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int | float) \
            or not (math.isfinite(value) and value >= 0):
        raise ValueError(f"parameters.{name} = {value!r}: must be a number, 0 or more")
    return float(value)


def switch(parameters: Mapping[str, Any], name: str) -> bool:
    """Return a parameter that is true or false; false if it is left out.

    Raises:
        ValueError: it is neither; the message names parameter and value.
    """
    value = parameters.get(name, False)
    if not isinstance(value, bool):
        raise ValueError(f"parameters.{name} = {value!r}: must be true or false")
    return value


def names(parameters: Mapping[str, Any], name: str) -> tuple[str, ...]:
    """Return a parameter that is a list of names; empty if it is left out.

    Raises:
        ValueError: it is no list of names; the message names parameter and value.
    """
    found = parameters.get(name, ())
    if isinstance(found, str) or not isinstance(found, list | tuple) \
            or not all(isinstance(n, str) and n for n in found):
        raise ValueError(f"parameters.{name} = {found!r}: must be a list of names")
    return tuple(found)
