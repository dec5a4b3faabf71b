"""The tables of a system specification: robot, timing, nodes, mechanisms, fault tree.

One TOML file says everything that the arbiter, the launcher and the supervisor need to know;
`systems/osmosis.toml` shows every field. These classes are its shape, and what
is checked by type alone: unknown fields, wrong types, names that are no names, negative times.
`rampart.manager.spec.specification` reads a file into them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import StrEnum
from types import MappingProxyType
from typing import Annotated, Any, Literal

import msgspec

from rampart.files.reading import plain_line, shown
from rampart.manager.model.fault_tree import Event, FaultTree
from rampart.manager.model.gates import detection_gate, recovery_gate
from rampart.manager.model.mechanisms import Contract, Mechanism, Mechanisms, RecoveryKind
from rampart.manager.model.order import PartialOrder, Tree, refine

OptionalName = Annotated[str, msgspec.Meta(pattern=r"^([A-Za-z][A-Za-z0-9_]{0,63})?\Z")]
Name = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,63}\Z")]
"""As long as the address of a node's socket has room for (`actors.bus.run_folder`), and well
below what a message takes as a name (`rampart.actors.bus.bounds`), which may add to it."""

ClassPath = Annotated[str, msgspec.Meta(pattern=r"^[a-z_]\w*(\.[a-z_]\w*)*:[A-Z]\w*\Z")]
Positive = Annotated[float, msgspec.Meta(gt=0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0)]

DERIVED = math.nan
"""Default of a timing value that is derived; a file cannot say it, numbers there are finite."""


_LONGEST_SHOWN = 200
"""Characters of a value in a message."""


class SpecificationError(ValueError):
    """A system spec that cannot be accepted. The message is one line.

    Attributes:
        file: Name of the file, as given by the caller.
        path: Where in it, e.g. `$.mechanism[2].detect`.
        problem: What is wrong and what would be right.
    """

    def __init__(self, file: str, path: str, problem: str, *value: object) -> None:
        self.file = file
        self.path = path
        self.problem = problem
        said = f" = {shown(value[0], _LONGEST_SHOWN)}" if value else ""
        super().__init__(plain_line(f"{file}: {path}{said}: {problem}"))


class Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of all tables of a spec: immutable, and a field it does not know is an error."""


class Robot(Table, frozen=True):
    """The robot and the room it has, as far as time budgets depend on them.

    Attributes:
        length_m: Of the footprint, along x of `base_link`.
        width_m: Of the footprint, along y.
        top_speed_mps: Fastest command that the controller gives.
        top_turn_rate_radps: Fastest turn that the controller commands.
        hardware_speed_mps: Fastest the drive goes when it is commanded nonsense.
        acceleration_mps2: With which it gets there.
        braking_mps2: Deceleration that is certain on wet concrete.
        stop_distance_m: The Safety Pilot stops for an obstacle this far ahead of the footprint.
        lateral_distance_m: And for one this far beside it.
        sensing_range_m: The laser shows everything up to this distance ...
        sensing_field_rad: ... in this angle, half of it on either side of straight ahead ...
        sensing_gap_rad: ... with rays no farther apart. A sweep that covers less is not believed.
        gps_accuracy_m: Error bound of the redundant positioning device.
        corridor_clearance_m: From the footprint to the nearest prohibited area, when the robot
            is where it should be.
    """

    length_m: Positive
    width_m: Positive
    top_speed_mps: Positive
    top_turn_rate_radps: Positive
    hardware_speed_mps: Positive
    acceleration_mps2: Positive
    braking_mps2: Positive
    stop_distance_m: Positive
    lateral_distance_m: NonNegative
    sensing_range_m: Positive
    gps_accuracy_m: NonNegative
    corridor_clearance_m: Positive
    sensing_field_rad: Positive = 4.7
    sensing_gap_rad: Positive = 0.035


