"""All topics of a system: the common ones, what its actors declare, and what parameters name."""

from __future__ import annotations

import contextlib
import difflib
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

from rampart.actors import TAKES
from rampart.actors.bus.topic import Members, Topic
from rampart.actors.ftm import topics
from rampart.actors.runtime.actor import BASE_OUTPUTS
from rampart.actors.system.checks import check_named, check_said, flaw
from rampart.actors.system.members import (
    Member,
    application_class,
    load_class,
    load_member,
    topics_of,
)
from rampart.manager.spec.specification import SystemSpec

_SHIPPED = "rampart."
"""Where the actors that ship are; that their topics are declared is a test's business."""


def declared_topics(spec: SystemSpec) -> tuple[Topic[Any], ...]:
    """Return the topics of the engine and of the system's application.

    Raises:
        ValueError: the application's class does not exist.
    """
    return (*topics.ALL, *application_class(spec).topics)


def system_topics(spec: SystemSpec) -> tuple[Topic[Any], ...]:
    """Return every topic of a system once: the declared ones, then what its actors have besides.

    The latter are in the order of the spec. A key that is declared keeps its contract.

    Raises:
        ValueError: the spec names an actor class that does not exist, or one of them declares a
            topic that makes no sense.
    """
    known = declared_topics(spec)
    return _with_made((*known, *_beyond(known, _actors(spec))), spec)


def own_topics(spec: SystemSpec) -> tuple[Topic[Any], ...]:
    """Return the topics that a system has beyond the declared ones.

    Only actors that do not ship are loaded, for those that do have declared topics only: a tool
    that looks at a run need not wait for controller and simulator to be imported.

    Raises:
        ValueError: as `system_topics`, of the actors that do not ship.
    """
    known = declared_topics(spec)
    own = _beyond(known, (path for path in _actors(spec) if not path.startswith(_SHIPPED)))
    return _with_made((*known, *own), spec)[len(known):]


def find_topic(key: str, known: Iterable[Topic[Any]]) -> Topic[Any] | None:
    """Return the topic of a key below the root, one member's if it is a family, or None."""
    return next((topic for topic in known if topic.member(key) is not None), None)


def _actors(spec: SystemSpec) -> Iterator[str]:
    """Return the paths of all actor classes of a system."""
    tables = (spec.nodes, spec.detections, spec.recoveries)
    return filter(None, [*(row.actor for table in tables for row in table),
                         *(node.stand_in for node in spec.nodes)])


def _with_made(known: tuple[Topic[Any], ...], spec: SystemSpec) -> tuple[Topic[Any], ...]:
    """Return topics with those that there are because parameters say so, each key once."""
    found = {topic.key: topic for topic in known}
    for node in spec.nodes if spec.ros2 else ():
        if node.actor == TAKES["ros2"]:
            member = load_member(node, spec, spec.name)
            for topic in member.actor.own_topics(member.parameters):
                found.setdefault(topic.key, topic)
    return tuple(found.values())


def _beyond(known: Iterable[Topic[Any]], paths: Iterable[str]) -> tuple[Topic[Any], ...]:
    """Return what actors have that is not known, each key once."""
    common = {topic.key for topic in known}
    found: dict[str, Topic[Any]] = {}
    for path in dict.fromkeys(paths):
        inputs, outputs = topics_of(load_class(path))
        for topic in (*inputs, *outputs):
            if topic.key in common or topic.key in found:
                continue
            if reason := flaw(topic):
                raise ValueError(f"actor = {path!r}: topic {topic.key!r}: {reason}")
            found[topic.key] = topic
    return tuple(found.values())


def stand_in_topics(spec: SystemSpec) -> list[Topic[Any]]:
    """Return the topics that are declared by what plays commands in virtual time.

    Raises:
        ValueError: there is no such class.
    """
    classes = [load_class(node.stand_in, field="stand_in") for node in spec.nodes if node.stand_in]
    return [topic for one in classes for part in topics_of(one) for topic in part]


def choose_topics(members: Collection[Member], known: Iterable[Topic[Any]], file: str
                  ) -> tuple[dict[str, Member], dict[str, Topic[Any]]]:
    """Return the members with the topics that their parameters name, and those topics by key.

    Args:
        members: all of a system.
        known: topics besides those of their classes.
        file: name of the spec, for messages.

    Raises:
        ValueError: no actor of the system has such a topic, no actor publishes what is to be heard,
            or its messages have no such field; the message names node, parameter and value.
    """
    every: dict[str, Topic[Any]] = {topic.key: topic for topic in known}
    for member in members:
        for topic in (*member.actor.outputs, *BASE_OUTPUTS, *member.actor.inputs()):
            every.setdefault(topic.key, topic)
    for member in members:
        with _of(member, file):
            for topic in member.actor.own_topics(member.parameters):
                every.setdefault(topic.key, topic)
    found: dict[str, Topic[Any]] = {}
    chosen: dict[str, Member] = {}
    for member in members:
        ways: dict[str, dict[str, Members]] = {"heard": {}, "published": {}}
        for way, names in member.actor.named(member.parameters).items():
            for one in names:
                where = f"{file}: {member.name}: {one.row or member.table}{one.name}"
                found[one.key] = topic = _topic(one.key, every, where)
                if way == "heard" and topic.is_family and topic in member.actor.inputs():
                    raise ValueError(f"{where}: {member.actor.__name__} hears {one.key!r} anyway")
                check_named(topic, one, where)
                name = topic.member(one.key)
                there = ways[way].get(topic.key, ())
                ways[way][topic.key] = (*(there or ()), name) if name else None
        with _of(member, file):
            member.actor.check_topics(member.parameters, found)
            check_said(member.parameters, found)
        chosen[member.name] = replace(member, hears=ways["heard"], publishes=ways["published"])
    return chosen, found


@contextlib.contextmanager
def _of(member: Member, file: str) -> Iterator[None]:
    """Name the node in what is wrong with its parameters."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{file}: {member.name}: {error}") from None


def _topic(key: str, known: Mapping[str, Topic[Any]], where: str) -> Topic[Any]:
    topic = known.get(key) or next(
        (t for t in known.values() if t.member(key) is not None), None)
    if topic is None:
        near = difflib.get_close_matches(key, known, 3)
        hint = f"; the nearest: {', '.join(near)}" if near else ""
        raise ValueError(f"{where}: no actor has a topic {key!r}{hint}")
    return topic
