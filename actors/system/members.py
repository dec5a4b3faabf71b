"""The actors of a system: their classes, loaded by name, and the topics of each."""

from __future__ import annotations

import importlib
import traceback
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, TypeVar

import msgspec

import rampart
from rampart.actors.bus.topic import Members, Topic
from rampart.actors.foreign.command_node import CommandNode
from rampart.actors.ftm import topics
from rampart.actors.runtime.actor import BASE_INPUTS, BASE_OUTPUTS, Actor
from rampart.actors.runtime.application import Application
from rampart.actors.runtime.declaration import Handlers
from rampart.actors.runtime.parameters import read_parameters
from rampart.actors.runtime.run_plan import RunPlan
from rampart.files import working_folder
from rampart.manager.spec.schema import Kind, NodeSpec, SystemSpec

T = TypeVar("T")

REPORTS_ON: Mapping[Kind, Topic[Any]] = {
    Kind.DETECTION: topics.DETECTION, Kind.RECOVERY: topics.RECOVERY,
    Kind.MANAGER: topics.MANAGER_STATUS}
"""The topic that every actor of a kind publishes, and no other actor."""

_PLACE = {Kind.DETECTION: "it belongs in [[detection]]",
          Kind.RECOVERY: "it belongs in [[recovery]]",
          Kind.MANAGER: "expected kind = 'manager'"}

Spare = Literal["none", "pool"]


@dataclass(frozen=True, slots=True)
class Member:
    """One actor of the system.

    Attributes:
        table: Place of its parameters in its table, for messages.
        hears: Subscribed topics that its parameters name, in the form of `heard`.
        publishes: Published topics that its parameters name, in the form of `published`.
    """

    name: str
    actor: type[Actor]
    parameters: Actor.Parameters
    table: str = "parameters."
    kind: Kind = Kind.SUPERVISION
    spare: Spare = "none"
    hears: Mapping[str, Members] = field(default_factory=dict)
    publishes: Mapping[str, Members] = field(default_factory=dict)

    @property
    def where(self) -> str:
        """Table and name, for messages."""
        return where(self.kind, self.name)


def where(kind: Kind, name: str) -> str:
    """Return table and name of an actor, for messages."""
    return f"{kind.value if kind in {Kind.DETECTION, Kind.RECOVERY} else 'node'} {name}"


def published(member: Member) -> dict[str, Members]:
    """Return the published family members by topic key (None: any, or not a family)."""
    actor = member.actor
    return _together({
        t.key: actor.output_names(t, member.name, member.parameters) if t.is_family else None
        for t in (*actor.outputs, *BASE_OUTPUTS)}, member.publishes)


def heard(member: Member) -> dict[str, Members]:
    """Return the subscribed family members by topic key (None: all, or not a family).

    Topics of every actor are left out.
    """
    actor = member.actor
    return _together({
        t.key: actor.names(t, member.name, member.parameters) if t.is_family else None
        for t in actor.inputs() if t not in BASE_INPUTS}, member.hears)


def _together(declared: dict[str, Members], chosen: Mapping[str, Members]) -> dict[str, Members]:
    for key, names in chosen.items():
        there = declared.get(key, ())
        declared[key] = None if there is None or names is None else (*there, *names)
    return declared


def topics_of(actor: type[Actor]) -> tuple[Topic[Any], ...]:
    """Return the topics of an actor class without the inputs of every actor."""
    return *(t for t in actor.inputs() if t not in BASE_INPUTS), *actor.outputs


def load_member(node: NodeSpec, spec: SystemSpec, file: str,
                derived: Mapping[str, Any] = MappingProxyType({})) -> Member:
    """Load the class of an actor and read its parameters.

    Args:
        node: Its row of the specification.
        spec: The system; it names the nodes that a recovery module restarts.
        file: Name of the specification, for messages.
        derived: Further parameters, used if the class declares them.

    Raises:
        ValueError: The class does not exist or does not take a parameter. The message is one line
            and names file, path and value.
    """
    path = where(node.kind, node.name)
    own = tuple(n.name for n in spec.nodes if n.respawn == node.name)
    derived = {"nodes": own} if own else derived
    try:
        if node.command and node.stand_in:  # checked in real runs, too
            load_class(node.stand_in, field="stand_in")
        actor = CommandNode if node.command else load_class(node.actor, node.kind)
        if actor is CommandNode and not node.command:
            raise ValueError(f"actor = {node.actor!r}: expected command = ['./program', ...]")
        takes = {field.name for field in msgspec.structs.fields(actor.Parameters)}
    except ValueError as error:
        raise ValueError(f"{file}: {path}: {error}") from None
    except (TypeError, NameError) as error:
        raise ValueError(f"{file}: {path}: actor = {node.actor!r}: Parameters: {error}") from None
    if node.command:
        if node.stand_in:
            load_member(node.in_virtual_time(), spec, file, derived)
        return Member(node.name, actor, read_parameters(
            actor.Parameters, node.command_parameters, file, path, spec), "", node.kind)
    given = {name: derived[name] for name in takes & derived.keys()}
    given |= {**node.parameters, **actor.given(node.name, spec, file)}
    return Member(node.name, actor, read_parameters(
        actor.Parameters, given, file, f"{path}: parameters", spec), kind=node.kind,
        spare="none" if node.spare == "none" or (
            node.kind is Kind.WORLD and not node.spare) else "pool")


