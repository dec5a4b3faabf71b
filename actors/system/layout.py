"""The layout of a run, derived from its plan and system: processes, actors and connections.

The checks of all actors together are here: every subscribed topic is published, every topic has the
publishers it may have, and every name exists.

A node that subscribes to a mistyped key, or expects messages of another type, would only be silent.
So the check refuses it before a run, in one line.
"""

from __future__ import annotations

import contextlib
import difflib
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import msgspec

from rampart.actors import ROLES, TAKES
from rampart.actors.bus.fields import Field
from rampart.actors.bus.topic import Members, Qos, Topic
from rampart.actors.foreign.program import check_programs
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.ftm.messages import AdaptedSystem
from rampart.actors.recovery.respawn import Respawn
from rampart.actors.runtime.actor import BASE_OUTPUTS, Actor
from rampart.actors.runtime.application import Application
from rampart.actors.runtime.parameters import Named, given_messages, read_parameters
from rampart.actors.runtime.run_context import RunContext
from rampart.actors.runtime.run_plan import OBSERVER, RunPlan, load_document, on_host, tailor
from rampart.actors.system.hosts import Hosts
from rampart.actors.system.members import (
    Member,
    Spare,
    application_class,
    heard,
    judge_class,
    judged_topics,
    load_application,
    load_class,
    load_member,
    published,
)
from rampart.actors.system.topics import find_topic, flaw, stand_in_topics
from rampart.manager.spec.schema import Kind, NodeSpec, SystemSpec
from rampart.manager.spec.specification import check_change, check_document
from rampart.manager.spec.tables import Layers


class Unit(msgspec.Struct, frozen=True):
    """One process to run: its name and the actors in it."""

    name: str
    nodes: tuple[NodeSpec, ...]

    @property
    def kind(self) -> str:
        """Kind of the first actor."""
        return self.nodes[0].kind.value

    @property
    def respawn(self) -> str:
        """Its restarter: a recovery module or `supervisor`."""
        return self.nodes[0].respawn


class Layout:
    """Everything derived from plan and spec: units, members, topics.

    Args:
        plan: Plan of the run.
        spec: The system, tailored to the plan.
        application: Application of the run; it adds parameters of the world.

    Raises:
        ValueError: An actor class does not exist, cannot be imported, belongs in another table, or
            does not take its parameters; a subscribed topic has no publisher, or a topic has two;
            the judge is not a judge.
    """

    def __init__(self, plan: RunPlan, spec: SystemSpec,
                 application: Application | None = None) -> None:
        self.plan = plan
        self.spec = spec
        self.units: dict[str, Unit] = {
            name: Unit(name, nodes) for name, nodes in spec.processes().items()}
        self.unit_of: dict[str, str] = {
            node.name: unit.name for unit in self.units.values() for node in unit.nodes}
        self.routers: dict[str, Unit] = {
            name: Unit(name, (NodeSpec(name, Kind.SUPERVISION, ROLES["router"]),))
            for name in plan.routers}
        self.hosts = Hosts(spec, plan.host)
        self.here = {name: unit for name, unit in self.units.items()
                     if self.hosts.home_of[unit.nodes[0].name] == plan.host}
        file = plan.system_file
        try:
            kind = application_class(spec)
            observer = load_class(kind.observer)
            judge: Any = judge_class(spec)
            judged = judged_topics(spec, observer)
        except ValueError as error:
            raise ValueError(f"{file}: {error}") from None
        world = {"seed": plan.seed, **(application or Application()).world_parameters(),
                 "dead_man": spec.layers.dead_man,
                 "dead_man_timeout_s": spec.timing.dead_man_timeout_s}
        # Without fault tolerance its actors do not run. Their outputs are not required, and their
        # inputs are checked.
        whole = msgspec.structs.replace(spec, layers=Layers()).actors()
        everyone = self._complete((
            *self._guards(observer, judged),
            *(load_member(n, spec, file, world if n.kind is Kind.WORLD else {}) for n in whole)),
            file)
        judged_by = f"$.judge: {judge.__name__}" if judge else ""
        connections = Connections(
            everyone, (*ftm_topics.ALL, *kind.topics, *stand_in_topics(spec)),
            judge.inputs() if judge else (), judged_by, file)
        self.topics = connections.named
        self.publishers = connections.publishers
        self.members = {name: member for name, member in connections.members.items()
                        if name in self.unit_of or member.kind is Kind.SUPERVISION}
        silent = [] if spec.layers.ftm else [topic.key for topic in ftm_topics.ALL]
        connections.check(self.members.values(), silent)
        check_repairs(self.members, spec, file)
        if judge is None:
            return
        if kind.trial:
            raise ValueError(f"{file}: $.judge: the application judges its runs; expected "
                             "no [judge]")
        given = {name: value for name, value in spec.judge.items() if name != "class"}
        read_parameters(judge.Parameters, given, file, "$.judge")
        for topic in judge.inputs():
            if topic not in judge.optional_inputs and topic.key not in silent:
                connections.check_published(f"{file}: {judged_by}", topic.key, None)

    def _guards(self, observer: type[Actor], judged: Collection[Topic[Any]]) -> Iterator[Member]:
        """Yield the supervisors and observers of all hosts, and the observer of the run."""
        several = self.hosts.several
        for host, name in self.hosts.supervisors.items():
            role = ("host supervisor" if host else "first supervisor") if several else "supervisor"
            others = tuple(one for one in self.hosts.supervisors if one != host)
            yield _guard(name, load_class(ROLES[role]), {
                "nodes": self.hosts.heard_by(host, self.unit_of),
                **({"host": host, "others": others} if several else {})})
        yield _guard(OBSERVER, observer, {"judged": [topic.key for topic in judged]})
        for host, name in self.hosts.supervisors.items():
            if host:
                yield _guard(on_host(OBSERVER, host), load_class(ROLES["host observer"]),
                             {"supervisor": name})

    def _complete(self, members: Iterable[Member], file: str) -> list[Member]:
        """Return the members with the parameters that depend on the whole system.

        Raises:
            ValueError: No actor takes the rows of a table.
        """
        everyone = list(members)
        for table, rows in (("panel", self.spec.panels), ("ros2", self.spec.ros2)):
            if rows and not any(table in member.actor.tables for member in everyone):
                raise ValueError(f"{file}: $.{table}: no node takes it; expected a node with "
                                 f"actor = {TAKES[table]!r}")
        nodes = {node.name for node in self.spec.nodes}
        topics = {topic.key: topic for member in everyone
                  if member.name in nodes and not member.actor.is_page
                  for topic in member.actor.outputs}
        ordered = dict.fromkeys(o.topic for fault in self.plan.faults for o in fault.orders)
        return [replace(member, parameters=member.actor.completed(
            member.parameters, topics.values(), ordered)) for member in everyone]

    def spare_of(self, names: Collection[str]) -> Spare:
        """Return whether the next process of these actors comes from the pool."""
        return "pool" if all(name in self.members and self.members[name].spare == "pool"
                             for name in names) else "none"


