"""The rights of each identity on the bus, computed from the declarations of the actor classes.

A right is a full key expression, such as `rampart/detection/DM4` or `rampart/heartbeat/*`. All else
is refused, for example deleting, keys outside the topics, and `**`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any, Final

from rampart.actors.bus.topic import ROOT, Members, Qos, Topic
from rampart.actors.bus.topics import INJECT
from rampart.actors.runtime.actor import BASE_INPUTS, BASE_OUTPUTS
from rampart.actors.runtime.run_plan import OBSERVER
from rampart.actors.system.layout import Layout, router
from rampart.actors.system.members import Member, heard, published
from rampart.actors.system.topics import declared_topics

OPERATOR: Final = "operator"
VIEWER: Final = "viewer"
"""Two kinds of people's certificates: operators use all tools, viewers only look."""

EVERYTHING = f"{ROOT}/**"


@dataclass(frozen=True, slots=True)
class Rights:
    """The rights of one identity, as key expressions.

    Attributes:
        publishes: Keys it may publish.
        subscribes: Keys it may subscribe to.
        answers: Published keys whose latest message it may return to a query.
        queries: Subscribed keys whose latest message it may query.
    """

    publishes: frozenset[str] = frozenset()
    subscribes: frozenset[str] = frozenset()
    answers: frozenset[str] = frozenset()
    queries: frozenset[str] = frozenset()

    def __or__(self, other: Rights) -> Rights:
        """Return the union."""
        return Rights(*(getattr(self, one.name) | getattr(other, one.name)
                        for one in fields(self)))


def together(several: Iterable[Rights]) -> Rights:
    """Return the union of several rights."""
    found = Rights()
    for one in several:
        found |= one
    return found


def rights_of_all(layout: Layout) -> dict[str, Rights]:
    """Return the rights of all processes of a system by name, and of people by kind."""
    hosts = layout.hosts
    members = {**{name: router(name) for host in hosts.supervisors
                  for name in hosts.routers_of(host)}, **layout.members}
    topics = _topics(layout)
    found = {name: _rights_of(member, topics) for name, member in members.items()}
    viewer = Rights(subscribes=frozenset({EVERYTHING}), queries=frozenset({EVERYTHING}))
    operating = Rights(publishes=frozenset(_operated(layout, topics)))
    if OBSERVER in found:  # in the launcher, which injects the faults of `--fault`
        found[OBSERVER] |= operating
        if hosts.several:  # its recorder subscribes to what other hosts publish
            found[OBSERVER] |= Rights(subscribes=viewer.subscribes)
    return {**found, OPERATOR: viewer | operating, VIEWER: viewer}


def _rights_of(member: Member, topics: Mapping[str, Topic[Any]]) -> Rights:
    own = frozenset(f"{ROOT}/{key}" for key in member.actor.own_keys(member.parameters))
    outputs, inputs = published(member), heard(member) | {t.key: None for t in BASE_INPUTS}
    return Rights(
        publishes=own | frozenset(_spelt(outputs)), subscribes=own | frozenset(_spelt(inputs)),
        answers=frozenset(_spelt(_kept(outputs, topics))),
        queries=frozenset(_spelt(_kept(inputs, topics))))


def _spelt(keys: Mapping[str, Members]) -> Iterator[str]:
    """Yield the key expressions of topics: one per named member of a family, or one for all."""
    for key, names in keys.items():
        if "{name}" in key:
            for name in ("*",) if names is None else names:
                yield f"{ROOT}/{key.replace('{name}', name)}"
        else:
            yield f"{ROOT}/{key}"


def _kept(keys: Mapping[str, Members], topics: Mapping[str, Topic[Any]]) -> dict[str, Members]:
    """Return the topics whose latest message can be queried: all but commands."""
    return {key: names for key, names in keys.items() if topics[key].qos is not Qos.COMMAND}


def _operated(layout: Layout, topics: Mapping[str, Topic[Any]]) -> Iterator[str]:
    """Yield the keys that operators publish: those of their page, and commands from outside."""
    own = {topic.key for topic in BASE_OUTPUTS}
    pages = [member for member in layout.members.values() if member.actor.is_page]
    by_page = {key: names for page in pages for key, names in published(page).items()
               if key not in own}
    outside = {topic.key: None for topic in topics.values()
               if topic.outside and topic.qos is Qos.COMMAND}
    yield from _spelt({INJECT.key: None} | outside | by_page)


def _topics(layout: Layout) -> dict[str, Topic[Any]]:
    members = layout.members.values()
    declared = (t for m in members for t in (*m.actor.outputs, *m.actor.inputs()))
    return {topic.key: topic for topic in (
        *declared, *layout.topics.values(), *declared_topics(layout.spec))}
