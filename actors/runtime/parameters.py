"""A node's parameters from the specification, converted to its class's `Parameters`.

The types below carry marks for checks that need the whole system: that a value names a node or a
topic, or with which period the messages come for which a timeout waits.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from typing import Annotated, Any, NamedTuple, TypeVar

import msgspec
from msgspec import inspect

from rampart.actors.bus.fields import ANYTHING
from rampart.manager.spec.budget import find_false_alarm
from rampart.manager.spec.reading import MisfitError, read
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.spec.tables import Name, SpecificationError

P = TypeVar("P", bound=msgspec.Struct)

NodeName = Annotated[Name, msgspec.Meta(extra={"names": "node"})]
NodeNames = Annotated[tuple[Name, ...], msgspec.Meta(min_length=1, extra={"names": "node"})]
Suspects = Annotated[tuple[Name, ...], msgspec.Meta(extra={"names": "node"})]
"""Nodes that an active detection module names, for a recovery that restarts them."""
RecoveryNames = Annotated[tuple[Name, ...], msgspec.Meta(extra={"names": "recovery module"})]

TopicHeard = Annotated[str, msgspec.Meta(min_length=1, extra={"names": "topic", "way": "heard"})]
"""Key, below `rampart/`, of a topic that the node subscribes to."""
TopicsHeard = Annotated[tuple[str, ...], msgspec.Meta(extra={"names": "topic", "way": "heard"})]
TopicPublished = Annotated[
    str, msgspec.Meta(min_length=1, extra={"names": "topic", "way": "published"})]
"""Key, below `rampart/`, of a topic that the node publishes."""
TopicsPublished = Annotated[tuple[str, ...], msgspec.Meta(
    extra={"names": "topic", "way": "published"})]
FieldName = Annotated[str, msgspec.Meta(
    pattern=r"^[^:]+:[^:]+\Z", extra={"names": "field", "way": "heard"})]
"""A field of a topic's messages, "topic:field"; see `rampart.actors.bus.fields`."""
OptionalFieldName = Annotated[str, msgspec.Meta(
    pattern=r"^([^:]+:[^:]+)?\Z", extra={"names": "field", "way": "heard"})]
FieldNames = Annotated[tuple[FieldName, ...], msgspec.Meta(min_length=1, extra={
    "names": "field", "way": "heard"})]

MessageOf = Annotated[dict[str, Any], msgspec.Meta(extra={"message_of": "topic"})]
"""Fields of a message on the topic in the parameter `topic`."""
MessagesOf = Annotated[tuple[dict[str, Any], ...], msgspec.Meta(
    min_length=1, max_length=100, extra={"message_of": "topic"})]
"""Fields of several such messages."""

ControlTimeout = Annotated[float, msgspec.Meta(gt=0, extra={"period": "control_period_s"})]
"""Timeout, s, of messages with the control period: commands, poses, scans."""
HeartbeatTimeout = Annotated[float, msgspec.Meta(gt=0, extra={"period": "heartbeat_period_s"})]
"""Timeout, s, of heartbeats."""


def read_parameters(kind: type[P], given: Mapping[str, Any] | msgspec.Struct, file: str, path: str,
                    spec: SystemSpec | None = None) -> P:
    """Convert parameters to the `Parameters` of an actor's class.

    Args:
        kind: the nested class `Parameters`.
        given: parameters from the specification, names of times replaced by the times.
        file: name of the specification, for messages.
        path: path of the parameters in it, for messages.
        spec: the system, to check names and timeouts against; None leaves them unchecked.

    Raises:
        SpecificationError: a parameter is unknown, missing, or has a wrong value.
    """
    if not isinstance(given, Mapping):
        return msgspec.convert(given, kind)
    try:
        parameters = read(dict(given), kind, path)
    except MisfitError as error:
        raise SpecificationError(file, error.finding.path, error.finding.problem,
                                 *error.finding.value) from None
    for name, problem in _misfits(kind, given, spec) if spec else ():
        raise SpecificationError(file, f"{path}.{name}", problem, given[name])
    return parameters


class Named(NamedTuple):
    """A topic that a parameter names.

    Attributes:
        name: name of the parameter, or of the entry in a row of a table.
        key: key of the topic.
        field: field of its messages, or "".
        kinds: types that the field may have.
        row: the table's row, for messages; "" for a parameter.
    """

    name: str
    key: str
    field: str
    kinds: tuple[str, ...] = ANYTHING
    row: str = ""


def topics_named(parameters: msgspec.Struct) -> dict[str, list[Named]]:
    """Return the topics that a node's parameters name, by "heard" and "published"."""
    found: dict[str, list[Named]] = {"heard": [], "published": []}
    for name, marks in _marks(type(parameters)).items():
        value = getattr(parameters, name)
        if "way" in marks and value:
            found[marks["way"]] += [named(name, text)
                                    for text in ([value] if isinstance(value, str) else value)]
    return found


def named(name: str, text: str, **more: Any) -> Named:
    """Return the topic, and the field if there is one, of "topic" or "topic:field"."""
    key, _, field = text.partition(":")
    return Named(name, key, field, **more)


class GivenMessage(NamedTuple):
    """A message that a parameter contains: the topic's key, and the fields."""

    topic: str
    fields: dict[str, Any]


def given_messages(parameters: msgspec.Struct) -> dict[str, GivenMessage]:
    """Return the messages that a node's parameters contain, by the path of the parameter."""
    found: dict[str, GivenMessage] = {}
    for name, marks in _marks(type(parameters)).items():
        value = getattr(parameters, name)
        if "message_of" in marks and value is not None:
            topic = getattr(parameters, marks["message_of"])
            each = {name: value} if isinstance(value, dict) else {
                f"{name}[{index}]": fields for index, fields in enumerate(value)}
            found |= {path: GivenMessage(topic, fields) for path, fields in each.items()}
    return found


@cache
def _marks(kind: type[msgspec.Struct]) -> dict[str, dict[str, str]]:
    """Return the marks of a struct's fields, by field."""
    infos = {f.name: inspect.type_info(f.type) for f in msgspec.structs.fields(kind)}
    return {name: info.extra for name, info in infos.items()
            if isinstance(info, inspect.Metadata) and info.extra}


def _misfits(kind: type[msgspec.Struct], given: Mapping[str, Any],
             spec: SystemSpec) -> Iterator[tuple[str, str]]:
    """Find unknown names, and timeouts that would raise false alarms."""
    for field, marks in _marks(kind).items():
        if field not in given:
            continue
        what = marks.get("names")
        if what in {"node", "recovery module"}:
            known = [row.name for row in (spec.nodes if what == "node" else spec.recoveries)]
            for name in [given[field]] if isinstance(given[field], str) else given[field]:
                if name not in known:
                    yield field, f"unknown {what} {name!r}; known: {', '.join(known) or 'none'}"
        if "period" in marks and (
                problem := find_false_alarm(spec.timing, given[field], marks["period"])):
            yield field, problem
