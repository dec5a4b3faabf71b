"""The tables of a system specification: modules, mechanisms, fault tree, faults, orders.

These types define field names, types, names and ranges; `rampart.manager.spec.specification`
reads a file into them. `systems/osmosis.toml` shows every field.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import Annotated, Any, Literal, TypeVar

import msgspec

from rampart.manager.model.fault_tree import Event, FaultTree
from rampart.manager.model.gates import detection_gate, recovery_gate
from rampart.manager.model.mechanisms import (
    Clears,
    Contract,
    Mechanism,
    Mechanisms,
    RecoveryKind,
)
from rampart.manager.model.order import PartialOrder, Tree, refine
from rampart.manager.spec.hosts import HostSpec, Link
from rampart.manager.spec.mobile_robot import Hazard, Robot
from rampart.manager.spec.nodes import ClassPath, Kind, NodeSpec
from rampart.manager.spec.tables import (
    DERIVED,
    BlackBox,
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
"""Rows of a table, bounded because some checks take quadratic time."""

Relation = Annotated[dict[str, Annotated[tuple[str, ...], msgspec.Meta(
    description="a list of recovery names")]], msgspec.Meta(
    description="a table, recovery = [less safe recoveries]")]


class DetectionSpec(Table, frozen=True):
    """A detection module.

    Attributes:
        within_s: Longest time from the error to the report; a number or the name of a `[timing]`
            value. Default: `parameters.timeout_s`.
        process: Name of its OS process; "" for the name of the module.
        host: Host on which it runs; "" for the first.
        parameters: Of the actor, as for a node. The manager uses three: `watch`, a list of node
            names; `timeout_s`; `margin_m`, the distance at which the module warns.
        enabled: False leaves out every mechanism that uses the module.
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
        """Longest time from the error to the report; NaN if the spec has none.

        Of `within_s` and `parameters.timeout_s` the longer one counts.
        """
        return max(self._times_s)

    @property
    def soonest_s(self) -> float:
        """The shorter of the two, for mechanisms that must be faster than this module."""
        return min(self._times_s)

    @property
    def _times_s(self) -> tuple[float, float]:
        within_s = float(self.within_s)
        return within_s, float(self.parameters.get("timeout_s", within_s))


