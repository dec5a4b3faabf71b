"""The tables of a system specification: nodes, modules, mechanisms, fault tree, orders.

One TOML file says everything that the arbiter, the launcher and the supervisor need to know;
`systems/osmosis.toml` shows every field. These classes are its shape, and what
is checked by type alone: unknown fields, wrong types, names that are no names, negative times.
`rampart.manager.spec.specification` reads a file into them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import Annotated, Any, Literal, TypeVar

import msgspec

from rampart.manager.model.fault_tree import Event, FaultTree
from rampart.manager.model.gates import detection_gate, recovery_gate
from rampart.manager.model.mechanisms import Contract, Mechanism, Mechanisms, RecoveryKind
from rampart.manager.model.order import PartialOrder, Tree, refine
from rampart.manager.spec.hosts import HostSpec, Link
from rampart.manager.spec.mobile_robot import Hazard, Robot
from rampart.manager.spec.nodes import ClassPath, Kind, NodeSpec
from rampart.manager.spec.tables import (
    DERIVED,
    End,
    Layers,
    Name,
    NonNegative,
    OptionalName,
    Positive,
    Supervision,
    Table,
    Timing,
    numbered,
)

T = TypeVar("T")
Few = Annotated[T, msgspec.Meta(max_length=16)]
Rows = Annotated[tuple[T, ...], msgspec.Meta(max_length=1000)]
"""Of a table; the shipped systems have 31 actors, and checks compare many with many."""

Relation = Annotated[dict[str, Annotated[tuple[str, ...], msgspec.Meta(
    description="a list of recovery names")]], msgspec.Meta(
    description="a table, recovery = [recoveries that it is above]")]


class DetectionSpec(Table, frozen=True):
    """A detection module.

    Attributes:
        within_s: Longest time from the error to the report; a number or the name of a `[timing]`
            value. May be left out if `parameters.timeout_s` says it; if both do, the longer one
            counts.
        parameters: For the actor, as for a node. Keys that mean something here too: `watch`, a
            list of node names; `timeout_s`; `margin_m`, the distance at which it warns.
        name: Of the module, e.g. "DM1".
        title: For people.
        actor: Its class, `module:Class`.
        process: OS process it runs in; "" for one of its own name.
        host: On which it runs; "" for the first.
        enabled: False leaves out every mechanism that listens to it.
    """

    name: Name
    title: str
    actor: ClassPath
    within_s: Positive | Name = DERIVED
    process: OptionalName = ""
    host: OptionalName = ""
    parameters: dict[str, Any] = {}
    enabled: bool = True

    @property
    def watch(self) -> tuple[str, ...]:
        """Names of the nodes that it watches."""
        return tuple(self.parameters.get("watch", ()))

    @property
    def latency_s(self) -> float:
        """Longest time from the error to the report; NaN if the spec does not say.

        Where both `within_s` and `parameters.timeout_s` say it, the longer one counts.
        """
        return max(self._times_s)

    @property
    def soonest_s(self) -> float:
        """The shorter of the two, for what has to be faster than this module."""
        return min(self._times_s)

    @property
    def _times_s(self) -> tuple[float, float]:
        within_s = float(self.within_s)
        return within_s, float(self.parameters.get("timeout_s", within_s))


class RecoverySpec(Table, frozen=True):
    """A recovery module; the contract fields are those of `mechanisms.Contract`.

    A key of `parameters` that means something here too: `nodes`, a list of names of those that it
    may respawn.
    """

    name: Name
    title: str
    actor: ClassPath
    kind: RecoveryKind
    claims: frozenset[Name] = frozenset()
    needs: frozenset[Name] = frozenset()
    disables: frozenset[Name] = frozenset()
    interruptible: bool = False
    latched: bool = False
    excused_by: frozenset[Name] = frozenset()
    deadline_s: Positive = 2.0
    escalate_to: OptionalName = ""
    process: OptionalName = ""
    host: OptionalName = ""
    parameters: dict[str, Any] = {}
    enabled: bool = True


class Within(Table, frozen=True):
    """A hazard in the user's own words, and the time that is left before it, in seconds."""

    within_s: Positive
    hazard: str


class MechanismSpec(Table, frozen=True):
    """FTMx(DMy, RMz), on an event of the fault tree, in time before a hazard.

    Attributes:
        name: Of the mechanism, e.g. "FTM1".
        detect: A detection module, or a gate over several; `rampart.manager.model.gates` has the
            language.
        recover: A recovery module, or a gate over several.
        event: Of the fault tree, on which it is a barrier.
        against: What it races.
        explains: Mechanisms whose detections are its consequences, as many are of an overload of
            the machine: while it is detected they do not act.
        enabled: False leaves it out. One with a disabled module is left out as well.
    """

    name: Name
    detect: str
    recover: str
    event: Name
    against: Annotated[Hazard | Within, msgspec.Meta(description=(
        "one of drift, runaway, intrusion, parent, or { within_s = ..., hazard = '...' }"
        ))] = Hazard.DRIFT
    explains: frozenset[Name] = frozenset()
    enabled: bool = True

    @property
    def detections(self) -> tuple[str, ...]:
        """Names of the detection modules that it listens to."""
        return detection_gate(self.detect).names

    @property
    def recoveries(self) -> tuple[str, ...]:
        """Names of the recovery modules that it may run."""
        return recovery_gate(self.recover).names


