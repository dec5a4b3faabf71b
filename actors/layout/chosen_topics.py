"""Topics that nodes hear and publish because their parameters say so, checked before the start."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import msgspec

from rampart.actors.bus.fields import Field
from rampart.actors.bus.topic import Members, Topic
from rampart.actors.layout.wiring import Member
from rampart.actors.runtime.actor import BASE_OUTPUTS
from rampart.actors.runtime.parameters import messages_said, topics_named


def choose_topics(members: Iterable[Member], known: Iterable[Topic[Any]], file: str
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
    everyone = list(members)
    every: dict[str, Topic[Any]] = {topic.key: topic for topic in known}
    for member in everyone:
        for topic in (*member.actor.outputs, *BASE_OUTPUTS, *member.actor.inputs()):
            every.setdefault(topic.key, topic)
    found: dict[str, Topic[Any]] = {}
    chosen: dict[str, Member] = {}
    for member in everyone:
        ways: dict[str, dict[str, Members]] = {"heard": {}, "published": {}}
        for way, named in topics_named(member.parameters).items():
            for parameter, key, path in named:
                where = f"{file}: {member.name}: parameters.{parameter}"
                found[key] = topic = _topic(key, every, where)
                if way == "heard" and topic in member.actor.inputs():
                    raise ValueError(f"{where}: {member.actor.__name__} hears {key!r} anyway")
                if path:
                    _check_field(topic, path, where)
                name = topic.member(key)
                there = ways[way].get(topic.key, ())
                ways[way][topic.key] = (*(there or ()), name) if name else None
        _check_messages(member, found, file)
        chosen[member.name] = replace(member, hears=ways["heard"], publishes=ways["published"])
    return chosen, found


def _topic(key: str, known: Mapping[str, Topic[Any]], where: str) -> Topic[Any]:
    topic = known.get(key) or next(
        (t for t in known.values() if t.member(key) is not None), None)
    if topic is None:
        near = difflib.get_close_matches(key, known, 3)
        hint = f"; the nearest: {', '.join(near)}" if near else ""
        raise ValueError(f"{where}: no actor has a topic {key!r}{hint}")
    return topic


def _check_messages(member: Member, chosen: Mapping[str, Topic[Any]], file: str) -> None:
    for name, said in messages_said(member.parameters).items():
        topic = chosen[said.topic]
        try:
            msgspec.convert(said.fields, topic.type)
        except ValueError as error:
            raise ValueError(f"{file}: {member.name}: parameters.{name}: topic {topic.key}: "
                             f"{error}") from None


def _check_field(topic: Topic[Any], path: str, where: str) -> None:
    try:
        Field(topic.type, path)
    except ValueError as error:
        raise ValueError(f"{where}: topic {topic.key}: {error}") from None
