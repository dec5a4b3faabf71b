"""A node's parameters from the system spec, read as its actor's class declares them.

The class has a nested `class Parameters`, see `rampart.actors.runtime.actor.Actor`. What a type
alone cannot say of a value is marked on it: that it names nodes of the system, or how often that
comes for which a timeout waits.
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
"""Nodes that a detection module names while it is active, for a recovery that respawns."""
RecoveryNames = Annotated[tuple[Name, ...], msgspec.Meta(extra={"names": "recovery module"})]

TopicHeard = Annotated[str, msgspec.Meta(min_length=1, extra={"names": "topic", "way": "heard"})]
"""Key of a topic, below `rampart/`, that the node hears because its parameters say so."""
TopicsHeard = Annotated[tuple[str, ...], msgspec.Meta(extra={"names": "topic", "way": "heard"})]
TopicPublished = Annotated[
    str, msgspec.Meta(min_length=1, extra={"names": "topic", "way": "published"})]
"""Key of a topic that the node publishes because its parameters say so."""
TopicsPublished = Annotated[tuple[str, ...], msgspec.Meta(
    extra={"names": "topic", "way": "published"})]
FieldName = Annotated[str, msgspec.Meta(
    pattern=r"^[^:]+:[^:]+\Z", extra={"names": "field", "way": "heard"})]
"""A field of the messages of a topic, "topic:field", as of `rampart.actors.bus.fields`."""
OptionalFieldName = Annotated[str, msgspec.Meta(
    pattern=r"^([^:]+:[^:]+)?\Z", extra={"names": "field", "way": "heard"})]
FieldNames = Annotated[tuple[FieldName, ...], msgspec.Meta(min_length=1, extra={
    "names": "field", "way": "heard"})]

MessageOf = Annotated[dict[str, Any], msgspec.Meta(extra={"message_of": "topic"})]
"""Fields of a message on the topic that the parameter `topic` names."""
MessagesOf = Annotated[tuple[dict[str, Any], ...], msgspec.Meta(
    min_length=1, max_length=100, extra={"message_of": "topic"})]
"""The same of several."""

ControlTimeout = Annotated[float, msgspec.Meta(gt=0, extra={"period": "control_period_s"})]
"""How long, s, to wait for what comes as often as commands, poses and scans."""
HeartbeatTimeout = Annotated[float, msgspec.Meta(gt=0, extra={"period": "heartbeat_period_s"})]
"""How long, s, to wait for a heartbeat."""


def read_parameters(kind: type[P], given: Mapping[str, Any] | msgspec.Struct, file: str, path: str,
                    spec: SystemSpec | None = None) -> P:
    """Return parameters as the type that declares them; those that are of it already, as they are.

    Args:
        kind: Nested class of the actor.
        given: As the spec gives them, names of times replaced by the times.
        file: Name of the spec, for messages.
        path: Where in it they are.
        spec: The system, if what they say of it is to be checked.

    Raises:
        SpecificationError: One is unknown, missing, or has a value that makes no sense.
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
        name: of the parameter, or of what in a row of a table names it.
        key: of the topic.
        field: of its messages, or "".
        kinds: of which the field may be.
        row: which row that is, for messages; "" of a parameter.
    """

    name: str
    key: str
    field: str
    kinds: tuple[str, ...] = ANYTHING
    row: str = ""


def topics_named(parameters: msgspec.Struct) -> dict[str, list[Named]]:
    """Return which topics a node's parameters have it hear and publish, by "heard", "published"."""
    found: dict[str, list[Named]] = {"heard": [], "published": []}
    for name, marks in _marks(type(parameters)).items():
        said = getattr(parameters, name)
        if "way" in marks and said:
            found[marks["way"]] += [named(name, text)
                                    for text in ([said] if isinstance(said, str) else said)]
    return found


def named(name: str, text: str, **more: Any) -> Named:
    """Return what is named by "topic" or "topic:field"."""
    key, _, field = text.partition(":")
    return Named(name, key, field, **more)


class Said(NamedTuple):
    """A message that a parameter says: the topic's key, and the fields."""

    topic: str
    fields: dict[str, Any]


def messages_said(parameters: msgspec.Struct) -> dict[str, Said]:
    """Return the messages that a node's parameters say, by the name of the parameter."""
    found: dict[str, Said] = {}
    for name, marks in _marks(type(parameters)).items():
        said = getattr(parameters, name)
        if "message_of" in marks and said is not None:
            topic = getattr(parameters, marks["message_of"])
            each = {name: said} if isinstance(said, dict) else {
                f"{name}[{place}]": one for place, one in enumerate(said)}
            found |= {where: Said(topic, fields) for where, fields in each.items()}
    return found


@cache
def _marks(kind: type[msgspec.Struct]) -> dict[str, dict[str, str]]:
    """Return what is marked on the fields, by their names."""
    infos = {f.name: inspect.type_info(f.type) for f in msgspec.structs.fields(kind)}
    return {name: info.extra for name, info in infos.items()
            if isinstance(info, inspect.Metadata) and info.extra}


def _misfits(kind: type[msgspec.Struct], given: Mapping[str, Any],
             spec: SystemSpec) -> Iterator[tuple[str, str]]:
    """Find names that the system has not, and timeouts that it trips when all is well."""
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
