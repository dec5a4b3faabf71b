"""Expressions that read a value from a message: a path, a function of paths, a factor. Pure.

twist.twist.linear.x            a field of a field
axes[1]                         an item of a list; the last is [-1]
angle_deg * 0.017453292519943295
yaw(pose.pose.orientation)      heading of a quaternion, rad, in (-pi, pi]
quaternion(yaw_rad)             the quaternion of a heading
sqrt(position_covariance[0])    square root; NaN of a negative number
least(ranges)                   of a list without its NaNs; NaN of an empty one
east(latitude, longitude)       m east of the datum, on the plane that touches the ellipsoid there
north(latitude, longitude)      m north of the datum
count(status)                   number of items of a list
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

Read = Callable[[Any], Any]

_CALL = re.compile(r"\s*([a-z]+)\(([^()]*)\)\s*")
_TEXT = re.compile(r"\s*'([^']*)'\s*")
_PATH = re.compile(r"\s*([A-Za-z_][A-Za-z0-9_.\[\]\-]*)\s*")
_STEP = re.compile(r"([A-Za-z_]\w*)((?:\[-?\d{1,6}\])*)\Z")

SEMI_MAJOR_M = 6_378_137.0
"""Of the ellipsoid WGS 84, with its eccentricity squared (NIMA TR8350.2)."""
ECCENTRICITY_2 = 6.694379990141316e-3


class Quaternion(NamedTuple):
    """A rotation with the fields of geometry_msgs/msg/Quaternion."""

    x: float
    y: float
    z: float
    w: float


def yaw(rotation: Any) -> float:
    """Return the heading of a quaternion, rad; NaN if its norm is not 1 (REP-103)."""
    x, y, z, w = rotation.x, rotation.y, rotation.z, rotation.w
    norm = x * x + y * y + z * z + w * w
    if not 0.9 < norm < 1.1:
        return math.nan
    return math.atan2(2 * (w * z + x * y), norm - 2 * (y * y + z * z))


def quaternion(yaw_rad: float) -> Quaternion:
    """Return the rotation by a heading, rad."""
    return Quaternion(0.0, 0.0, math.sin(yaw_rad / 2), math.cos(yaw_rad / 2))


def sqrt(value: float) -> float:
    """Return the square root; NaN of a negative number."""
    return math.sqrt(value) if value >= 0 else math.nan


def least(values: Sequence[float]) -> float:
    """Return the least number of a list, NaN if it is empty."""
    return min((float(v) for v in values if not math.isnan(v)), default=math.nan)


class Plane:
    """The plane that touches the ellipsoid at a point.

    Args:
        datum: latitude and longitude of that point, degrees.
    """

    def __init__(self, datum: tuple[float, float]) -> None:
        self._latitude_deg, self._longitude_deg = datum
        sine = math.sin(math.radians(self._latitude_deg))
        bent = 1 - ECCENTRICITY_2 * sine * sine
        self._north_m = math.radians(
            SEMI_MAJOR_M * (1 - ECCENTRICITY_2) / (bent * math.sqrt(bent)))
        self._east_m = math.radians(SEMI_MAJOR_M / math.sqrt(bent) * math.cos(
            math.radians(self._latitude_deg)))

    def east(self, _latitude_deg: float, longitude_deg: float) -> float:
        """Return the distance of a point to the east, m."""
        return (longitude_deg - self._longitude_deg) * self._east_m

    def north(self, latitude_deg: float, _longitude_deg: float) -> float:
        """Return the distance of a point to the north, m."""
        return (latitude_deg - self._latitude_deg) * self._north_m


_FUNCTIONS: dict[str, tuple[Callable[..., Any], int]] = {
    "yaw": (yaw, 1), "quaternion": (quaternion, 1), "sqrt": (sqrt, 1), "least": (least, 1),
    "count": (len, 1)}
_ON_PLANE = ("east", "north")
FUNCTIONS = (*_FUNCTIONS, *_ON_PLANE)


class Expression:
    """A parsed expression.

    Args:
        text: as in the description of this module.
        plane: for functions of latitude and longitude; None if the link has no datum.

    Attributes:
        paths: fields that it reads.
        read: returns its value for a message.

    Raises:
        ValueError: the text is not an expression; one line.
    """

    def __init__(self, text: str, plane: Plane | None = None) -> None:
        self.paths: tuple[str, ...] = ()
        if quoted := _TEXT.fullmatch(text):
            words = quoted[1]
            self.read: Read = lambda _message: words
            return
        body, star, factor = text.partition("*")
        try:
            scale = float(factor) if star else None
        except ValueError:
            raise ValueError(f"{text!r}: expected a number after *") from None
        called = _CALL.fullmatch(body)
        if called:
            name, inside = called.groups()
            self.paths = tuple(part.strip() for part in inside.split(","))
            function, count = self._function(name, text, plane)
            if len(self.paths) != count:
                raise ValueError(f"{text!r}: {name} takes {count} field{'s' * (count > 1)}")
            reads = [reader(path, text) for path in self.paths]
            whole: Read = partial(_applied, function, reads)
        elif found := _PATH.fullmatch(body):
            self.paths = (found[1],)
            whole = reader(found[1], text)
        else:
            raise ValueError(f"{text!r}: expected a field, e.g. pose.position.x, or a function of "
                             f"one: {', '.join(FUNCTIONS)}")
        self.read = whole if scale is None else lambda message: whole(message) * scale

    @staticmethod
    def _function(name: str, text: str, plane: Plane | None) -> tuple[Callable[..., Any], int]:
        if name in _ON_PLANE:
            if plane is None:
                raise ValueError(f"{text!r}: needs a datum = [latitude, longitude]")
            return getattr(plane, name), 2
        try:
            return _FUNCTIONS[name]
        except KeyError:
            raise ValueError(f"{text!r}: no function {name!r}; known: {', '.join(FUNCTIONS)}"
                             ) from None


def _applied(function: Callable[..., Any], reads: Sequence[Read], message: Any) -> Any:
    return function(*[read(message) for read in reads])


def steps(path: str, text: str = "") -> list[str | int]:
    """Return the steps of a path: names, and indices of lists.

    Raises:
        ValueError: it is not a path.
    """
    found: list[str | int] = []
    for part in path.split("."):
        step = _STEP.match(part)
        if step is None:
            raise ValueError(f"{text or path!r}: {path!r} is not a field, e.g. pose.position.x")
        found.append(step[1])
        found += [int(number) for number in re.findall(r"-?\d+", step[2])]
    return found


def reader(path: str, text: str = "") -> Read:
    """Return a function that reads a path; it raises ValueError for an index out of range.

    Raises:
        ValueError: it is not a path.
    """
    way = steps(path, text)

    def read(message: Any) -> Any:
        value = message
        for step in way:
            if isinstance(step, int):
                if not -len(value) <= step < len(value):
                    raise ValueError(f"{path}: the list has {len(value)} items")
                value = value[step]
            else:
                value = getattr(value, step)
        return value

    return read
