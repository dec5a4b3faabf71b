"""Everything that follows from the plan of a run and its system: processes and their actors."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import msgspec

from rampart.actors import ROLES, TAKES
from rampart.actors.bus.topic import Topic
from rampart.actors.foreign.program import check_programs
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.ftm.messages import AdaptedSystem
from rampart.actors.runtime.actor import Actor
from rampart.actors.runtime.application import Application
from rampart.actors.runtime.parameters import read_parameters
from rampart.actors.runtime.run_context import RunContext
from rampart.actors.runtime.run_plan import OBSERVER, RunPlan, load_document, on_host, tailor
from rampart.actors.system.checks import (
    check_connections,
    check_heard,
    check_repairs,
    publishers_of,
)
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
from rampart.actors.system.topics import choose_topics, stand_in_topics
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
        """Who brings it back: a recovery module or `supervisor`."""
        return self.nodes[0].respawn


class Layout:
    """Everything derived from plan and spec: units, members, topics.

    Args:
        plan: of the run.
        spec: the system, as the plan leaves it.
        application: of the run; without one, what it tells the world is missing.

    Raises:
        ValueError: an actor class named in the spec does not exist, cannot be imported, belongs
            into another table, or does not take its parameters; one hears what nobody publishes, or
            publishes what another one does; the judge is none, or hears nothing.
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
            judge = judge_class(spec)
            judged = judged_topics(spec, observer)
        except ValueError as error:
            raise ValueError(f"{file}: {error}") from None
        world = {"seed": plan.seed, **(application or Application()).world_parameters(),
                 "dead_man": spec.layers.dead_man,
                 "dead_man_timeout_s": spec.timing.dead_man_timeout_s}
        # Without fault tolerance its actors are not started: what they publish is not missed, and
        # what they hear is checked.
        whole = msgspec.structs.replace(spec, layers=Layers()).actors()
        everyone = self._complete((
            *self._guards(observer, judged),
            *(load_member(n, spec, file, world if n.kind is Kind.WORLD else {}) for n in whole)),
            file)
        started = {*self.unit_of, *(m.name for m in everyone if m.kind is Kind.SUPERVISION)}
        known = (*kind.topics, *stand_in_topics(spec))
        chosen, topics = choose_topics(everyone, (*known, *judged), file)
        self.members = {name: member for name, member in chosen.items() if name in started}
        self.topics = topics
        made = {topic.key for member in everyone
                for topic in member.actor.own_topics(member.parameters)}
        self._check(judge, chosen.values(), (*ftm_topics.ALL, *known, *(
            topic for key, topic in topics.items() if key in made)), file)

    def _guards(self, observer: type[Actor], judged: Collection[Topic[Any]]) -> Iterator[Member]:
        """Yield supervisors and observers of all hosts, the observer of the run among them."""
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
        """Return members with the parameters that they have in the whole system.

        Raises:
            ValueError: the spec has rows of a table that no actor takes.
        """
        everyone = list(members)
        for table, rows in (("panel", self.spec.panels), ("ros2", self.spec.ros2)):
            if rows and not any(table in member.actor.tables for member in everyone):
                raise ValueError(f"{file}: $.{table}: no node takes it; one of actor "
                                 f"{TAKES[table]} does")
        nodes = {node.name for node in self.spec.nodes}
        topics = {topic.key: topic for member in everyone
                  if member.name in nodes and not member.actor.is_page
                  for topic in member.actor.outputs}
        ordered = dict.fromkeys(o.topic for fault in self.plan.faults for o in fault.orders)
        return [replace(member, parameters=member.actor.completed(
            member.parameters, topics.values(), ordered)) for member in everyone]

    def spare_of(self, names: Collection[str]) -> Spare:
        """Return of what the next process of these actors is made."""
        return "pool" if all(name in self.members and self.members[name].spare == "pool"
                             for name in names) else "none"

    def _check(self, judge: Any, everyone: Iterable[Member], known: Collection[Topic[Any]],
               file: str) -> None:
        """Check who hears and publishes what; raises as the constructor."""
        silent = [] if self.spec.layers.ftm else [topic.key for topic in ftm_topics.ALL]
        said = publishers_of(everyone)
        declared = check_connections(list(self.members.values()), said, known, silent, file)
        check_repairs(self.members, self.spec, file)
        if judge is None:
            return
        if application_class(self.spec).trial:
            raise ValueError(f"{file}: $.judge: the application says by itself what a run was "
                             "worth; leave it out")
        given = {name: value for name, value in self.spec.judge.items() if name != "class"}
        read_parameters(judge.Parameters, given, file, "$.judge")
        for topic in judge.inputs():
            who = f"$.judge: {judge.__name__}"
            declared.add(topic, who)
            if topic not in judge.optional_inputs and topic.key not in silent:
                check_heard(f"{file}: {who}", topic, None, said)


def _guard(name: str, kind: type[Actor], given: Mapping[str, Any]) -> Member:
    return Member(name, kind, msgspec.convert(given, kind.Parameters))


def router(name: str) -> Member:
    """Return a router of the bus, which real runs have."""
    return _guard(name, load_class(ROLES["router"]), {})


def adapted_system(layout: Layout, run: RunContext,
                   adapted: AdaptedSystem) -> tuple[Layout, RunContext]:
    """Return layout and context of the system as it was changed while running.

    Raises:
        ValueError: the changed system is unsound, or the running one cannot be changed into it.
            The manager lets neither happen; a message may.
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
    """Load what all actors of a run have in common; done once, before the fork.

    Raises:
        ValueError: the application's options are unsound, or there is no such program as a node's
            command names; the message names file and value.
    """
    check_programs(plan, spec)
    return RunContext(plan, spec, load_document(plan), load_application(plan, spec))


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
