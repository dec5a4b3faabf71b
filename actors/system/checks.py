"""What is checked of all actors of a system together.

Whether what they hear can come, what they publish is theirs to say, and what they name is there.

A node that waits for a topic under a mistyped key, or for messages of another type, works as well
as any: it is only silent. So it is refused before a run, in one line.
"""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable, Iterator, Mapping
from functools import cache
from typing import Any

import msgspec
from msgspec import inspect

from rampart.actors.bus.fields import Field
from rampart.actors.bus.topic import Members, Qos, Topic
from rampart.actors.recovery.respawn import Respawn
from rampart.actors.runtime.actor import BASE_OUTPUTS
from rampart.actors.runtime.parameters import Named, messages_said
from rampart.actors.system.members import Member, heard, published
from rampart.manager.spec.schema import Kind, SystemSpec

Published = Mapping[str, list[tuple[Member, Members]]]
"""Topic key → who publishes it, and which members of a family."""


class Declared:
    """All topics of a system by key, each declared in one way only.

    Args:
        known: those of engine and application, which count first.
        file: name of the spec, for messages.
    """

    def __init__(self, known: Iterable[Topic[Any]], file: str) -> None:
        self._file = file
        self._found: dict[str, tuple[Topic[Any], str]] = {}
        for topic in known:
            self._found.setdefault(topic.key, (topic, "the application or the engine"))

    def add(self, topic: Topic[Any], who: str) -> None:
        """Add a topic that somebody has.

        Raises:
            ValueError: it makes no sense, or contradicts another declaration.
        """
        first, other = self._found.setdefault(topic.key, (topic, who))
        if reason := flaw(topic):
            raise ValueError(f"{self._file}: {who}: topic {topic.key!r}: {reason}")
        if first is not topic and (first.type, first.qos) != (topic.type, topic.qos):
            raise ValueError(
                f"{self._file}: {who}: topic {topic.key!r} is {_form(topic)}, and {_form(first)} "
                f"to {other}; declare it once, and import it")

    def find(self, key: str) -> Topic[Any]:
        """Return the topic of a key that somebody hears or publishes."""
        return self._found[key][0]


def publishers_of(members: Iterable[Member]) -> Published:
    """Return who publishes what."""
    said: dict[str, list[tuple[Member, Members]]] = {}
    for member in members:
        for key, names in published(member).items():
            said.setdefault(key, []).append((member, names))
    return said


def check_connections(members: Collection[Member], said: Published, known: Iterable[Topic[Any]],
                      silent: Collection[str], file: str) -> Declared:
    """Check who hears and publishes what, and return the topics of all.

    Args:
        members: all actors of a system.
        said: who publishes what, also of those that are not started now, and could be.
        known: topics besides those of their classes; these count first.
        silent: keys that nobody has to publish now.
        file: name of the spec, for messages.

    Raises:
        ValueError: a topic makes no sense, is declared in two ways, is heard and never published,
            or has two publishers where one is meant, or of a stick; the message names nodes and
            key.
    """
    declared = Declared(known, file)
    for member in {one.name: one for those in said.values() for one, _ in those}.values():
        for topic in (*member.actor.outputs, *BASE_OUTPUTS, *member.actor.inputs()):
            declared.add(topic, member.where)
    own = [member for member in members if member.kind is not Kind.SUPERVISION]
    for member in own:
        optional = {topic.key for topic in member.actor.optional_inputs}
        for key, names in heard(member).items():
            if key not in optional and key not in silent:
                check_heard(f"{file}: {member.where}:", declared.find(key), names, said)
    for member in members:
        check_alone(member, said, declared, file)
    for key, publishers in said.items():
        topic = declared.find(key)
        if topic.several or topic.qos is Qos.COMMAND or topic in BASE_OUTPUTS:
            continue
        for one, other in _rivals(topic, publishers):
            raise ValueError(
                f"{file}: {other.where}: publishes {key!r}, as {one.where} does; of a topic of qos "
                f"{topic.qos.value} the latest message counts, so that one may (or several = True "
                "in the Topic)")
    return declared


