"""The plan of one run: which actor lives in which process, on which port, with what data.

The launcher makes it, the spawner receives it once and hands it on through `fork`. It is plain
data (JSON), so that any process can be given it.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from actors.runtime.actor import Actor
from actors.runtime.wiring import Member, partners
from actors.runtime.zenoh_bus import endpoint
from manager.specification import Kind, Layers, NodeSpec, SystemSpec, parse_specification

SUPERVISOR = "supervisor"
OBSERVER = "observer"
DEFAULT_PORT = 7450

SUPERVISOR_CLASS = "actors.supervision.supervisor:Supervisor"
OBSERVER_CLASS = "sim.observer:Observer"


class RunPlan(msgspec.Struct, frozen=True):
    """What all processes of a run have in common.

    Attributes:
        run_id: unique name of the run.
        base_port: the supervisor's port; the nodes' follow.
        rate: simulated seconds per second.
        seed: for everything random.
        system_file: path of the system spec.
        strategy: name that replaces the spec's strategy; "" for the spec's.
        airport: name or path.
        mission: name or path.
        obstacles: how many of the airport's obstacles stand there.
        ftm: False runs the paper's unprotected baseline.
        hmi_port: port of the operator's page; 0 for none.
        launcher_pid: process id of the launcher; set by it.
        error_log: file that collects tracebacks of failed nodes; "" for none.
        origin_s: reading of the monotonic clock at simulated time 0; set when all is loaded.
    """

    run_id: str
    base_port: int
    rate: float
    seed: int
    system_file: str
    strategy: str
    airport: str
    mission: str
    obstacles: int
    ftm: bool
    hmi_port: int
    launcher_pid: int = 0
    error_log: str = ""
    origin_s: float = 0.0


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


def load_system(plan: RunPlan) -> SystemSpec:
    """Read the plan's system spec, with the baseline's layers off where the plan says so.

    Raises:
        SpecificationError: the spec is unsound.
        OSError: it cannot be read.
    """
    spec = parse_specification(
        Path(plan.system_file).read_text(encoding="utf-8"), plan.system_file)
    if plan.strategy:
        spec = msgspec.structs.replace(spec, strategy=plan.strategy)
    if not plan.ftm:
        spec = msgspec.structs.replace(spec, layers=Layers(
            dead_man=False, safety_pilot_checks=False, manager_watch=False,
            supervisor_respawn=False, ftm=False))
    return spec


def load_class(path: str) -> type[Actor]:
    """Return the actor class named `module:Class`.

    Raises:
        ValueError: there is no such class, or it is no actor.
    """
    module, _, name = path.partition(":")
    try:
        found = getattr(importlib.import_module(module), name, None)
    except ImportError as error:
        raise ValueError(f"actor = {path!r}: {error}") from None
    if not (isinstance(found, type) and issubclass(found, Actor)):
        raise ValueError(f"actor = {path!r}: no such actor class")
    return found


def actor_parameters(plan: RunPlan, spec: SystemSpec, node: NodeSpec) -> dict[str, Any]:
    """Return a node's parameters: what follows from plan and spec, then what the spec says.

    A recovery module that respawns gets the nodes that name it; the world gets the run's seed,
    obstacles, and the dead man of the robot's base.
    """
    derived: dict[str, Any] = {}
    if node.kind is Kind.RECOVERY:
        own = tuple(n.name for n in spec.nodes if n.respawn == node.name)
        derived = {"nodes": own} if own else {}
    elif node.kind is Kind.WORLD:
        derived = {"seed": plan.seed, "obstacles": plan.obstacles,
                   "dead_man": spec.layers.dead_man,
                   "dead_man_timeout_s": spec.timing.dead_man_timeout_s}
    return {**derived, **node.parameters}


class Layout:
    """Everything derived from plan and spec: units, ports, partners.

    Raises:
        ValueError: an actor class named in the spec does not exist.
    """

    def __init__(self, plan: RunPlan, spec: SystemSpec) -> None:
        self.plan = plan
        self.spec = spec
        self.units: dict[str, Unit] = {
            name: Unit(name, nodes) for name, nodes in spec.processes().items()}
        self.unit_of: dict[str, str] = {
            node.name: unit.name for unit in self.units.values() for node in unit.nodes}
        own = [
            Member(SUPERVISOR, load_class(SUPERVISOR_CLASS), {"nodes": tuple(self.unit_of)}),
            Member(OBSERVER, load_class(OBSERVER_CLASS), {}),
        ]
        self.members: dict[str, Member] = {
            m.name: m for m in (*own, *(
                Member(n.name, load_class(n.actor), actor_parameters(plan, spec, n))
                for n in spec.actors()))}
        self.port_of: dict[str, int] = {
            name: plan.base_port + i for i, name in enumerate(self.members)}
        self._partners = partners(self.members.values())

    def listen(self, node: str) -> str:
        """Return the endpoint on which a node listens."""
        return endpoint(self.port_of[node])

    def dial(self, node: str) -> list[str]:
        """Return the endpoints that a node connects to when it starts."""
        return [endpoint(self.port_of[p]) for p in self._partners[node]]


def load_shared(plan: RunPlan, spec: SystemSpec) -> Mapping[str, Any]:
    """Load what actors share read-only; done once, before the fork.

    Raises:
        ValueError: airport or mission are unsound; the message names file and value.
    """
    from airport.formats import load_airport, load_mission, load_world  # noqa: PLC0415 heavy

    airport = load_airport(plan.airport)
    return {
        "system": spec,
        "airport": airport,
        "world": load_world(plan.airport),
        "mission": load_mission(plan.mission, airport),
        "run_id": plan.run_id,
        "seed": plan.seed,
        "obstacles": plan.obstacles,
        "hmi_port": plan.hmi_port,
        "plan": plan,
    }