class Timing(Table, frozen=True):
    """All times, in seconds. Those that default to `DERIVED` follow from the robot if left out.

    Attributes:
        heartbeat_period_s: Between two heartbeats of an actor.
        control_period_s: Between two commands, poses or scans.
        manager_period_s: Between two statuses of the FTM Manager.
        detection_period_s: Between two reports of a detection module whose state stays the same.
        arbitration_s: From a detection report sent to the recovery's command received.
        actuation_s: From a recovery's command received to the wheels feeling it.
        respawn_s: From a node's death being known to its first useful message.
        heartbeat_timeout_s: Without heartbeat for so long, a node counts as crashed (DM4, 5, 7).
        command_timeout_s: Without new command for so long, it is stale (DM2).
        localization_timeout_s: Without new pose for so long, it is stale (DM6).
        scan_timeout_s: A laser sweep older than this shows nothing: the Safety Pilot stops.
        dead_man_timeout_s: Without command for so long, the base brakes by itself.
        manager_timeout_s: Without manager status for so long, the Safety Pilot stops.
        detection_silence_timeout_s: Without report for so long, a detection module counts as
            active.
        startup_grace_s: Silence of a module that was never heard is forgiven for so long.
        release_hold_s: A detection module has to be idle for so long before its mechanism is.
        release_hold_max_s: To which this grows while the module flaps.
    """

    heartbeat_period_s: Positive = 0.1
    control_period_s: Positive = 0.05
    manager_period_s: Positive = 0.1
    detection_period_s: Positive = 0.2
    arbitration_s: Positive = 0.05
    actuation_s: Positive = 0.1
    respawn_s: Positive = 0.4
    heartbeat_timeout_s: Positive = DERIVED
    command_timeout_s: Positive = DERIVED
    localization_timeout_s: Positive = DERIVED
    scan_timeout_s: Positive = DERIVED
    dead_man_timeout_s: Positive = DERIVED
    manager_timeout_s: Positive = DERIVED
    detection_silence_timeout_s: Positive = DERIVED
    startup_grace_s: NonNegative = 5.0
    release_hold_s: NonNegative = 0.5
    release_hold_max_s: NonNegative = 10.0


class Layers(Table, frozen=True):
    """Guards, each of which can be switched off, to run the paper's unprotected baseline.

    Attributes:
        dead_man: The base brakes when commands cease.
        safety_pilot_checks: The Safety Pilot refuses commands out of bounds, stale or out of
            sequence. It stops for obstacles in any case.
        manager_watch: The Safety Pilot stops when the FTM Manager is silent.
        supervisor_respawn: The supervisor respawns what dies and is not the manager's to respawn.
        ftm: Detection modules, recovery modules and the FTM Manager run at all.
        checkpoints: Nodes that hold data keep it on stable storage and come back with it.
    """

    dead_man: bool = True
    safety_pilot_checks: bool = True
    manager_watch: bool = True
    supervisor_respawn: bool = True
    ftm: bool = True
    checkpoints: bool = True


class Kind(StrEnum):
    """What a node is, which decides who guards it and who brings it back."""

    CONTROL = "control"
    NON_CONTROL = "non-control"
    PILOT = "pilot"
    MANAGER = "manager"
    WORLD = "world"
    SUPERVISION = "supervision"
    DETECTION = "detection"
    RECOVERY = "recovery"


NODE_KINDS = (Kind.CONTROL, Kind.NON_CONTROL, Kind.PILOT, Kind.MANAGER, Kind.WORLD)
"""What a `[[node]]` can be; the others are the supervisor, and what has a table of its own."""