class Connections:
    """All topics of a system and their publishers.

    Args:
        members: All actors of the system, including those that do not run now.
        known: Topics of engine and application; their declarations take precedence.
        judged: Topics of the judge.
        judge: Name of the judge in messages.
        file: Name of the specification, for messages.

    Attributes:
        members: The actors by name, with the topics that their parameters name.
        named: These topics, by the keys in the parameters.

    Raises:
        ValueError: A topic is invalid or declared in two ways, or a parameter names an unknown
            topic or field. The message names node, key or parameter, and value.
    """

    def __init__(self, members: Collection[Member], known: Iterable[Topic[Any]],
                 judged: Iterable[Topic[Any]], judge: str, file: str) -> None:
        self._file = file
        self._topics: dict[str, tuple[Topic[Any], str]] = {}
        for topic in known:
            self._topics.setdefault(topic.key, (topic, "the application or the engine"))
        for member in members:
            for topic in (*member.actor.outputs, *BASE_OUTPUTS, *member.actor.inputs()):
                self._declare(topic, member.where)
        for topic in judged:
            self._declare(topic, judge)
        for member in members:
            with self._checking(member):
                for topic in member.actor.own_topics(member.parameters):
                    self._topics.setdefault(topic.key, (topic, member.where))
        self.named: dict[str, Topic[Any]] = {}
        self.members = {member.name: self._with_named(member) for member in members}
        self._publishers: dict[str, list[tuple[Member, Members]]] = {}
        for member in self.members.values():
            for key, names in published(member).items():
                self._publishers.setdefault(key, []).append((member, names))

    def publishers(self, key: str) -> list[str]:
        """Return the names of the nodes that publish on a key below `rampart/`."""
        return [member.name for pattern, publishers in self._publishers.items()
                if (name := self._topics[pattern][0].member(key)) is not None
                for member, names in publishers if names is None or name in names]

    def check(self, started: Collection[Member], silent: Collection[str]) -> None:
        """Check the publishers of all topics.

        Args:
            started: The actors that run.
            silent: Keys that need no publisher now.

        Raises:
            ValueError: A subscribed topic has no publisher, or a topic has two where it may have
                one. The message names nodes and key.
        """
        for member in started:
            optional = {topic.key for topic in member.actor.optional_inputs}
            for key, names in heard(member).items() if member.kind is not Kind.SUPERVISION else ():
                if key not in optional and key not in silent:
                    self.check_published(f"{self._file}: {member.where}:", key, names)
        for member in started:
            self._check_alone(member)
        for key, publishers in self._publishers.items():
            topic = self._topics[key][0]
            if topic.several or topic.qos is Qos.COMMAND or topic in BASE_OUTPUTS:
                continue
            first: dict[str, Member] = {}
            for member, names in publishers:
                for name in (names or ()) if topic.is_family else ("",):
                    other = first.setdefault(name, member)
                    if other.name != member.name:
                        raise ValueError(
                            f"{self._file}: {member.where}: publishes {key!r}, as {other.where} "
                            f"does; a topic of qos {topic.qos.value} has one publisher, because "
                            "its latest message counts (or several = True in the Topic)")

    def check_published(self, who: str, key: str, names: Members) -> None:
        """Check that a subscribed topic has a publisher.

        Args:
            who: The subscriber, for the message.
            key: Key of the topic.
            names: Members of a family; None for all.

        Raises:
            ValueError: No node publishes it.
        """
        topic, publishers = self._topics[key][0], self._publishers.get(key, [])
        if topic.outside or (publishers and not topic.is_family):
            return
        missing = () if publishers and names is None else [
            name for name in names or ("",)
            if not any(there is None or name in there for _, there in publishers)]
        if not missing:
            return
        wanted = key.replace("{name}", missing[0] or "{name}")
        spelt = [key.replace("{name}", name) for key, those in self._publishers.items()
                 for _, there in those for name in there or ("{name}",)]
        near = difflib.get_close_matches(wanted, spelt, 1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise ValueError(f"{who} hears {wanted!r}, which nothing publishes; {hint}If the node can "
                         "do without, name the topic in optional_inputs of its class")

    def _declare(self, topic: Topic[Any], who: str) -> None:
        first, other = self._topics.setdefault(topic.key, (topic, who))
        if reason := flaw(topic):
            raise ValueError(f"{self._file}: {who}: topic {topic.key!r}: {reason}")
        if first is not topic and (first.type, first.qos) != (topic.type, topic.qos):
            raise ValueError(
                f"{self._file}: {who}: topic {topic.key!r} is {_form(topic)}, and {_form(first)} "
                f"to {other}; declare it once, and import it")

    def _with_named(self, member: Member) -> Member:
        """Return a member with the topics that its parameters name."""
        ways: dict[str, dict[str, Members]] = {"heard": {}, "published": {}}
        for way, names in member.actor.named(member.parameters).items():
            for one in names:
                where = f"{self._file}: {member.name}: {one.row or member.table}{one.name}"
                self.named[one.key] = topic = self._find(one.key, where)
                if way == "heard" and topic.is_family and topic in member.actor.inputs():
                    raise ValueError(f"{where}: {member.actor.__name__} hears {one.key!r} anyway")
                _check_field(topic, one, where)
                name = topic.member(one.key)
                there = ways[way].get(topic.key, ())
                ways[way][topic.key] = (*(there or ()), name) if name else None
        with self._checking(member):
            member.actor.check_topics(member.parameters, self.named)
            for parameter, said in given_messages(member.parameters).items():
                topic = self.named[said.topic]
                try:
                    msgspec.convert(said.fields, topic.type)
                except ValueError as error:
                    raise ValueError(
                        f"parameters.{parameter}: topic {topic.key}: {error}") from None
        return replace(member, hears=ways["heard"], publishes=ways["published"])

    def _find(self, key: str, where: str) -> Topic[Any]:
        known = {key: topic for key, (topic, _) in self._topics.items()}
        topic = known.get(key) or find_topic(key, known.values())
        if topic is None:
            near = difflib.get_close_matches(key, known, 3)
            hint = f"; the nearest: {', '.join(near)}" if near else ""
            raise ValueError(f"{where}: no actor has a topic {key!r}{hint}")
        return topic

    def _check_alone(self, node: Member) -> None:
        """Check that a node is the only publisher where it must be, as an operator's joystick.

        This holds for commands, too: the order to stand still is sent once, at the release.
        """
        for alone_on, what in node.actor.alone_on(node.parameters).items():
            for key, publishers in self._publishers.items():
                topic = self._topics[key][0]
                name = topic.member(alone_on)
                for other, names in publishers if name is not None and not topic.several else ():
                    if other.name != node.name and (names is None or name in names):
                        raise ValueError(
                            f"{self._file}: {node.name}: {what}: {other.where} "
                            f"publishes {alone_on!r} as well, and may move what an operator let go "
                            "of; expected a topic of its own (or several = True in the Topic)")

    @contextlib.contextmanager
    def _checking(self, member: Member) -> Iterator[None]:
        """Add file and node to an error in its parameters."""
        try:
            yield
        except ValueError as error:
            raise ValueError(f"{self._file}: {member.name}: {error}") from None


def check_repairs(members: Mapping[str, Member], spec: SystemSpec, file: str) -> None:
    """Check that the recoveries of a mechanism restart the nodes that its detections name.

    Args:
        members: All actors of a system, by name.
        spec: The system.
        file: Name of the specification, for messages.

    Raises:
        ValueError: A mechanism has recoveries that restart nodes, and none of them restarts a node
            that one of its detections watches or suspects.
    """
    for mechanism in spec.mechanisms:
        repairs = {name: members[name].parameters for name in mechanism.recoveries
                   if name in members and issubclass(members[name].actor, Respawn)}
        restartable = {node for said in repairs.values()
                    if isinstance(said, Respawn.Parameters) for node in said.nodes}
        for name in mechanism.detections if repairs else ():
            if name not in members:
                continue
            for parameter in ("watch", "suspects"):
                for node in getattr(members[name].parameters, parameter, ()):
                    if node not in restartable:
                        by = " or ".join(repairs)
                        raise ValueError(
                            f"{file}: detection {name}: parameters.{parameter}: {by} answers to "
                            f"{mechanism.name} and does not restart {node}; expected "
                            f"respawn = {next(iter(repairs))!r} in node {node}, or {node} in the "
                            f"parameters.nodes of {by}")


def _check_field(topic: Topic[Any], named: Named, where: str) -> None:
    if named.field:
        try:
            kind = Field(topic.type, named.field).kind
        except ValueError as error:
            raise ValueError(f"{where}: topic {topic.key}: {error}") from None
        if kind not in named.kinds:
            raise ValueError(f"{where}: topic {topic.key}: {named.field} is a {kind}; expected a "
                             f"{' or a '.join(named.kinds)}")


def _form(topic: Topic[Any]) -> str:
    return f"{topic.type.__module__}:{topic.type.__name__} of qos {topic.qos.value}"


def _guard(name: str, kind: type[Actor], given: Mapping[str, Any]) -> Member:
    return Member(name, kind, msgspec.convert(given, kind.Parameters))


def router(name: str) -> Member:
    """Return a router of the bus; real runs have two."""
    return _guard(name, load_class(ROLES["router"]), {})


def adapted_system(layout: Layout, run: RunContext,
                   adapted: AdaptedSystem) -> tuple[Layout, RunContext]:
    """Return layout and context of the system as it was changed while running.

    Raises:
        ValueError: The changed system is invalid, or the running one cannot be changed into it.
            The manager prevents both, but another sender may not.
    """
    try:
        document = msgspec.json.decode(adapted.document, type=dict[str, Any])
    except RecursionError:
        raise ValueError("the changed system is nested too deep") from None
    spec = tailor(layout.plan, check_document(document, layout.plan.system_file))
    check_change(layout.spec, spec)
    return Layout(layout.plan, spec, run.application), replace(
        run, system=spec, document=document, adapted=adapted)


def load_run(plan: RunPlan, spec: SystemSpec) -> RunContext:
    """Load the common context of all actors of a run; done once, before the fork.

    Raises:
        ValueError: The application's options are invalid, or the program of a command does not
            exist. The message names file and value.
    """
    check_programs(plan, spec)
    return RunContext(plan, spec, load_document(plan), load_application(plan, spec))


def published_keys(spec: SystemSpec, layout: Layout | None = None) -> tuple[str, ...]:
    """Return the keys that the nodes of a system and its supervisor publish, families spelt out.

    The keys of the last system are cached, because each restart of a page needs them.

    Args:
        spec: The system.
        layout: Its layout if available; making one takes 60 ms.

    Raises:
        ValueError: An actor class does not exist.
    """
    global _last  # noqa: PLW0603 one entry, by identity: a spec cannot be a key of a dictionary
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
            # A node that may publish any member of a family publishes those that are received.
            chosen = wanted.get(key, {}) if names is None else names
            spelt = [key.replace("{name}", n) for n in chosen] if "{name}" in key else [key]
            found.update(dict.fromkeys(spelt))
    return tuple(sorted(found))
