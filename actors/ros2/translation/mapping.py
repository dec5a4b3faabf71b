"""From messages of ROS 2 to messages of the system, and back, as a link says. Pure.

Everything is looked up when a link is read, so that a field that does not exist is refused before
a run; what is left for a message is to read and to write.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, Protocol

import msgspec
import numpy as np

from rampart.actors.ros2.translation.expressions import Expression, Plane, Read, reader, steps
from rampart.actors.ros2.translation.fields import TypeFields, near, plain, reads_of
from rampart.actors.ros2.translation.forms import ON_PLANE, READY, UNBOUNDED, UNKNOWN, WRITTEN
from rampart.actors.ros2.translation.tables import Ros2Link
from rampart.actors.ros2.translation.types import Types

NS = 1_000_000_000

TF = "tf2_msgs/msg/TFMessage"
_TRANSFORM = "geometry_msgs/msg/TransformStamped"
_HEADER = "std_msgs/msg/Header"
_F32 = "_f32"
BESIDE = "beside."


class Said(Protocol):
    """Where a message of the system comes from: its header."""

    @property
    def source(self) -> str:
        """Node that has published it."""


class NotMeantError(Exception):
    """A message that is none of a link's business, as a transform of another frame is."""


class Inward:
    """Makes messages of the system of those of ROS 2.

    Args:
        link: what is heard, and what becomes of it.
        types: of ROS 2.
        made: type of the messages of the system.
        beside: type of the messages that are read beside; None for none.

    Raises:
        ValueError: a field does not exist, or nothing says what it is to be; one line.
    """

    def __init__(self, link: Ros2Link, types: Types, made: type[msgspec.Struct],
                 beside: type[msgspec.Struct] | None = None) -> None:
        self._link = link
        self._made = made
        self._picks = link.type == TF
        read = _TRANSFORM if self._picks else link.type
        if self._picks and not (link.frame and link.child):
            raise ValueError("frame and child are missing: which transform is meant")
        fields = TypeFields(types, read)
        self.has_stamp = fields.kind("header") == _HEADER
        plane = Plane(link.datum) if link.datum else None
        ready = {**READY.get(link.type, reads_of(link.type, types)), **(
            ON_PLANE if plane and link.type == "sensor_msgs/msg/NavSatFix" else {})}
        needed = dict(_leaves(made))
        self._optional = {path for path, field in needed.items() if field.default is None}
        for path in link.fields:
            if path not in needed:
                raise ValueError(f"fields: {made.__name__} has no field {path!r}"
                                 f"{near(path, needed)}")
        self._reads: list[tuple[list[str], Read]] = []
        self._reads_beside: list[tuple[list[str], Read]] = []
        for path, field in needed.items():
            said = link.fields.get(path, ready.get(path, ready.get(path.rpartition(".")[2])))
            if said is None:
                if field.required:
                    raise ValueError(f"fields: nothing says what {path} of {made.__name__} is; "
                                     f"{link.type} has {', '.join(fields.names)}")
                continue
            if isinstance(said, str) and said.startswith(BESIDE) and beside is not None:
                self._reads_beside.append((path.split("."), _read_of(
                    said.removeprefix(BESIDE), beside)))
                continue
            self._reads.append((path.split("."), self._read(path, said, fields, plane)))

    def _read(self, path: str, said: str | float | bool, fields: TypeFields,
              plane: Plane | None) -> Read:
        if not isinstance(said, str):
            return lambda _message: said
        expression = Expression(said, plane)
        for one in expression.paths:
            fields.check(one, said)
        if path.endswith(_F32):
            return lambda message: np.asarray(expression.read(message), "<f4").tobytes()
        return self._checked(path, said, expression)

    def _checked(self, path: str, said: str, expression: Expression) -> Read:
        """Return what reads a value that means something; None of one that may be missing."""
        kind, is_optional = self._link.type, path in self._optional
        parts = [(text, reader(text)) for text in expression.paths]
        marks = [(text, reader(text), value) for field, (text, value) in
                 UNKNOWN.get(kind, {}).items() if any(
                     steps(part)[0] == field for part in expression.paths)]
        is_bounded = kind in READY and kind not in UNBOUNDED

        def read(message: Any) -> Any:
            for text, mark, value in marks:
                there = mark(message)
                if there == value or (math.isnan(value) and math.isnan(there)):
                    if is_optional:
                        return None
                    raise ValueError(f"{path}: {said} is unknown, {text} = {there:g}")
            found = plain(expression.read(message))
            if isinstance(found, float) and (
                    math.isnan(found) or (is_bounded and math.isinf(found))):
                values = ", ".join(f"{text} = {_shown(part(message))}" for text, part in parts)
                raise ValueError(f"{path}: {said} is {found:g}, a number is right; {values}")
            return found

        return read

    def __call__(self, message: Any, beside: Any = None) -> tuple[msgspec.Struct, int | None]:
        """Return the message of the system, and the stamp of the other's header, nanoseconds.

        Args:
            message: of ROS 2.
            beside: message of the system that is read beside.

        Raises:
            NotMeantError: it is none of the link's business.
            ValueError: it has a value that the message of the system does not take, or is in
                another frame; one line.
        """
        if self._picks:
            message = self._picked(message)
        stamp_ns = None
        if self.has_stamp:
            header = message.header
            stamp_ns = header.stamp.sec * NS + header.stamp.nanosec
            if self._link.frame and header.frame_id.lstrip("/") != self._link.frame:
                raise ValueError(f"its frame is {header.frame_id[:60]!r}; "
                                 f"{self._link.frame!r} is right")
        found: dict[str, Any] = {}
        for source, reads in ((message, self._reads), (beside, self._reads_beside)):
            for path, read in reads:
                inner = found
                for step in path[:-1]:
                    inner = inner.setdefault(step, {})
                inner[path[-1]] = read(source)
        try:
            return msgspec.convert(found, self._made), stamp_ns
        except msgspec.ValidationError as error:
            raise ValueError(str(error).replace("`", "")) from None

    def _picked(self, message: Any) -> Any:
        for transform in message.transforms:
            if (transform.header.frame_id.lstrip("/") == self._link.frame
                    and transform.child_frame_id.lstrip("/") == self._link.child):
                return transform
        raise NotMeantError