class AtLeast(Table, frozen=True):
    """A gate that opens when `at_least` of its inputs occur."""

    at_least: Annotated[int, msgspec.Meta(ge=1)]


class EventSpec(Table, frozen=True):
    """An unwanted event: basic, or the output of a gate over other events."""

    name: Name
    title: str = ""
    gate: Annotated[Literal["or", "and"] | AtLeast | None, msgspec.Meta(
        description="'or', 'and' or { at_least = k }")] = None
    of: tuple[Name, ...] = ()

    @property
    def required(self) -> int:
        """How many of its inputs make it occur; 0 for a basic event."""
        if self.gate is None:
            return 0
        if isinstance(self.gate, AtLeast):
            return self.gate.at_least
        return 1 if self.gate == "or" else max(1, len(self.of))


class FaultSpec(Table, frozen=True):
    """A fault of the system that has a name: what happens to one topic; see `Injection`.

    Attributes:
        name: As it is typed, e.g. "gauge-stuck".
        title: For people.
        topic: Key below `rampart/`, where it is published.
        mode: What happens to its messages: "drop", "corrupt" and so on.
        kind: By which faults are listed and drawn: "sensor", "actuator" and so on.
        duration_s: How long it lasts unless told otherwise, simulated seconds.
        set: For corrupt: field → value that takes the place of the true one.
        add: For corrupt: field → what is added.
        ramp: For corrupt: field → what is added per simulated second.
        noise: For corrupt: field → standard deviation.
        keep_ends: For corrupt: lists of which the first and last element stay.
        delay_s: For delay.
        stamp_s: For restamp: ahead, or behind if below 0.
        detected_by: Detection modules that should see it.
    """

    name: Annotated[str, msgspec.Meta(
        pattern=r"^[a-z][a-z0-9-]{0,63}\Z",
        description="a name: a small letter, then small letters, digits and hyphens")]
    title: str
    topic: str
    mode: str
    kind: Name = "named"
    duration_s: Positive = 10.0
    set: dict[str, Any] = {}
    add: dict[str, float] = {}
    ramp: dict[str, float] = {}
    noise: dict[str, float] = {}
    keep_ends: tuple[str, ...] = ()
    delay_s: NonNegative = 0.0
    stamp_s: float = 0.0
    detected_by: tuple[Name, ...] = ()


