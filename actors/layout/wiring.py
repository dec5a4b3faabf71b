"""Who talks with whom, computed from what the actor classes declare.

Two nodes are partners if one publishes a key that the other hears, or one watches the
other. A node dials its partners only, so a respawn costs a handful of connections, not one per
process of the system.
"""

from __future__ import annotations

import difflib
import importlib
import traceback
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import msgspec

import rampart
from rampart.actors.bus.fields import Field
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import topics
from rampart.actors.runtime.actor import BASE_INPUTS, BASE_OUTPUTS, Actor
from rampart.actors.runtime.parameters import messages_said, read_parameters, topics_named
from rampart.files import working_folder
from rampart.manager.spec.checks import modules
from rampart.manager.spec.schema import Kind, NodeSpec, SystemSpec

T = TypeVar("T")

Names = Mapping[str, tuple[str, ...] | None]
"""Key of a topic → names of the members of a family; None for all, or for no family."""

REPORTS_ON: Mapping[Kind, Topic[Any]] = {
    Kind.DETECTION: topics.DETECTION, Kind.RECOVERY: topics.RECOVERY}
"""What modules of the tables `[[detection]]` and `[[recovery]]` publish."""

_ROOMS_OF_0_6 = ("actors", "manager", "sim")


@dataclass(frozen=True, slots=True)
class Member:
    """One actor of the system: its name, class and parameters.

    `hears` and `publishes` are the topics that its parameters name, as `heard` and `published` have
    them.
    """

    name: str
    actor: type[Actor]
    parameters: Actor.Parameters
    hears: Names = field(default_factory=dict)
    publishes: Names = field(default_factory=dict)


def published(member: Member) -> dict[str, tuple[str, ...] | None]:
    """Return topic key → names of the family members published (None: any, or not a family)."""
    return _together({
        t.key: member.actor.output_names(t, member.name, member.parameters) if t.is_family else None
        for t in (*member.actor.outputs, *BASE_OUTPUTS)
    }, member.publishes)


def heard(member: Member) -> dict[str, tuple[str, ...] | None]:
    """Return topic key → names of the family members heard (None: all, or not a family)."""
    return _together({
        t.key: member.actor.names(t, member.name, member.parameters) if t.is_family else None
        for t in member.actor.inputs()
        if t not in BASE_INPUTS  # tools dial for themselves; hellos use the links there are
    }, member.hears)


def _together(declared: dict[str, tuple[str, ...] | None], chosen: Names
              ) -> dict[str, tuple[str, ...] | None]:
    for key, names in chosen.items():
        there = declared.get(key, ())
        declared[key] = None if there is None or names is None else (*there, *names)
    return declared


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
        ways: dict[str, dict[str, tuple[str, ...] | None]] = {"heard": {}, "published": {}}
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
    topic = next((t for t in known.values() if t.member(key) is not None), None)
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


def partners(members: Iterable[Member]) -> dict[str, tuple[str, ...]]:
    """Return for each node the nodes it shares a key or a watch with, in the given order."""
    everyone = list(members)
    out = {m.name: published(m) for m in everyone}
    into = {m.name: heard(m) for m in everyone}
    watched = {m.name: m.actor.watches(m.name, m.parameters) for m in everyone}

    def feeds(a: str, b: str) -> bool:
        return any(
            key in into[b] and (names is None or (wanted := into[b][key]) is None
                                or bool(set(names) & set(wanted)))
            for key, names in out[a].items()
        )

    return {
        a.name: tuple(
            b.name for b in everyone
            if b.name != a.name and (
                feeds(a.name, b.name) or feeds(b.name, a.name)
                or b.name in watched[a.name] or a.name in watched[b.name])
        )
        for a in everyone
    }


def topics_of(actor: type[Actor]) -> tuple[tuple[Topic[Any], ...], tuple[Topic[Any], ...]]:
    """Return (inputs, outputs) of an actor class without what every actor has."""
    return (
        tuple(t for t in actor.inputs() if t not in BASE_INPUTS),
        tuple(actor.outputs),
    )


