"""All topics of a system: the common ones, and what its actors declare besides."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from rampart.actors import TAKES
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import topics
from rampart.actors.runtime.run_plan import OBSERVER, RunPlan
from rampart.actors.system.checks import flaw
from rampart.actors.system.layout import Layout, application_class
from rampart.actors.system.members import heard, load_class, load_member, published, topics_of
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


def published_keys(spec: SystemSpec, layout: Layout | None = None) -> tuple[str, ...]:
    """Return the keys that the nodes of a system and its supervisor publish, families spelt out.

    Those of the last system are remembered: a page asks for them when it starts, and starts again.

    Args:
        spec: the system.
        layout: of it, if there is one; it takes 60 ms to make another.

    Raises:
        ValueError: the spec names an actor class that does not exist.
    """
    global _last  # noqa: PLW0603 one entry, by identity: a spec is no key of a dictionary
    if _last[0] is not spec:
        _last = spec, _published_keys(layout or Layout(RunPlan(system_file=spec.name), spec))
    return _last[1]


_last: tuple[SystemSpec | None, tuple[str, ...]] = None, ()


def _published_keys(layout: Layout) -> tuple[str, ...]:
    members = [m for m in layout.members.values() if m.name != OBSERVER]
    wanted: dict[str, dict[str, None]] = {}
    for member in members:
        for key, names in heard(member).items():
            wanted.setdefault(key, {}).update(dict.fromkeys(names or ()))
    found: dict[str, None] = {}
    for member in members:
        for key, names in published(member).items():
            # A node that may publish any member of a family publishes those that somebody hears.
            chosen = wanted.get(key, {}) if names is None else names
            spelt = [key.replace("{name}", n) for n in chosen] if "{name}" in key else [key]
            found.update(dict.fromkeys(spelt))
    return tuple(sorted(found))


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