class SystemSpec(Table, frozen=True):
    """A whole system. In the file the arrays of tables are called by the singular.

    Attributes:
        application: What the system adds to the engine: `class`, and that class's options.
        judge: Who says what a run was worth: `class`, and that class's parameters.
        end: When a run is over.
        hosts: Its machines, the robot's first; none for a system of one machine.
        link: What is assumed of the network between them.
        mobile: Speeds and distances of a mobile robot, `[robot]` in the file.
        strategy: By which the arbiter decides; `rampart.manager.strategies.registry` has them.
        shadow: A strategy that is asked as well, and whose differing decisions are recorded;
            "" for none.
        order: Name of an order of the recoveries, or several: what the first leaves open the
            next decides. The first is the one that says what is safer.
        panels: Of the operator's page, besides those of its class; see `rampart.actors.operator`.
        ros2: What is passed on between ROS 2 and the system, likewise.
    """

    name: Name
    title: str
    application: dict[str, Any] = {}
    judge: dict[str, Any] = {}
    end: End = End()
    hosts: Few[tuple[HostSpec, ...]] = msgspec.field(name="host", default=())
    link: Link = Link()
    mobile: Robot | None = msgspec.field(name="robot", default=None)
    strategy: str = "safety-first"
    shadow: str = ""
    order: str | tuple[str, ...] = "safer"  # a pattern beside a list has msgspec 0.22 crash
    timing: Timing = Timing()
    layers: Layers = Layers()
    supervision: Supervision = Supervision()
    nodes: Rows[NodeSpec] = msgspec.field(name="node", default=())
    detections: Rows[DetectionSpec] = msgspec.field(name="detection", default=())
    recoveries: Rows[RecoverySpec] = msgspec.field(name="recovery", default=())
    mechanisms: Rows[MechanismSpec] = msgspec.field(name="mechanism", default=())
    events: Annotated[tuple[EventSpec, ...], msgspec.Meta(max_length=5000)] = msgspec.field(
        name="event", default=())
    orders: Few[dict[str, Relation]] = {}
    faults: Rows[FaultSpec] = msgspec.field(name="fault", default=())
    panels: Rows[dict[str, Any]] = msgspec.field(name="panel", default=())
    ros2: Rows[dict[str, Any]] = ()

    @property
    def titles(self) -> dict[str, str]:
        """Titles of modules and mechanisms by name; a mechanism's are those of its detections."""
        found = {one.name: one.title for one in self.detections}
        found |= {one.name: one.title for one in self.recoveries}
        return found | {one.name: " / ".join(found[name] for name in one.detections
                                             if name in found) for one in self.mechanisms}

    def without_disabled(self) -> SystemSpec:
        """Return the spec without the mechanisms that are disabled; itself if none is.

        Modules that are disabled stay: their processes run, but what they say has no effect.
        """
        off = {d.name for d in self.detections if not d.enabled}
        off |= {r.name for r in self.recoveries if not r.enabled}
        left = tuple(m for m in self.mechanisms
                     if m.enabled and not off.intersection((*m.detections, *m.recoveries)))
        return self if left == self.mechanisms else msgspec.structs.replace(self, mechanisms=left)

    def actors(self) -> tuple[NodeSpec, ...]:
        """Return everything that runs as an actor, detection and recovery modules as nodes too.

        `process` is filled in. With the layer `ftm` off, those that make up fault tolerance (the
        detection modules, the recovery modules, the FTM Manager) are left out.
        """
        actors = list(self.nodes)
        actors += [NodeSpec(m.name, Kind.DETECTION, m.actor, m.process, m.host,
                            parameters=m.parameters) for m in self.detections]
        actors += [NodeSpec(m.name, Kind.RECOVERY, m.actor, m.process, m.host,
                            parameters=m.parameters) for m in self.recoveries]
        tolerance = {Kind.DETECTION, Kind.RECOVERY, Kind.MANAGER}
        return tuple(msgspec.structs.replace(node, process=node.process or node.name)
                     for node in actors if self.layers.ftm or node.kind not in tolerance)

    def placed(self) -> Iterator[tuple[str, NodeSpec | DetectionSpec | RecoverySpec]]:
        """Yield all nodes, detection and recovery modules, each with its path in the file."""
        yield from numbered("node", self.nodes)
        yield from numbered("detection", self.detections)
        yield from numbered("recovery", self.recoveries)

    @property
    def host_of(self) -> dict[str, str]:
        """Names of all nodes, detection and recovery modules with that of their host."""
        first = self.hosts[0].name if self.hosts else ""
        return {one.name: one.host if first and one.host else first for _, one in self.placed()}

    def link_s(self, node: str, others: Iterable[str]) -> float:
        """Return how long a message between a node and any of others is under way on a network."""
        host_of = self.host_of if self.hosts else {}
        return self.link.delay_s if any(
            host_of.get(other) != host_of.get(node) for other in others) else 0.0

    def processes(self) -> dict[str, tuple[NodeSpec, ...]]:
        """Return the actors of each OS process, by the name of the process."""
        placement: dict[str, list[NodeSpec]] = {}
        for node in self.actors():
            placement.setdefault(node.process, []).append(node)
        return {process: tuple(nodes) for process, nodes in placement.items()}

    def build_mechanisms(self, patience_s: Mapping[str, float] = MappingProxyType({})
                         ) -> Mechanisms:
        """Build the registry of mechanisms and recovery contracts.

        Args:
            patience_s: How long each mechanism's recovery may take
                (`rampart.manager.spec.budget.patience_s`).
        """
        return Mechanisms(
            [Mechanism(m.name, m.detect, m.recover, patience_s.get(m.name, math.inf), m.explains)
             for m in self.mechanisms],
            [Contract(r.name, r.kind, r.claims, r.interruptible, r.latched, r.deadline_s,
                      r.escalate_to, r.needs, r.disables, r.excused_by) for r in self.recoveries])

    def build_fault_tree(self) -> FaultTree:
        """Build the fault tree."""
        return FaultTree([Event(e.name, e.of, e.required) for e in self.events])

    def build_ftm_tree(self) -> Tree:
        """Derive the FTMTree from the fault tree and the placement of the mechanisms."""
        return self.build_fault_tree().derive_ftm_tree({m.name: m.event for m in self.mechanisms})

    @property
    def robot(self) -> Robot:
        """The mobile robot.

        Raises:
            ValueError: The system is none.
        """
        if self.mobile is None:
            raise ValueError(f"system {self.name!r} has no [robot]")
        return self.mobile

    @property
    def criteria(self) -> tuple[str, ...]:
        """Names of the selected orders; the first says what is safer."""
        return (self.order,) if isinstance(self.order, str) else self.order

    def build_order(self, *criteria: str) -> PartialOrder:
        """Build the RM order of these criteria; of those that the spec selects if none is given.

        Raises:
            CycleError: One of them has a cycle, or together they have one.
        """
        names = [r.name for r in self.recoveries]
        return refine([PartialOrder(names, self.orders[c]) for c in criteria or self.criteria])

    def build_safety_order(self) -> PartialOrder:
        """Build the order that says which recovery is safer: the first criterion alone."""
        return self.build_order(self.criteria[0])
