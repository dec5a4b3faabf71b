"""Sizes of plausible errors of the numbers in a message.

The size comes from the field's range (`Annotated[float, Meta(ge=0, le=1)]`), its unit
(`Meta(extra={"unit": "m"})`), or the unit at the end of its name. A robot's own table
(`Faults.sizes`) counts first.
"""

from __future__ import annotations

from collections.abc import Iterator
from random import Random
from typing import Any, NamedTuple

import msgspec

from rampart.actors.bus.bounds import narrow_range
from rampart.actors.runtime.corruption import field_types, is_array

OF_RANGE = (0.05, 0.3)
"""Least and greatest error as a share of the field's range."""

UNITS: dict[str, tuple[float, float]] = {
    "m": (0.5, 3.0), "cm": (5.0, 50.0), "mm": (5.0, 50.0), "rad": (0.3, 1.5), "deg": (15.0, 90.0),
    "mps": (0.2, 0.8), "mps2": (0.5, 2.0), "radps": (0.2, 1.0), "s": (1.0, 10.0),
    "ms": (100.0, 2000.0), "hz": (1.0, 20.0), "kg": (0.5, 5.0), "n": (5.0, 50.0),
    "nm": (1.0, 10.0), "pa": (1e3, 2e4), "bar": (0.2, 1.0), "k": (5.0, 40.0),
    "degc": (5.0, 40.0), "v": (1.0, 10.0), "a": (0.5, 5.0), "w": (10.0, 200.0),
    "percent": (10.0, 50.0)}
"""Unit, in lower case → least and greatest error of a field without range."""

NO_UNIT = (0.1, 0.5)
"""Least and greatest error of numbers without range and unit, such as ratios."""

NEVER_NEGATIVE = frozenset({"s", "ms", "hz", "kg", "k"})
"""Numbers of these units only grow, like those that their type keeps from being negative."""


class Sizes(NamedTuple):
    """A robot's own sizes.

    Attributes:
        by_end: End of a field's path, least and greatest error; the first match counts.
        only_grow: Ends of paths whose numbers only grow.
    """

    by_end: tuple[tuple[str, float, float], ...] = ()
    only_grow: tuple[str, ...] = ()


class Number(NamedTuple):
    """A number in a message: path, type without bounds, and declarations of its field."""

    path: str
    kind: Any
    metas: tuple[msgspec.Meta, ...]

    @property
    def unit(self) -> str:
        """Declared unit, else the last word of its name, in lower case."""
        for meta in self.metas:
            if unit := (meta.extra or {}).get("unit"):
                return str(unit).lower()
        return self.path.removesuffix("_f32").rpartition("_")[2].lower()


def plausible_offsets(kind: type[msgspec.Struct], draw: Random, sizes: Sizes = Sizes()  # noqa: B008
                      ) -> dict[str, float]:
    """Return a plausible offset for every number in a message type: path → amount, never 0."""
    return {number.path: _offset(number, draw, sizes) for number in numbers(kind)}


def _offset(number: Number, draw: Random, sizes: Sizes) -> float:
    own = next(((a, b) for end, a, b in sizes.by_end if number.path.endswith(end)), None)
    span = narrow_range(number.metas)
    if own is not None:
        grows = number.path.endswith(sizes.only_grow)
    else:
        grows = span is None and (number.unit in NEVER_NEGATIVE
                                  or any(m.ge == 0 or m.gt == 0 for m in number.metas))
    sign = 1.0 if grows else draw.choice((-1.0, 1.0))
    if own is None and span is not None:
        width = span[1] - span[0]
        if number.kind is int:
            return sign * draw.randint(1, max(1, int(OF_RANGE[1] * width)))
        return sign * float(f"{width * draw.uniform(*OF_RANGE):.3g}")
    if number.kind is int:
        return draw.randint(1, 3)
    least, most = own or UNITS.get(number.unit, NO_UNIT)
    return round(sign * draw.uniform(least, most), 3)


def numbers(kind: Any, within: str = "") -> Iterator[Number]:
    """Yield each number in a message type, through structs and sequences."""
    for name, field in field_types(kind).items():
        path = f"{within}{name}"
        if name == "pid":
            continue
        if field.element in (int, float) or is_array(path, field.element):
            yield Number(path, field.element, field.metas)
        yield from numbers(field.element, f"{path}.")
