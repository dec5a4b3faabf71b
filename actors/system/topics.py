"""The topics of a system: those of engine and application, and those of its actors."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import Any

import msgspec
from msgspec import inspect

from rampart.actors import TAKES
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import topics
from rampart.actors.system.members import application_class, load_class, load_member, topics_of
from rampart.manager.spec.specification import SystemSpec

_SHIPPED = "rampart."
"""Actors that ship; a test checks that their topics are declared."""


def declared_topics(spec: SystemSpec) -> tuple[Topic[Any], ...]:
    """Return the topics of the engine and of the system's application.

    Raises:
        ValueError: The application's class does not exist.
    """
    return (*topics.ALL, *application_class(spec).topics)


def system_topics(spec: SystemSpec, *, shipped: bool = True) -> tuple[Topic[Any], ...]:
    """Return every topic of a system once: the declared ones, then those of its actors in order.

    A declared key keeps its declaration.

    Args:
        spec: The system.
        shipped: Whether actors that ship are loaded, too.

    Raises:
        ValueError: An actor class does not exist or declares an invalid topic.
    """
    found = {topic.key: topic for topic in declared_topics(spec)}
    paths = (*(node.actor for node in spec.nodes), *(row.actor for row in spec.detections),
             *(row.actor for row in spec.recoveries), *(node.stand_in for node in spec.nodes))
    for path in dict.fromkeys(paths):
        if not path or (path.startswith(_SHIPPED) and not shipped):
            continue
        for topic in topics_of(load_class(path)):
            if topic.key not in found and (reason := flaw(topic)):
                raise ValueError(f"actor = {path!r}: topic {topic.key!r}: {reason}")
            found.setdefault(topic.key, topic)
    for node in spec.nodes if spec.ros2 else ():
        if node.actor == TAKES["ros2"]:
            member = load_member(node, spec, spec.name)
            for topic in member.actor.own_topics(member.parameters):
                found.setdefault(topic.key, topic)
    return tuple(found.values())


def own_topics(spec: SystemSpec) -> tuple[Topic[Any], ...]:
    """Return the topics of a system beyond the declared ones.

    Actors that ship have only declared topics and are not loaded. So tools need not wait for
    controller and simulator to be imported.

    Raises:
        ValueError: As `system_topics`, for actors that do not ship.
    """
    return system_topics(spec, shipped=False)[len(declared_topics(spec)):]


def stand_in_topics(spec: SystemSpec) -> list[Topic[Any]]:
    """Return the topics of the actors that replace commands in virtual time.

    Raises:
        ValueError: A class does not exist.
    """
    return [topic for node in spec.nodes if node.stand_in
            for topic in topics_of(load_class(node.stand_in, field="stand_in"))]


def find_topic(key: str, known: Iterable[Topic[Any]]) -> Topic[Any] | None:
    """Return the topic of a key below the root, or None."""
    return next((topic for topic in known if topic.member(key) is not None), None)


def flaw(topic: Topic[Any]) -> str:
    """Return what is wrong with a topic; "" if nothing is."""
    if topic.key.count("{name}") > 1:
        return "expected at most one {name}"
    if not (isinstance(topic.type, type) and issubclass(topic.type, msgspec.Struct)):
        return f"type = {topic.type!r}: must be derived from rampart.actors.bus.messages.Message"
    return _unsendable(topic.type)


@cache
def _unsendable(message: type[msgspec.Struct]) -> str:
    """Return which field of a message has a type that cannot be sent; "" if none has."""
    try:
        waiting = [("", inspect.type_info(message))]
    except (TypeError, NameError) as error:
        return str(error)
    seen: set[type] = set()
    while waiting:
        path, info = waiting.pop()
        match info:
            case inspect.CustomType(cls=kind):
                return (f"field {path}: {kind.__module__}.{kind.__qualname__} cannot be sent; "
                        "expected plain types, e.g. tuple[float, ...]")
            case inspect.Metadata(type=inner):
                waiting.append((path, inner))
            case inspect.UnionType(types=several) | inspect.TupleType(item_types=several):
                waiting += [(path, one) for one in several]
            case inspect.DictType(key_type=key, value_type=value):
                waiting += [(path, key), (path, value)]
            case inspect.StructType(cls=kind, fields=fields) if kind not in seen:
                seen.add(kind)
                waiting += [(f"{path}.{f.name}".lstrip("."), f.type) for f in fields]
            case inspect.CollectionType(item_type=item):
                waiting.append((f"{path}[]", item))
    return ""
