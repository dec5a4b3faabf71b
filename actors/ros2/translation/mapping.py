"""Translation of messages of ROS 2 to messages of the system and back, as a link declares. Pure.

Fields are looked up when a link is read, so a field that does not exist is refused before a run.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Annotated, Any, get_args

import msgspec
import numpy as np
from rosbags.interfaces import Nodetype

from rampart.actors.bus.bounds import MOST, Count, Floats32, Meta, Text, Whole, clip
from rampart.actors.bus.envelope import Header
from rampart.actors.bus.messages import Message
from rampart.actors.bus.topic import Qos, Topic
from rampart.actors.ros2.translation.expressions import Expression, Plane, Read, reader, steps
from rampart.actors.ros2.translation.forms import (
    ON_PLANE,
    READY,
    UNBOUNDED,
    UNKNOWN,
    WRITTEN,
    kind_of,
    may_be_unknown,
)
from rampart.actors.ros2.translation.tables import Ros2Link
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


NS = 1_000_000_000

TF = "tf2_msgs/msg/TFMessage"
_TRANSFORM = "geometry_msgs/msg/TransformStamped"
_HEADER = "std_msgs/msg/Header"
_F32 = "_f32"
BESIDE = "beside."


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
        self._source, self._leaves = source.__name__, leaves
        self._writes = [(*_place(fields, where), self._read(where, one, fields))
                        for where, one in said.items()]

    def _read(self, where: str, said: str | float | bool, fields: TypeFields
              ) -> Callable[[Any, Header | None], Any]:
        if not isinstance(said, str):
            return lambda _message, _header: said
        if said == "@source":
            return lambda _message, header: header.source if header else ""
        expression = Expression(said)
        for path in expression.paths:
            if path not in self._leaves:
                raise ValueError(f"fields: {said!r}: {self._source} has no field {path!r}"
                                 f"{near(path, self._leaves)}")
        read, write = expression.read, fields.writer(where)
        if "".join(expression.paths).endswith(_F32):
            return lambda message, _header: np.frombuffer(read(message), "<f4")
        return lambda message, _header: write(read(message))

    def __call__(self, message: Any, stamp_ns: int, header: Header | None = None) -> bytes:
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


_BOUNDED: dict[Any, Any] = {bytes: Floats32, str: Text, float: float, bool: bool, int: Whole}


def topic_of(link: Ros2Link, types: Types) -> Topic[Any]:
    """Return the topic of a link's `to`, for a system that does not declare it.

    Raises:
        ValueError: the type is not known, or a field is wrong; one line.
    """
    if link.publishers == "any":  # the latest message of one says nothing about the others
        qos = Qos.COMMAND
    else:
        qos = Qos.STATE if link.transient_local else Qos.SENSOR
    return Topic(link.to, message_of(link, types), qos, link.rate_hz or 0.0, link.frame,
                 f"{link.name} of ROS 2, {link.type}.")


def message_of(link: Ros2Link, types: Types) -> type[msgspec.Struct]:
    """Return the type of the messages of `topic_of`; raises as it does."""
    ready = dict(READY.get(link.type, {}))
    if link.datum and link.type == "sensor_msgs/msg/NavSatFix":
        ready |= ON_PLANE
    if not ready and not link.fields:
        return _mirrored(link.type, types, {})
    if link.type != TF:
        fields = TypeFields(types, link.type)
        plane = Plane(link.datum) if link.datum else None
        kinds = {name: _python_type(said, fields, plane) for name, said in link.fields.items()}
    else:
        kinds = dict.fromkeys(link.fields, float)
    for name in kinds:
        if not name.isidentifier():
            raise ValueError(f"fields: {name!r}: expected a name, e.g. speed_mps")
    kinds = {name: kind_of(name) for name in ready} | kinds
    made: list[Any] = []
    for name, kind in kinds.items():
        what: Any = _BOUNDED.get(kind, kind)
        is_known = name in link.fields or not may_be_unknown(link.type, ready[name])
        made.append((name, what) if is_known else (name, what | None, None))
    return msgspec.defstruct(
        link.type.rpartition("/")[2], made, bases=(Message,), frozen=True, kw_only=True)


def _python_type(said: str | float | bool, fields: TypeFields, plane: Plane | None) -> Any:
    """Return the Python type of an expression's value."""
    if not isinstance(said, str):
        return type(said)
    if said.startswith(BESIDE):
        return float
    expression = Expression(said, plane)
    if not expression.paths:
        return str
    if said.strip() != expression.paths[0]:
        return int if said.strip().startswith("count(") else float
    kind = fields.kind(said.strip(), said)
    found = _base(kind.removesuffix("[]"))
    if found is None:
        raise ValueError(f"fields: {said!r} is a {kind}; expected one of its fields")
    return _listed(found) if kind.endswith("[]") else found


def _listed(item: Any) -> Any:
    """Return the type of a bounded list."""
    items: Any = tuple[item, ...]
    return Annotated[items, Meta(max_length=MOST)]


def _base(kind: str) -> type | None:
    if kind.endswith("[]") or "/" in kind:
        return None
    return {"string": str, "bool": bool}.get(kind, float if kind.startswith("float") else int)


def _mirrored(name: str, types: Types, made: dict[str, type[msgspec.Struct]]
              ) -> type[msgspec.Struct]:
    """Return a struct with the fields of a type of ROS 2, and its defaults.

    Args:
        name: of the type.
        types: all types.
        made: structs of the message so far; a JSON schema needs one class for each name.
    """
    if name in made:
        return made[name]
    fields, blank = [], types.blank(name)
    for field, what in types.fields(name):
        kind, detail = what
        if kind in {Nodetype.ARRAY, Nodetype.SEQUENCE} and detail[0][1][0] in BULK:
            fields.append((f"{field}{LEN}", Count, 0))
        else:
            made_of = _type_of(what, types, made)
            fields.append((field, made_of, msgspec.convert(plain(getattr(blank, field)), made_of)))
    made[name] = msgspec.defstruct(
        name.rpartition("/")[2], fields, bases=(Message,), frozen=True)
    return made[name]


def _type_of(what: Any, types: Types, made: dict[str, type[msgspec.Struct]]) -> Any:
    kind, detail = what
    if kind == Nodetype.NAME:
        return _mirrored(detail, types, made)
    if kind == Nodetype.BASE:
        return _BOUNDED[_base(detail[0])]
    inner, _ = detail
    return _listed(_type_of(inner, types, made))