def load_member(node: NodeSpec, spec: SystemSpec, file: str,
                derived: Mapping[str, Any] = MappingProxyType({})) -> Member:
    """Load the class of an actor, and read its parameters as that declares them.

    Args:
        node: what the spec says of it.
        spec: the system; to a module that respawns it says which nodes.
        file: name of the spec, for messages.
        derived: parameters that it is given besides, if it takes them.

    Raises:
        ValueError: there is no such class, or it does not take a parameter; the message is one
            line and names file, path and value.
    """
    path = next(path for path, name, *_ in modules(spec) if name == node.name)
    own = tuple(n.name for n in spec.nodes if n.respawn == node.name)
    derived = {"nodes": own} if own else derived
    try:
        actor = load_class(node.actor, REPORTS_ON.get(node.kind))
        takes = {field.name for field in msgspec.structs.fields(actor.Parameters)}
    except ValueError as error:
        raise ValueError(f"{file}: {path}.{error}") from None
    except (TypeError, NameError) as error:
        raise ValueError(f"{file}: {path}.actor = {node.actor!r}: Parameters: {error}") from None
    given = {name: derived[name] for name in takes & derived.keys()} | node.parameters
    return Member(node.name, actor, read_parameters(
        actor.Parameters, given, file, f"{path}.parameters", spec))


def load_class(path: str, reports_on: Topic[Any] | None = None) -> type[Actor]:
    """Return the actor class named `module:Class`.

    Args:
        path: name of the class.
        reports_on: topic that it has to publish, by which a kind of module is known.

    Raises:
        ValueError: there is no such class, it is no actor, or one of another kind, or its module
            cannot be imported.
    """
    found = import_class(path, Actor, "actor")
    if reports_on is not None and reports_on not in found.outputs:
        raise ValueError(f"actor = {path!r}: it does not publish {reports_on.key}, as the modules "
                         "of this table do")
    return found


def import_class(path: str, base: type[T], field: str) -> type[T]:
    """Return the class named `module:Class`, which has to be derived from `base`.

    Raises:
        ValueError: there is no such class, or its module cannot be imported; `field` and `path`
            are named.
    """
    module, _, name = path.partition(":")
    try:
        imported = importlib.import_module(module)
    except ImportError as error:
        hidden = working_folder.why_not()
        hint = _moved(module, name) or (
            f"; nothing is imported from the working folder: {hidden}" if hidden else "")
        raise ValueError(f"{field} = {path!r}: {error}{hint}") from None
    except Exception as error:  # a module of the user's own may raise anything
        at = traceback.extract_tb(error.__traceback__)[-1]
        where = "" if isinstance(error, SyntaxError) else f" ({at.filename}, line {at.lineno})"
        raise ValueError(f"{field} = {path!r}: {module} cannot be imported: "
                         f"{type(error).__name__}: {error}{where}") from None
    found = getattr(imported, name, None)
    if not (isinstance(found, type) and issubclass(found, base)):
        known = [key for key, value in vars(imported).items() if isinstance(value, type)
                 and issubclass(value, base) and value.__module__ == module]
        raise ValueError(f"{field} = {path!r}: no such {base.__name__.lower()} class; known: "
                         f"{', '.join(known) or 'none'}")
    return found


def _moved(module: str, name: str) -> str:
    """Return where a class of Rampart 0.6 is now, for a message; "" if it is none."""
    if module.partition(".")[0] not in _ROOMS_OF_0_6:
        return ""
    root = Path(rampart.__file__).parent
    now = [file.relative_to(root).with_suffix("")
           for room in ("actors", "manager", "sim") for file in (root / room).rglob("*.py")
           if f"class {name}(" in file.read_text(encoding="utf-8")]
    return f"; since 0.7 it is rampart.{'.'.join(now[0].parts)}:{name}" if len(now) == 1 else ""