def check_repairs(members: Mapping[str, Member], spec: SystemSpec, file: str) -> None:
    """Check that what a detection module names can be restarted by what answers to it.

    Args:
        members: all actors of a system, by name.
        spec: the system.
        file: name of the spec, for messages.

    Raises:
        ValueError: a module that restarts nodes answers to a detection module, and neither it nor
            another one that answers has a node that this watches or suspects.
    """
    for mechanism in spec.mechanisms:
        repairs = {name: members[name].parameters for name in mechanism.recoveries
                   if name in members and issubclass(members[name].actor, Respawn)}
        mendable = {node for said in repairs.values()
                    if isinstance(said, Respawn.Parameters) for node in said.nodes}
        for name in mechanism.detections if repairs else ():
            if name not in members:
                continue
            for parameter in ("watch", "suspects"):
                for node in getattr(members[name].parameters, parameter, ()):
                    if node not in mendable:
                        by = " or ".join(repairs)
                        raise ValueError(
                            f"{file}: detection {name}: parameters.{parameter}: {by} answers to "
                            f"{mechanism.name} and does not restart {node}; expected "
                            f"respawn = {next(iter(repairs))!r} in node {node}, or {node} in the "
                            f"parameters.nodes of {by}")


def check_heard(who: str, topic: Topic[Any], names: Members, said: Published) -> None:
    """Check that somebody publishes what is heard.

    Args:
        who: hears it, for the message.
        topic: what is heard.
        names: of the members of a family, None for all.
        said: what is published.

    Raises:
        ValueError: nobody does.
    """
    publishers = said.get(topic.key, [])
    if topic.outside or (publishers and not topic.is_family):
        return
    missing = () if publishers and names is None else [
        name for name in names or ("",)
        if not any(there is None or name in there for _, there in publishers)]
    if not missing:
        return
    key = topic.key.replace("{name}", missing[0] or "{name}")
    near = difflib.get_close_matches(key, _spelt(said), 1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    raise ValueError(f"{who} hears {key!r}, which nothing publishes; {hint}What a node can do "
                     "without is named in optional_inputs of its class")


def check_alone(node: Member, said: Published, declared: Declared, file: str) -> None:
    """Check that no other node publishes where one is to be alone, as an operator is with a stick.

    Also of a command: the robot is told to stand still once, when he lets go.

    Raises:
        ValueError: one does.
    """
    for alone_on, what in node.actor.alone_on(node.parameters).items():
        for key, publishers in said.items():
            topic = declared.find(key)
            name = topic.member(alone_on)
            for other, names in publishers if name is not None and not topic.several else ():
                if other.name != node.name and (names is None or name in names):
                    raise ValueError(
                        f"{file}: {node.name}: {what}: {other.where} "
                        f"publishes {alone_on!r} as well, and may move what an operator let go "
                        "of; a topic of the stick's own is right (or several = True in the Topic)")


def check_named(topic: Topic[Any], named: Named, where: str) -> None:
    """Check the field of a topic that a parameter names.

    Raises:
        ValueError: there is no such field, or it is of another kind.
    """
    if named.field:
        try:
            kind = Field(topic.type, named.field).kind
        except ValueError as error:
            raise ValueError(f"{where}: topic {topic.key}: {error}") from None
        if kind not in named.kinds:
            raise ValueError(f"{where}: topic {topic.key}: {named.field} is a {kind}; a "
                             f"{' or a '.join(named.kinds)} is right")


def check_said(parameters: msgspec.Struct, topics: Mapping[str, Topic[Any]]) -> None:
    """Check that messages which parameters hold are of their topics, which are given by key.

    Raises:
        ValueError: one is not.
    """
    for name, said in messages_said(parameters).items():
        topic = topics[said.topic]
        try:
            msgspec.convert(said.fields, topic.type)
        except ValueError as error:
            raise ValueError(f"parameters.{name}: topic {topic.key}: {error}") from None


def _spelt(said: Published) -> list[str]:
    """Return the keys that are published, members of families by their own names."""
    return [key.replace("{name}", name) for key, those in said.items() for _, names in those
            for name in names or ("{name}",)]


def _rivals(topic: Topic[Any], publishers: list[tuple[Member, Members]]
            ) -> Iterator[tuple[Member, Member]]:
    """Yield who publishes the same; of a family, those that both name the same member."""
    first: dict[str, Member] = {}
    for member, names in publishers:
        for name in (names or ()) if topic.is_family else ("",):
            if first.setdefault(name, member).name != member.name:
                yield first[name], member


def _form(topic: Topic[Any]) -> str:
    return f"{topic.type.__module__}:{topic.type.__name__} of qos {topic.qos.value}"


def flaw(topic: Topic[Any]) -> str:
    """Return what is wrong with a topic, or an empty text."""
    if topic.key.count("{name}") > 1:
        return "one {name} at most is right"
    if not (isinstance(topic.type, type) and issubclass(topic.type, msgspec.Struct)):
        return f"type = {topic.type!r}: must be derived from rampart.actors.bus.messages.Message"
    return unsendable(topic.type)


@cache
def unsendable(message: type[msgspec.Struct]) -> str:
    """Return which field of a message has a type that no message can have, "" if none has."""
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
