"""The topics of a system: contracts, publishers, readers."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from rampart.actors.bus.bounds import MAX_PAYLOAD_BYTES
from rampart.actors.bus.run_info import NoRunError, find_run
from rampart.actors.bus.topic import ROOT, Qos, Topic
from rampart.actors.ftm import topics
from rampart.actors.runtime.actor import BASE_INPUTS, BASE_OUTPUTS
from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.system.layout import Layout
from rampart.actors.system.members import heard, published
from rampart.actors.system.topics import declared_topics, find_topic, system_topics
from rampart.cli import systems
from rampart.cli.output import UsageError, rendered, unknown
from rampart.manager.spec.specification import SystemSpec

MAILBOX = {
    Qos.SENSOR: "latest wins",
    Qos.STATE: "latest wins",
    Qos.COMMAND: "queued, bounded",
}
"""How messages wait at their reader (see `rampart.actors.runtime.mailbox`)."""


class TopicUse(NamedTuple):
    """A topic with its publishers and readers."""

    topic: Topic[Any]
    publishers: tuple[str, ...]
    readers: tuple[str, ...]


def uses(spec: SystemSpec) -> list[TopicUse]:
    """Return all topics with their publishers and readers in a system.

    Raises:
        UsageError: an actor class does not exist, or declares an invalid topic.
    """
    members = Layout(RunPlan(system_file=spec.name), spec).members.values()
    inputs = {member.name: heard(member) for member in members}
    outputs = {member.name: published(member) for member in members}
    return [TopicUse(topic, _who(topic, BASE_OUTPUTS, outputs) or ("tools",),
                     _who(topic, BASE_INPUTS, inputs)) for topic in system_topics(spec)]


def resolve(key: str, known: Sequence[Topic[Any]]) -> tuple[Topic[Any], str]:
    """Return topic and full key expression of a key that a user has typed.

    A member of a family is `detection/DM1`; all are `detection/{name}` or `detection/*`. The
    leading `rampart/` may be left out.

    Args:
        key: the key.
        known: all topics of the system.

    Raises:
        UsageError: no topic has this key.
    """
    found = _match(key, known)
    if found is None:
        raise unknown("topic", key, (topic.key for topic in known))
    return found


def topics_for(key: str, port: int | None) -> tuple[Topic[Any], ...]:
    """Return the topics of the run's system, among which a key is looked for.

    The actors of a system are loaded only for a key that neither the engine nor its application
    declares. Without a run these are the topics of the shipped system, if it has the key. If the
    system of the run cannot be read here, they are the topics of the engine.

    Args:
        key: the key that the user has typed.
        port: base port of the run, if there are several.

    Raises:
        UsageError: there is no run, and the shipped system lacks the topic; or the system of the
            run, or one of its actors, cannot be loaded here, and the engine lacks the topic.
    """
    try:
        file = find_run(port).system_file
    except NoRunError as error:
        shipped = declared_topics(systems.load(None))
        if _match(key, shipped) is None:
            raise UsageError(str(error)) from None
        return shipped
    try:
        spec = systems.load(file)
        known = declared_topics(spec)
        return known if _match(key, known) is not None else system_topics(spec)
    except ValueError as error:
        if _match(key, topics.ALL) is None:
            raise UsageError(str(error)) from None
        return topics.ALL


def _match(key: str, known: Sequence[Topic[Any]]) -> tuple[Topic[Any], str] | None:
    short = key.removeprefix("/").removeprefix(f"{ROOT}/")
    topic = find_topic(short, known)
    if topic is not None:
        return topic, f"{ROOT}/{short}"
    return next(((topic, topic.pattern) for topic in known if topic.is_family
                 and short in (topic.key, topic.key.replace("{name}", "*"))), None)


def check_member(key: str, nodes: Collection[str]) -> None:
    """Check that the node in a key of the engine exists; members of other families may be others.

    Raises:
        UsageError: the node is unknown.
    """
    topic = find_topic(key, topics.ALL)
    if topic is not None and (member := topic.member(key)) and member not in nodes:
        raise unknown("node", member, nodes)


def fields(kind: type[msgspec.Struct]) -> list[tuple[str, str]]:
    """Return name and type of each field of a message, as text."""
    return [(f.name, _type_name(f.type)) for f in msgspec.structs.fields(kind)]


def markdown(spec: SystemSpec) -> str:
    """Return `topics.md`, the reference page of the topics."""
    table = uses(spec)
    return rendered(
        Path(__file__).with_name("topics.md.jinja"), spec=spec, table=table, root=ROOT,
        most_bytes=MAX_PAYLOAD_BYTES, mailbox=MAILBOX, rate=rate, summary=summary, fields=fields,
        kinds=_messages(use.topic for use in table)).rstrip() + "\n"


def _who(topic: Topic[Any], of_all: Collection[Topic[Any]],
         of_each: Mapping[str, Collection[str]]) -> tuple[str, ...]:
    if topic in of_all:
        return ("every node",)
    return tuple(name for name, those in of_each.items() if topic.key in those)


def rate(topic: Topic[Any]) -> str:
    """Return the nominal rate of a topic in words."""
    sent = f", sent every {topic.resend_s:g} s" if topic.resend_s else ""
    return f"{topic.rate_hz:g} Hz{sent}" if topic.rate_hz else "on event"


def _messages(used: Iterable[Topic[Any]]) -> list[type[msgspec.Struct]]:
    """Return the message types of topics and those nested in them, each once."""
    found: dict[type[msgspec.Struct], None] = {}

    def visit(kind: Any) -> None:
        if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
            if kind not in found:
                found[kind] = None
                for f in msgspec.structs.fields(kind):
                    visit(f.type)
            return
        for part in getattr(kind, "__args__", ()):
            visit(part)

    for topic in used:
        visit(topic.type)
    return list(found)


def _limits(meta: msgspec.Meta) -> str:
    """Return the bounds of a field: least and greatest value, or greatest length."""
    if meta.max_length is not None:
        return f"{{<={meta.max_length}}}"
    least, most = ("" if bound is None else str(bound) if isinstance(bound, int) else f"{bound:g}"
                   for bound in (meta.ge, meta.le))
    return f"{{{least}..{most}}}"


def summary(kind: type[msgspec.Struct]) -> str:
    """Return the description of a message in one line."""
    return " ".join((kind.__doc__ or "").split())


def _type_name(kind: Any) -> str:
    if hasattr(kind, "__metadata__"):
        return _type_name(kind.__origin__) + "".join(map(_limits, kind.__metadata__))
    arguments = getattr(kind, "__args__", ())
    if not arguments:
        if isinstance(kind, type) and issubclass(kind, Enum):
            return " | ".join(f'"{member.value}"' for member in kind)
        return str(getattr(kind, "__name__", kind))
    inner = ", ".join("..." if a is Ellipsis else _type_name(a) for a in arguments)
    return f"{getattr(kind, '__origin__', kind).__name__}[{inner}]"