class NodeSpec(Table, frozen=True):
    """A node: one actor.

    Attributes:
        name: Unique among nodes, detection and recovery modules.
        actor: Its class, `module:Class`.
        kind: What it is.
        process: Name of the OS process it lives in; "" for one of its own name.
        respawn: Who brings it back: a recovery module, or "supervisor".
        parameters: For the actor. A value of a key in `_s` may name a `[timing]` value.
    """

    name: Name
    actor: ClassPath
    kind: Kind
    process: OptionalName = ""
    respawn: Name = "supervisor"
    parameters: dict[str, Any] = {}


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
        process: OS process it lives in; "" for one of its own name.
        enabled: False leaves out every mechanism that listens to it.
    """

    name: Name
    title: str
    actor: ClassPath
    within_s: Positive | Name = DERIVED
    process: OptionalName = ""
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
        """The shorter of the two, for whoever has to be faster than this module."""
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
    deadline_s: Positive = 2.0
    escalate_to: OptionalName = ""
    process: OptionalName = ""
    parameters: dict[str, Any] = {}
    enabled: bool = True


class Hazard(StrEnum):
    """What a mechanism races against; `rampart.manager.spec.budget` has the physics."""

    DRIFT = "drift"
    """The robot goes on as before, at top speed, until the corridor ends."""
    RUNAWAY = "runaway"
    """It accelerates as hard as it can."""
    INTRUSION = "intrusion"
    """It has come within the detection module's `margin_m` of the prohibited area."""
    PARENT = "parent"
    """Nothing yet, but the mechanism above is about to detect the consequence."""


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
        enabled: False leaves it out. One with a disabled module is left out as well.
    """

    name: Name
    detect: str
    recover: str
    event: Name
    against: Hazard | Within = Hazard.DRIFT
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
    gate: Literal["or", "and"] | AtLeast | None = None
    of: tuple[Name, ...] = ()

    @property
    def required(self) -> int:
        """How many of its inputs make it occur; 0 for a basic event."""
        if self.gate is None:
            return 0
        if isinstance(self.gate, AtLeast):
            return self.gate.at_least
        return 1 if self.gate == "or" else max(1, len(self.of))


class SystemSpec(Table, frozen=True):
    """A whole system. In the file the arrays of tables are called by the singular.

    Attributes:
        application: What the system adds to the engine: `class`, and that class's options.
        mobile: Speeds and distances of a mobile robot, `[robot]` in the file.
        strategy: By which the arbiter decides; `rampart.manager.strategies.registry` has them.
        shadow: A strategy that is asked as well, and whose differing decisions are recorded;
            "" for none.
        order: Name of an order of the recoveries, or several: what the first leaves open the
            next decides. The first is the one that says what is safer.
    """

    name: Name
    title: str
    application: dict[str, Any] = {}
    mobile: Robot | None = msgspec.field(name="robot", default=None)
    strategy: str = "safety-first"
    shadow: str = ""
    order: Name | tuple[Name, ...] = "safer"
    timing: Timing = Timing()
    layers: Layers = Layers()
    nodes: tuple[NodeSpec, ...] = msgspec.field(name="node", default=())
    detections: tuple[DetectionSpec, ...] = msgspec.field(name="detection", default=())
    recoveries: tuple[RecoverySpec, ...] = msgspec.field(name="recovery", default=())
    mechanisms: tuple[MechanismSpec, ...] = msgspec.field(name="mechanism", default=())
    events: tuple[EventSpec, ...] = msgspec.field(name="event", default=())
    orders: dict[str, dict[str, tuple[str, ...]]] = {}

    def without_disabled(self) -> SystemSpec:
        """Return the spec without the mechanisms that are disabled; itself if none is.

        Modules that are disabled stay: their processes run, but nobody acts on what they say.
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
        actors = [
            *self.nodes,
            *(NodeSpec(m.name, m.actor, Kind.DETECTION, m.process, parameters=m.parameters)
              for m in self.detections),
            *(NodeSpec(m.name, m.actor, Kind.RECOVERY, m.process, parameters=m.parameters)
              for m in self.recoveries),
        ]
        tolerance = {Kind.DETECTION, Kind.RECOVERY, Kind.MANAGER}
        return tuple(msgspec.structs.replace(node, process=node.process or node.name)
                     for node in actors if self.layers.ftm or node.kind not in tolerance)

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
            [Mechanism(m.name, m.detect, m.recover, patience_s.get(m.name, math.inf))
             for m in self.mechanisms],
            [Contract(r.name, r.kind, r.claims, r.interruptible, r.latched, r.deadline_s,
                      r.escalate_to, r.needs, r.disables) for r in self.recoveries])

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
