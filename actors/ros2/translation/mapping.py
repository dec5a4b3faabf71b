"""Translation of messages of ROS 2 to messages of the system and back, as a link declares. Pure.

Fields are looked up when a link is read, so a field that does not exist is refused before a run.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, Protocol, get_args

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


class HasSource(Protocol):
    """The header of a message of the system."""

    @property
    def source(self) -> str:
        """Node that has published the message."""


class NotMeantError(Exception):
    """A message that the link does not concern, e.g. a transform of another frame."""


class Inward:
    """Translates messages of ROS 2 into messages of the system.

    Args:
        link: row of the specification.
        types: of ROS 2.
        made: type of the messages of the system.
        beside: type of the messages of the link's `beside`; None for none.

    Raises:
        ValueError: a field does not exist, or a required one has no value; one line.
    """

    def __init__(self, link: Ros2Link, types: Types, made: type[msgspec.Struct],
                 beside: type[msgspec.Struct] | None = None) -> None:
        self._link = link
        self._made = made
        self._picks = link.type == TF
        read = _TRANSFORM if self._picks else link.type
        if self._picks and not (link.frame and link.child):
            raise ValueError("frame and child are missing: expected the frames of the transform")
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
                    raise ValueError(f"fields: {path} of {made.__name__} has no value; expected a "
                                     f"field of {link.type}: {', '.join(fields.names)}")
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
            fields.kind(one, said)
        if path.endswith(_F32):
            return lambda message: np.asarray(expression.read(message), "<f4").tobytes()
        return self._checked(path, said, expression)

    def _checked(self, path: str, said: str, expression: Expression) -> Read:
        """Return a function that reads a known, finite value; None for an unknown optional one."""
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
                raise ValueError(f"{path}: {said} is {found:g}; expected a finite number; {values}")
            return found

        return read

    def __call__(self, message: Any, beside: Any = None) -> tuple[msgspec.Struct, int | None]:
        """Return the message of the system, and the stamp of the message of ROS 2, nanoseconds.

        Args:
            message: of ROS 2.
            beside: newest message of the link's `beside`.

        Raises:
            NotMeantError: the link does not concern it.
            ValueError: a value is beyond the bounds of the message of the system, or the frame is
                another one; one line.
        """
        if self._picks:
            message = self._picked(message)
        stamp_ns = None
        if self.has_stamp:
            header = message.header
            stamp_ns = header.stamp.sec * NS + header.stamp.nanosec
            if self._link.frame and header.frame_id.lstrip("/") != self._link.frame:
                raise ValueError(f"its frame is {header.frame_id[:60]!r}; "
                                 f"expected {self._link.frame!r}")
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
    found = plain(value)
    if isinstance(found, dict):
        return "(" + ", ".join(f"{name} {_shown(part)}" for name, part in found.items()) + ")"
    return f"{found:g}" if isinstance(found, float) else str(found)[:60]


def _read_of(said: str, beside: type[msgspec.Struct]) -> Read:
    """Return a function that reads an expression from a message of the system."""
    expression = Expression(said)
    known = [path for path, _ in _leaves(beside)]
    for path in expression.paths:
        if path not in known:
            raise ValueError(f"fields: {BESIDE}{said}: {beside.__name__} has no field {path!r}"
                             f"{near(path, known)}")
    return expression.read


class Outward:
    """Translates messages of the system into messages of ROS 2.

    Args:
        link: row of the specification.
        types: of ROS 2.
        source: type of the messages of the system.
        lenient: whether no field need be written, as in a request without fields.

    Raises:
        ValueError: a field does not exist, or no field would be written; one line.
    """

    def __init__(self, link: Ros2Link, types: Types, source: type[msgspec.Struct], *,
                 lenient: bool = False) -> None:
        self._link, self._types = link, types
        self._wraps = link.type == TF
        self._name = _TRANSFORM if self._wraps else link.type
        if self._wraps and not (link.frame and link.child):
            raise ValueError("frame and child are missing: expected the frames of the transform")
        fields = TypeFields(types, self._name)
        self._has_header = fields.kind("header") == _HEADER
        leaves = [path for path, _ in _leaves(source)]
        there = {path.rpartition(".")[2]: path for path in leaves}
        said: dict[str, str | float | bool] = {} if link.type in WRITTEN else {
            path: path for path, read in reads_of(self._name, types).items()
            if path == read and path in leaves}
        for quantity, (where, text) in WRITTEN.get(link.type, {}).items():
            if quantity in there:
                said[where] = text.replace(quantity, there[quantity])
        said |= link.fields
        if not (said or lenient):
            raise ValueError(f"fields: no field of {link.type} has a value; {source.__name__} "
                             f"has {', '.join(there.values()) or 'no fields'}")
        plane = Plane(link.datum) if link.datum else None
        self._source, self._leaves = source.__name__, leaves
        self._writes = [(*_place(fields, where), self._read(where, one, plane, fields))
                        for where, one in said.items()]

    def _read(self, where: str, said: str | float | bool, plane: Plane | None, fields: TypeFields
              ) -> Callable[[Any, HasSource | None], Any]:
        if not isinstance(said, str):
            return lambda _message, _header: said
        if said == "@source":
            return lambda _message, header: header.source if header else ""
        expression = Expression(said, plane)
        for path in expression.paths:
            if path not in self._leaves:
                raise ValueError(f"fields: {said!r}: {self._source} has no field {path!r}"
                                 f"{near(path, self._leaves)}")
        read, write = expression.read, fields.writer(where)
        if "".join(expression.paths).endswith(_F32):
            return lambda message, _header: np.frombuffer(read(message), "<f4")
        return lambda message, _header: write(read(message))

    def __call__(self, message: Any, stamp_ns: int, header: HasSource | None = None) -> bytes:
        """Return the encoded message of ROS 2.

        Args:
            message: of the system.
            stamp_ns: stamp of the message, nanoseconds of the clock of ROS 2.
            header: of the message of the system.

        Raises:
            ValueError: a value does not fit its field in ROS 2; one line.
        """
        made = self._types.blank(self._name)
        for way, last, read in self._writes:
            inner = made
            for step in way:
                inner = getattr(inner, step)
            value = read(message, header)
            if isinstance(last, int):
                inner[last] = value
            else:
                setattr(inner, last, value)
        return self._finish(made, stamp_ns)

    def zero(self, stamp_ns: int) -> bytes:
        """Return the encoded message with all fields 0."""
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
    """Return the path of a field that is written without its last step, and that step."""
    fields.kind(where, where)
    way = steps(where)
    if any(isinstance(step, int) for step in way[:-1]):
        raise ValueError(f"fields: {where}: cannot write into the messages of a list")
    return [str(step) for step in way[:-1]], way[-1]


def _leaves(made: type[msgspec.Struct], above: str = ""
            ) -> Iterator[tuple[str, msgspec.structs.FieldInfo]]:
    """Yield path and description of each field of a struct, nested ones included."""
    for field in msgspec.structs.fields(made):
        parts = get_args(field.type)  # the fields of an answer are optional
        kind = parts[0] if type(None) in parts else field.type
        path = f"{above}{field.name}"
        if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
            yield from _leaves(kind, f"{path}.")
        else:
            yield path, field