def load_class(path: str, kind: Kind | None = None, field: str = "actor") -> type[Actor]:
    """Return the actor class named `module:Class`.

    Args:
        path: Name of the class.
        kind: Required kind, recognised by its outputs; None for any.
        field: Field of the specification, for messages.

    Raises:
        ValueError: The class does not exist, is not an actor of this kind, or its module cannot be
            imported.
    """
    found = import_class(path, Actor, field)
    own = None if kind is None else REPORTS_ON.get(kind)
    if own is not None and own not in found.outputs:
        who = "the manager does" if kind is Kind.MANAGER else "the modules of this table do"
        raise ValueError(f"{field} = {path!r}: it does not publish {own.key}, as {who}")
    for of, topic in REPORTS_ON.items() if kind is not None else ():
        if of is not kind and topic in found.outputs:
            raise ValueError(f"{field} = {path!r}: it publishes {topic.key}, so {_PLACE[of]}")
    if kind is not None and found.node_kind not in {"", kind.value}:
        raise ValueError(f"{field} = {path!r}: not a {kind.value} node, expected kind = "
                         f"{found.node_kind!r}")
    return found


def import_class(path: str, base: type[T], field: str, what: str = "") -> type[T]:
    """Return the class named `module:Class`, derived from `base`; `what` names it in messages.

    Raises:
        ValueError: The class does not exist, or its module cannot be imported. The message names
            `field` and `path`.
    """
    module, _, name = path.partition(":")
    try:
        imported = importlib.import_module(module)
    except ImportError as error:
        hidden = "; ".join(dict.fromkeys(working_folder.refused.values()))
        hint = f"; nothing is imported from there: {hidden}" if hidden else ""
        raise ValueError(f"{field} = {path!r}: {error}{hint}") from None
    except Exception as error:  # a user's module may raise anything
        frames = traceback.extract_tb(error.__traceback__)
        at = next((frame for frame in reversed(frames) if not frame.filename.startswith(
            (str(Path(rampart.__file__).parent), "<frozen"))), frames[-1])
        where = "" if isinstance(error, SyntaxError) else f" ({at.filename}, line {at.lineno})"
        raise ValueError(f"{field} = {path!r}: {module} cannot be imported: "
                         f"{type(error).__name__}: {error}{where}") from None
    found = getattr(imported, name, None)
    if not (isinstance(found, type) and issubclass(found, base)):
        known = [key for key, value in vars(imported).items() if isinstance(value, type)
                 and issubclass(value, base) and value.__module__ == module]
        raise ValueError(f"{field} = {path!r}: no such {what or base.__name__.lower()} class; "
                         f"known: {', '.join(known) or 'none'}")
    return found


def application_class(spec: SystemSpec) -> type[Application]:
    """Return the class named under `[application]`; `Application` if there is none.

    Raises:
        ValueError: The class does not exist.
    """
    path = spec.application.get("class")
    if path is None:
        return Application
    return import_class(str(path), Application, "$.application.class")


def load_application(plan: RunPlan, spec: SystemSpec) -> Application:
    """Return the application of a run: the options of the spec, replaced by those of the plan.

    Raises:
        ValueError: An option is unknown or invalid; the message names file, field and value.
    """
    kind = application_class(spec)
    given = {name: value for name, value in spec.application.items() if name != "class"}
    try:
        options = msgspec.convert({**given, **plan.options}, kind.Options)
    except msgspec.ValidationError as error:
        raise ValueError(f"{plan.system_file}: $.application: {error}") from None
    return kind(options)


def judge_class(spec: SystemSpec) -> type[Handlers] | None:
    """Return the class named under `[judge]`; None if there is none.

    Raises:
        ValueError: The class does not exist.
    """
    path = spec.judge.get("class")
    if spec.judge and path is None:
        raise ValueError("$.judge.class: missing; expected a class derived from rampart.Judge")
    if not spec.judge:
        return None
    found = import_class(str(path), Handlers, "$.judge.class", "judge")
    if not callable(getattr(found, "verdict", None)):
        raise ValueError(f"$.judge.class = {path!r}: expected a class derived from rampart.Judge")
    return found


def judged_topics(spec: SystemSpec, observer: type[Handlers]) -> list[Topic[Any]]:
    """Return the judge's topics that the observer does not subscribe to by itself.

    Raises:
        ValueError: The judge does not exist.
    """
    judge = judge_class(spec)
    return [] if judge is None else [t for t in judge.inputs() if t not in observer.inputs()]
