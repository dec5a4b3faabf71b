"""Topics that nodes hear and publish because their parameters say so."""

from __future__ import annotations

import contextlib
import difflib
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

from rampart.actors.bus.topic import Members, Topic
from rampart.actors.runtime.actor import BASE_OUTPUTS
from rampart.actors.system.checks import check_named, check_said
from rampart.actors.system.members import Member


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
                check_named(topic, one, members, where)
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