class RecoverySpec(Table, frozen=True):
    """A recovery module; see `rampart.manager.model.mechanisms.Contract`.

    Its parameter `nodes` lists the names of the nodes that it may respawn.
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
    """A hazard in words, and the time that is left before it, in seconds."""

    within_s: Positive
    hazard: str


class MechanismSpec(Table, frozen=True):
    """FTMx(DMy, RMz), a barrier on an event of the fault tree.

    Attributes:
        detect: A detection module, or a gate over several (`rampart.manager.model.gates`).
        recover: A recovery module, or a gate over several.
        event: The event of the fault tree on which it is a barrier.
        against: The hazard that it must forestall.
        explains: Mechanisms whose detections are its consequences, as many are of an overloaded
            machine; they do not act while it is detected.
        clears: What ends the mechanism when its error is gone; None for by operator if each of its
            recoveries is latched, and by itself otherwise.
        clear_after_s: How long the error must have been gone, seconds.
        cleared_by: Least role of the operator who may reset it.
        enabled: False leaves the mechanism out, as does a disabled module.
    """

    name: Name
    detect: str
    recover: str
    event: Name
    against: Annotated[Hazard | Within, msgspec.Meta(description=(
        "one of drift, runaway, intrusion, parent, or { within_s = ..., hazard = '...' }"
        ))] = Hazard.DRIFT
    explains: frozenset[Name] = frozenset()
    clears: Annotated[Clears | None, msgspec.Meta(
        description="'by itself', 'by operator' or 'never'")] = None
    clear_after_s: NonNegative = 0.0
    cleared_by: Literal["drive", "inject"] = "drive"
    enabled: bool = True

    @property
    def detections(self) -> tuple[str, ...]:
        """Names of the detection modules in its gate."""
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
        """How many inputs must occur for the event to occur; 0 for a basic event."""
        if self.gate is None:
            return 0
        if isinstance(self.gate, AtLeast):
            return self.gate.at_least
        return 1 if self.gate == "or" else max(1, len(self.of))


class FaultSpec(Table, frozen=True):
    """A named fault that changes the messages of one topic; see `Injection`.

    Attributes:
        topic: Key of the topic below `rampart/`.
        mode: What happens to its messages: "drop", "corrupt" and so on.
        kind: Group in lists and pictures: "sensor", "actuator" and so on.
        duration_s: Default duration, simulated seconds.
        set: For corrupt: field → value in place of the true one.
        add: For corrupt: field → value to add.
        ramp: For corrupt: field → value to add per simulated second.
        noise: For corrupt: field → standard deviation.
        keep_ends: For corrupt: lists whose first and last elements stay.
        delay_s: For delay.
        stamp_s: For restamp: seconds ahead; negative for behind.
        detected_by: Detection modules that should detect it.
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
    """A whole system. In the file, arrays of tables have singular names.

    Attributes:
        application: What the system adds to the engine: `class`, and its options.
        judge: The test oracle of a run: `class`, and its parameters.
        end: When a run ends.
        hosts: Its machines, the robot's first; empty for a system of one machine.
        link: Assumptions about the network between them.
        mobile: Speeds and distances of a mobile robot, `[robot]` in the file.
        strategy: Strategy of the arbiter (`rampart.manager.strategies.registry`).
        shadow: A strategy that decides without effect; differing decisions are recorded. "" for
            none.
        order: Name of an order of the recoveries, or several; each decides what those before it
            leave open. The first defines which recovery is safer.
        black_box: What the black box keeps around faults; None for the defaults.
        panels: Additional panels of the operator's page (`rampart.actors.operator`).
        ros2: Links to ROS 2 (`rampart.actors.ros2`).
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
    order: str | tuple[str, ...] = "safer"  # with a pattern beside a list msgspec 0.22 crashes
    timing: Timing = Timing()
    layers: Layers = Layers()
    supervision: Supervision = Supervision()
    black_box: BlackBox | None = None
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
        """Titles of modules and mechanisms by name.

        A mechanism has the title of its detection module, or its gate with titles in quotes.
        """
        titles = {d.name: d.title for d in self.detections}
        quoted = {name: f"'{title}'" for name, title in titles.items() if title}
        gates = {m.name: detection_gate(m.detect) for m in self.mechanisms}
        titles |= {r.name: r.title for r in self.recoveries}
        return titles | {name: titles[gate.name] if gate.name else str(gate.renamed(quoted))
                         for name, gate in gates.items()}

    def without_disabled(self) -> SystemSpec:
        """Return the spec without disabled mechanisms; itself if none is disabled.

        Disabled modules stay: their processes run, but their reports have no effect.
        """
        off = {d.name for d in self.detections if not d.enabled}
        off |= {r.name for r in self.recoveries if not r.enabled}
        left = tuple(m for m in self.mechanisms
                     if m.enabled and not off.intersection((*m.detections, *m.recoveries)))
        return self if left == self.mechanisms else msgspec.structs.replace(self, mechanisms=left)

    def actors(self) -> tuple[NodeSpec, ...]:
        """Return all nodes and modules as nodes, with `process` filled in.

        With the layer `ftm` off, detection modules, recovery modules and the FTM Manager are left
        out.
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
        """The name of the host of each node, detection and recovery module."""
        first = self.hosts[0].name if self.hosts else ""
        return {row.name: row.host if first and row.host else first for _, row in self.placed()}

    def latency_s(self, detection: DetectionSpec) -> float:
        """Return the longest time from an error to the report of a detection module.

        A watched command that hangs sends the node's heartbeats until the timeout of its own.
        """
        watched = detection.watch if "timeout_s" in detection.parameters else ()
        return max([detection.latency_s, *(
            node.heartbeat.timeout_s for node in self.nodes
            if node.heartbeat and node.name in watched)])

    def link_s(self, node: str, others: Iterable[str]) -> float:
        """Return the link's delay if any of the others is on another host, else 0."""
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
        """Build the registry of mechanisms and contracts; see `budget.patience_s` for patience."""
        return Mechanisms(
            [Mechanism(m.name, m.detect, m.recover, patience_s.get(m.name, math.inf), m.explains,
                       m.clears or Clears.BY_ITSELF, m.clear_after_s) for m in self.mechanisms],
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
            ValueError: The system has no [robot].
        """
        if self.mobile is None:
            raise ValueError(f"system {self.name!r} has no [robot]")
        return self.mobile

    @property
    def criteria(self) -> tuple[str, ...]:
        """Names of the selected orders; the first defines which recovery is safer."""
        return (self.order,) if isinstance(self.order, str) else self.order

    def build_order(self, *criteria: str) -> PartialOrder:
        """Build the RM order of these criteria; by default of those that the spec selects.

        Raises:
            CycleError: A criterion has a cycle, or they contradict each other.
        """
        names = [r.name for r in self.recoveries]
        return refine([PartialOrder(names, self.orders[c]) for c in criteria or self.criteria])

    def build_safety_order(self) -> PartialOrder:
        """Build the order that defines which recovery is safer: the first criterion."""
        return self.build_order(self.criteria[0])