def _shown(value: Any) -> str:
    """Return a value in few characters."""
    found = plain(value)
    if isinstance(found, dict):
        return "(" + ", ".join(f"{name} {_shown(part)}" for name, part in found.items()) + ")"
    return f"{found:g}" if isinstance(found, float) else str(found)[:60]


def _read_of(said: str, beside: type[msgspec.Struct]) -> Read:
    """Return what reads an expression of a message of the system."""
    expression = Expression(said)
    known = [path for path, _ in _leaves(beside)]
    for path in expression.paths:
        if path not in known:
            raise ValueError(f"fields: {BESIDE}{said}: {beside.__name__} has no field {path!r}"
                             f"{near(path, known)}")
    return expression.read


class Outward:
    """Makes messages of ROS 2 of those of the system.

    Args:
        link: what is said, and what of.
        types: of ROS 2.
        heard: type of the messages of the system.
        lenient: whether it may be that nothing is said, as in a request without fields.

    Raises:
        ValueError: a field does not exist, or nothing would be said; one line.
    """

    def __init__(self, link: Ros2Link, types: Types, heard: type[msgspec.Struct], *,
                 lenient: bool = False) -> None:
        self._link, self._types = link, types
        self._wraps = link.type == TF
        self._name = _TRANSFORM if self._wraps else link.type
        if self._wraps and not (link.frame and link.child):
            raise ValueError("frame and child are missing: which transform is said")
        fields = TypeFields(types, self._name)
        self._has_header = fields.kind("header") == _HEADER
        leaves = [path for path, _ in _leaves(heard)]
        there = {path.rpartition(".")[2]: path for path in leaves}
        said: dict[str, str | float | bool] = {} if link.type in WRITTEN else {
            path: path for path, read in reads_of(self._name, types).items()
            if path == read and path in leaves}
        for quantity, (where, text) in WRITTEN.get(link.type, {}).items():
            if quantity in there:
                said[where] = text.replace(quantity, there[quantity])
        said |= link.fields
        if not (said or lenient):
            raise ValueError(f"fields: nothing says what {link.type} is to be; {heard.__name__} "
                             f"has {', '.join(there.values()) or 'no fields'}")
        plane = Plane(link.datum) if link.datum else None
        self._heard, self._leaves = heard.__name__, leaves
        self._writes = [(*_place(fields, where), self._read(where, one, plane, fields))
                        for where, one in said.items()]

    def _read(self, where: str, said: str | float | bool, plane: Plane | None, fields: TypeFields
              ) -> Callable[[Any, Said | None], Any]:
        if not isinstance(said, str):
            return lambda _message, _said: said
        if said == "@source":
            return lambda _message, said: said.source if said else ""
        expression = Expression(said, plane)
        for path in expression.paths:
            if path not in self._leaves:
                raise ValueError(f"fields: {said!r}: {self._heard} has no field {path!r}"
                                 f"{near(path, self._leaves)}")
        read, write = expression.read, fields.writer(where)
        if "".join(expression.paths).endswith(_F32):
            return lambda message, _said: np.frombuffer(read(message), "<f4")
        return lambda message, _said: write(read(message))

    def __call__(self, message: Any, stamp_ns: int, said: Said | None = None) -> bytes:
        """Return the message of ROS 2 as it travels.

        Args:
            message: of the system.
            stamp_ns: when its content was true, nanoseconds of the clock that ROS 2 has.
            said: where it comes from.

        Raises:
            ValueError: it has a value that ROS 2 cannot say; one line.
        """
        made = self._types.blank(self._name)
        for way, last, read in self._writes:
            inner = made
            for step in way:
                inner = getattr(inner, step)
            value = read(message, said)
            if isinstance(last, int):
                inner[last] = value
            else:
                setattr(inner, last, value)
        return self._finish(made, stamp_ns)

    def zero(self, stamp_ns: int) -> bytes:
        """Return the message with all fields 0, as it travels."""
        return self._finish(self._types.blank(self._name), stamp_ns)

    def _finish(self, made: Any, stamp_ns: int) -> bytes:
        if self._has_header:
            made.header.stamp.sec, made.header.stamp.nanosec = divmod(max(stamp_ns, 0), NS)
            made.header.frame_id = self._link.frame
        if hasattr(made, "child_frame_id"):
            made.child_frame_id = self._link.child
        if self._wraps:
            whole = self._types.blank(TF)
            whole.transforms = [made]
            made = whole
        return self._types.encode(self._link.type, made)


def _place(fields: TypeFields, where: str) -> tuple[list[str], str | int]:
    """Return the way to a field that is written, and its last step."""
    fields.check(where, where)
    way = steps(where)
    if any(isinstance(step, int) for step in way[:-1]):
        raise ValueError(f"fields: {where}: an item of a list that has fields is not written")
    return [str(step) for step in way[:-1]], way[-1]


def _leaves(made: type[msgspec.Struct], above: str = ""
            ) -> Iterator[tuple[str, msgspec.structs.FieldInfo]]:
    """Yield the paths of the fields of a struct, each with its field."""
    for field in msgspec.structs.fields(made):
        kind = field.type
        path = f"{above}{field.name}"
        if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
            yield from _leaves(kind, f"{path}.")
        else:
            yield path, field
