"""What each identity of a system may do on the bus, computed from what the actor classes declare.

A right is a key expression in full, such as `rampart/detection/DM4` or `rampart/heartbeat/*`. What
is not named here nobody may do: that includes deleting, keys that are no topic's, and `**`.
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
"""Two kinds of people's certificates: what is done with a tool, and what is only looked at."""

EVERYTHING = f"{ROOT}/**"


@dataclass(frozen=True, slots=True)
class Rights:
    """What one identity may do, as key expressions.

    Attributes:
        says: what it may publish.
        hears: what it may subscribe to.
        answers: of what it says, what it may be asked for, the newest message of each key.
        asks: of what it hears, what it may ask for.
    """

    says: frozenset[str] = frozenset()
    hears: frozenset[str] = frozenset()
    answers: frozenset[str] = frozenset()
    asks: frozenset[str] = frozenset()

    def __or__(self, other: Rights) -> Rights:
        """Return what either may."""
        return Rights(*(getattr(self, one.name) | getattr(other, one.name)
                        for one in fields(self)))


def together(several: Iterable[Rights]) -> Rights:
    """Return what any of several may."""
    found = Rights()
    for one in several:
        found |= one
    return found


def rights_of_all(layout: Layout) -> dict[str, Rights]:
    """Return what each process of a system may, by the name in its certificate, and people by kind.

    Args:
        layout: of the system.
    """
    hosts = layout.hosts
    members = {**{name: router(name) for host in hosts.supervisors
                  for name in hosts.routers_of(host)}, **layout.members}
    topics = _topics(layout)
    found = {name: _rights_of(member, topics) for name, member in members.items()}
    viewer = Rights(hears=frozenset({EVERYTHING}), asks=frozenset({EVERYTHING}))
    operating = Rights(says=frozenset(_operated(layout, topics)))
    if OBSERVER in found:  # the launcher's, which carries out what `--fault` asks for
        found[OBSERVER] |= operating
        if hosts.several:  # its recorder hears what other hosts publish
            found[OBSERVER] |= Rights(hears=viewer.hears)
    return {**found, OPERATOR: viewer | operating, VIEWER: viewer}


def said_elsewhere(layout: Layout) -> frozenset[str]:
    """Return what processes and people of the other hosts may publish, as key expressions.

    Args:
        layout: of the system, as one host has it.
    """
    hosts, rights = layout.hosts, rights_of_all(layout)
    there = {name for host in hosts.supervisors if host != layout.plan.host
             for name in (*hosts.routers_of(host), *hosts.may_run(host, layout.members))}
    return together((*(rights[name] for name in there), rights[OPERATOR])).says


def _rights_of(member: Member, topics: Mapping[str, Topic[Any]]) -> Rights:
    own = frozenset(f"{ROOT}/{key}" for key in member.actor.own_keys(member.parameters))
    outputs, inputs = published(member), heard(member) | {t.key: None for t in BASE_INPUTS}
    return Rights(
        says=own | frozenset(_spelt(outputs)), hears=own | frozenset(_spelt(inputs)),
        answers=frozenset(_spelt(_kept(outputs, topics))),
        asks=frozenset(_spelt(_kept(inputs, topics))))


def _spelt(keys: Mapping[str, Members]) -> Iterator[str]:
    """Yield the key expressions of topics: one for each member of a family, or for all of them."""
    for key, names in keys.items():
        if "{name}" in key:
            for name in ("*",) if names is None else names:
                yield f"{ROOT}/{key.replace('{name}', name)}"
        else:
            yield f"{ROOT}/{key}"


def _kept(keys: Mapping[str, Members], topics: Mapping[str, Topic[Any]]) -> dict[str, Members]:
    """Return those whose newest message newcomers ask for: all but commands."""
    return {key: names for key, names in keys.items() if topics[key].qos is not Qos.COMMAND}


def _operated(layout: Layout, topics: Mapping[str, Topic[Any]]) -> Iterator[str]:
    """Yield what operators say: what their page does, and commands that come from outside."""
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
