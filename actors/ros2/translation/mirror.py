"""Topics of the system that are generated from topics of ROS 2. Pure.

A common type becomes its quantities (`forms`), any other type is copied field by field. So a ready
module can use any field of a robot without a message type for it.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
from rosbags.interfaces import Nodetype

from rampart.actors.bus.bounds import MOST, Count, Floats32, Meta, Text, Whole
from rampart.actors.bus.messages import Message
from rampart.actors.bus.topic import Qos, Topic
from rampart.actors.ros2.translation.expressions import Expression, Plane
from rampart.actors.ros2.translation.fields import BULK, LEN, TypeFields, plain
from rampart.actors.ros2.translation.forms import ON_PLANE, READY, kind_of, may_be_unknown
from rampart.actors.ros2.translation.mapping import BESIDE, TF
from rampart.actors.ros2.translation.tables import Ros2Link
from rampart.actors.ros2.translation.types import Types

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
        kinds = {name: _kind_of(said, fields, plane) for name, said in link.fields.items()}
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


def _kind_of(said: str | float | bool, fields: TypeFields, plane: Plane | None) -> Any:
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
