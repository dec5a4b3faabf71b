"""Topics that nodes hear and publish because their parameters say so, checked before the start."""

from __future__ import annotations

import contextlib
import difflib
import math
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import islice
from typing import Any

import msgspec

from rampart.actors.bus.fields import Field, Steered
from rampart.actors.bus.topic import Members, Topic
from rampart.actors.ftm import topics
from rampart.actors.runtime.actor import BASE_OUTPUTS, Actor
from rampart.actors.runtime.parameters import Named, messages_said, topics_named
from rampart.actors.system.members import Member, panels_of, published, shows_panels
from rampart.manager.spec.panels import NUMBER, Panel
from rampart.manager.spec.schema import SystemSpec

LEAST_SIGN_HZ = 10.0
"""What is published less often is no better a sign of life than heartbeats."""

_LATEST_SIGN = 1.5
"""Periods of such a topic within which a loop that turns has had a timer to handle."""

MOST_PLOTS = 8
"""Panels of a page that declares none."""


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
    for member in everyone:
        with _of(member, file):
            for topic in member.actor.own_topics(member.parameters):
                every.setdefault(topic.key, topic)
    found: dict[str, Topic[Any]] = {}
    chosen: dict[str, Member] = {}
    for member in everyone:
        ways: dict[str, dict[str, Members]] = {"heard": {}, "published": {}}
        for way, named in topics_named(member.parameters).items():
            for one in named:
                table = "" if one.shown_by else member.table
                key, where = one.key, f"{file}: {member.name}: {one.shown_by}{table}{one.name}"
                found[key] = topic = _topic(key, every, where)
                if way == "heard" and topic.is_family and topic in member.actor.inputs():
                    raise ValueError(f"{where}: {member.actor.__name__} hears {key!r} anyway")
                if one.field:
                    _check_field(topic, one, where)
                if one.signs_of:
                    _check_sign(topic, one, everyone, where)
                name = topic.member(key)
                there = ways[way].get(topic.key, ())
                ways[way][topic.key] = (*(there or ()), name) if name else None
        with _of(member, file):
            member.actor.check_topics(member.parameters, found)
        _check_messages(member, found, file)
        _check_sticks(member, found, file)
        chosen[member.name] = replace(member, hears=ways["heard"], publishes=ways["published"])
    return chosen, found


def with_pages(members: Iterable[Member], spec: SystemSpec, orders: Collection[str], file: str
               ) -> list[Member]:
    """Return the members, pages with what they show and order.

    A page without panels gets plots of the numbers that the nodes publish.

    Args:
        members: all of a system.
        spec: the system.
        orders: keys of the topics on which the faults are ordered that a page offers.
        file: name of the spec, for messages.

    Raises:
        ValueError: the spec has panels, and no node shows them.
    """
    everyone = list(members)
    pages = [member for member in everyone if shows_panels(member.actor)]
    if spec.panels and not pages:
        raise ValueError(f"{file}: panel {spec.panels[0].title!r}: no node shows it; one of actor "
                         "rampart.actors.operator.hmi:Hmi does")
    nodes = {node.name for node in spec.nodes}
    plots = tuple(plots_of([m for m in everyone if m.name in nodes and m not in pages]))

    def page(said: Actor.Parameters) -> Actor.Parameters:
        more = {"panels": panels_of(said) or plots, "fault_orders": tuple(orders)}
        return msgspec.structs.replace(
            said, **{name: value for name, value in more.items() if hasattr(said, name)})

    return [replace(member, parameters=page(member.parameters)) if member in pages else member
            for member in everyone]


def plots_of(members: Iterable[Member]) -> Iterator[Panel]:
    """Yield a plot of each topic with numbers that comes regularly, the first `MOST_PLOTS`."""
    engine = {topic.key for topic in (*topics.ALL, *BASE_OUTPUTS)}
    own = {t.key: t for m in members for t in m.actor.outputs
           if t.key not in engine and not t.is_family and t.rate_hz > 0}
    plots = (Panel(title=f"{key} {unit}"[:60].strip(), plot=tuple(fields[:4]))
             for key, topic in own.items() for unit, fields in _numbers(topic).items())
    return islice({plot.title: plot for plot in plots}.values(), MOST_PLOTS)


def _numbers(topic: Topic[Any]) -> dict[str, list[str]]:
    """Return the numbers of a topic's messages by their unit, the last word of their names."""
    found: dict[str, list[str]] = {}
    for path in getattr(topic.type, "__struct_fields__", ()):
        if _kind(topic, path) == NUMBER:
            unit = path.rpartition("_")[2] if "_" in path else ""
            found.setdefault(unit, []).append(f"{topic.key}:{path}")
    return found


def _kind(topic: Topic[Any], path: str) -> str:
    try:
        return Field(topic.type, path).kind
    except ValueError:
        return ""  # a list, or what has fields itself


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


def _check_messages(member: Member, chosen: Mapping[str, Topic[Any]], file: str) -> None:
    for name, said in messages_said(member.parameters).items():
        topic = chosen[said.topic]
        try:
            msgspec.convert(said.fields, topic.type)
        except ValueError as error:
            raise ValueError(f"{file}: {member.name}: parameters.{name}: topic {topic.key}: "
                             f"{error}") from None


def _check_sticks(member: Member, chosen: Mapping[str, Topic[Any]], file: str) -> None:
    for panel in panels_of(member.parameters):
        if panel.stick:
            try:
                steered(panel, chosen[panel.topic])
            except ValueError as error:
                raise ValueError(f"{file}: {member.name}: panel {panel.title!r}: stick: topic "
                                 f"{panel.topic}: {error}") from None


def steered(panel: Panel, topic: Topic[Any]) -> Steered:
    """Return what makes the messages of a panel's stick.

    Raises:
        ValueError: none can be made.
    """
    names = [shown.field.partition(":")[2] for shown in panel.fields()]
    count = len(panel.stick or ())
    return Steered(topic.type, names[:count], "".join(names[count:]), panel.scale)


def _check_sign(topic: Topic[Any], named: Named, members: Iterable[Member], where: str) -> None:
    """Refuse what is no sign of life of a watched node, or too rare to be a better one."""
    if topic.rate_hz < LEAST_SIGN_HZ:
        comes = f"comes {topic.rate_hz:g} times a second" if topic.rate_hz else "comes on event"
        raise ValueError(f"{where} = {named.key!r}: {comes}, heartbeats show as much; a topic with "
                         f"a rate of {LEAST_SIGN_HZ:g} Hz or more is right")
    publishers = [m for m in members if topic.key in published(m)]
    watched = [m for m in publishers if m.name in named.signs_of]
    if not watched:
        names = ", ".join(m.name for m in publishers) or "none"
        raise ValueError(f"{where} = {named.key!r}: published by {names}, a topic of "
                         f"{' or '.join(named.signs_of)} is right")
    longest_s = _LATEST_SIGN / topic.rate_hz
    for member in watched:
        if min(member.actor.periods_s(), default=math.inf) > longest_s:
            raise ValueError(f"{where} = {named.key!r}: {member.name} has no timer of "
                             f"{1 / topic.rate_hz:g} s, so it is silent when others are; what is "
                             "published by a timer (@every) is right")


def _check_field(topic: Topic[Any], named: Named, where: str) -> None:
    try:
        kind = Field(topic.type, named.field).kind
    except ValueError as error:
        raise ValueError(f"{where}: topic {topic.key}: {error}") from None
    if kind not in named.kinds:
        raise ValueError(f"{where}: topic {topic.key}: {named.field} is a {kind}; a "
                         f"{' or a '.join(named.kinds)} is right")
