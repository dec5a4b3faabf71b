"""The plan of one run: which actor lives in which process, on which port, with what data.

The launcher makes it, the spawner receives it once and hands it on through `fork`. It is plain
data (JSON), so that any process can be given it.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from rampart.actors.bus.zenoh_bus import endpoint
from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import AdaptedSystem
from rampart.actors.osmosis.messages import NamedFault
from rampart.actors.runtime.wiring import Member, load_class, load_member, partners
from rampart.actors.supervision.kill_node import signal_node
from rampart.actors.web.access import page_url
from rampart.files import toml
from rampart.files.reading import FileError, read_text
from rampart.manager.spec.specification import (
    Kind,
    Layers,
    NodeSpec,
    SpecificationError,
    SystemSpec,
    check_document,
    check_modules,
    read_document,
)

SUPERVISOR = "supervisor"
OBSERVER = "observer"
DEFAULT_PORT = 7450

SUPERVISOR_CLASS = "rampart.actors.supervision.supervisor:Supervisor"
OBSERVER_CLASS = "rampart.sim.runs.observer:Observer"


class RunPlan(msgspec.Struct, frozen=True):
    """What all processes of a run have in common.

    Attributes:
        run_id: unique name of the run.
        base_port: number that tells the runs of this machine apart.
        rate: simulated seconds per second.
        seed: for everything random.
        system_file: path of the system spec.
        strategy: name that replaces the spec's strategy; "" for the spec's.
        shadow: name of a strategy to run in shadow; "" for the spec's.
        airport: name or path; "" if the system drives nowhere.
        mission: name or path; "" likewise.
        obstacles: how many of the airport's obstacles stand there.
        ftm: False runs the paper's unprotected baseline.
        hmi_port: port of the operator's page; 0 for none.
        launcher_pid: process id of the launcher; set by it.
        folder: folder of the run's sockets, which only its user can enter; made by the launcher.
        error_log: file that collects tracebacks of failed nodes; "" for none.
        origin_s: reading of the monotonic clock at simulated time 0; set when all is loaded.
        checkpoints: directory for the nodes' checkpoints; "" keeps none, whatever the spec says.
        hmi_host: address at which the operator's page is served.
        hmi_token: what everybody has to show there; "" for nothing, on loopback.
        hmi_token_is_new: it was made for this run, so that nobody has it yet who needs it.
        faults: what the page offers to inject by name.
        waits: True has the mission wait until the operator starts it from the page.
        joystick: device to drive with, "auto" for the first; "" for what the spec says.
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
    folder: str = ""
    shadow: str = ""
    error_log: str = ""
    origin_s: float = 0.0
    checkpoints: str = ""
    joystick: str = ""
    hmi_host: str = "127.0.0.1"
    hmi_token: str = ""
    hmi_token_is_new: bool = False
    faults: tuple[NamedFault, ...] = ()
    waits: bool = False

    @property
    def description(self) -> dict[str, Any]:
        """What a recording keeps of it: no secrets, and nothing that is true of one run only."""
        return {name: getattr(self, name) for name in (
            "system_file", "airport", "mission", "strategy", "shadow", "seed", "obstacles", "ftm")}

    @property
    def hmi_page(self) -> str:
        """Where the operator's page is, "" if there is none, for everybody: without the token."""
        return page_url(self.hmi_host, self.hmi_port) if self.hmi_port else ""

    @property
    def hmi_page_to_open(self) -> str:
        """The same, once, for who has started the run: with the token, if it is new."""
        if self.hmi_token and not self.hmi_token_is_new:
            return f"{self.hmi_page} (open it with #token= and your token behind)"
        return page_url(self.hmi_host, self.hmi_port, self.hmi_token)


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
    return tailor(plan, check_document(load_document(plan), plan.system_file))


def load_document(plan: RunPlan) -> dict[str, Any]:
    """Read the plan's system spec as TOML, with the plan's choice of strategies.

    Raises:
        SpecificationError: it is no TOML, or no text at all.
        OSError: it cannot be read.
    """
    try:
        text = read_text(Path(plan.system_file), toml.MAX_SIZE)
    except FileError as error:
        raise SpecificationError(plan.system_file, "$", str(error)) from None
    document = read_document(text, plan.system_file)
    chosen = {"strategy": plan.strategy, "shadow": plan.shadow}
    return {**document, **{key: name for key, name in chosen.items() if name}}


def tailor(plan: RunPlan, spec: SystemSpec) -> SystemSpec:
    """Return a spec with the baseline's layers off where the plan says so."""
    if not plan.ftm:
        spec = msgspec.structs.replace(spec, layers=Layers(
            dead_man=False, safety_pilot_checks=False, manager_watch=False,
            supervisor_respawn=False, ftm=False, checkpoints=False))
    return spec


def member_of(plan: RunPlan, spec: SystemSpec, node: NodeSpec) -> Member:
    """Return a node with its class and parameters: what follows from the plan, then the spec's.

    The world gets the run's seed, obstacles, and the dead man of the robot's base.

    Raises:
        ValueError: as `load_member`.
    """
    world = {"seed": plan.seed, "obstacles": plan.obstacles, "dead_man": spec.layers.dead_man,
             "dead_man_timeout_s": spec.timing.dead_man_timeout_s}
    return load_member(node, spec, plan.system_file, topics.REPORTS_ON.get(node.kind),
                       world if node.kind is Kind.WORLD else {})


class Layout:
    """Everything derived from plan and spec: units, endpoints, partners.

    Raises:
        ValueError: an actor class named in the spec does not exist, cannot be imported, belongs
            into another table, or does not take its parameters.
    """

    def __init__(self, plan: RunPlan, spec: SystemSpec) -> None:
        self.plan = plan
        self.spec = spec
        self.units: dict[str, Unit] = {
            name: Unit(name, nodes) for name, nodes in spec.processes().items()}
        self.unit_of: dict[str, str] = {
            node.name: unit.name for unit in self.units.values() for node in unit.nodes}
        supervisor, observer = load_class(SUPERVISOR_CLASS), load_class(OBSERVER_CLASS)
        heard = msgspec.convert({"nodes": tuple(self.unit_of)}, supervisor.Parameters)
        own = [Member(SUPERVISOR, supervisor, heard),
               Member(OBSERVER, observer, observer.Parameters())]
        self.members: dict[str, Member] = {
            m.name: m for m in (*own, *(member_of(plan, spec, n) for n in spec.actors()))}
        self._partners = partners(self.members.values())

    def listen(self, node: str) -> str:
        """Return the endpoint on which a node listens."""
        return endpoint(self.plan.folder, node)

    def dial(self, node: str) -> list[str]:
        """Return the endpoints that a node connects to when it starts."""
        return [endpoint(self.plan.folder, p) for p in self._partners[node]]


def adapted_system(
    layout: Layout, shared: Mapping[str, Any], adapted: AdaptedSystem
) -> tuple[Layout, dict[str, Any]]:
    """Return layout and shared objects of the system as it was changed while running.

    Raises:
        ValueError: the changed system is unsound, has other processes, or names a module that the
            system as it was started does not. The manager lets none of this happen; a message may.
    """
    try:
        document = msgspec.json.decode(adapted.document, type=dict[str, Any])
    except RecursionError:
        raise ValueError("the changed system is nested too deep") from None
    spec = tailor(layout.plan, check_document(document, layout.plan.system_file))
    check_modules(layout.spec, spec)
    if spec.processes().keys() != layout.units.keys():
        raise ValueError(f"{layout.plan.system_file}: not the processes that were started")
    return Layout(layout.plan, spec), {
        **shared, "system": spec, "document": document, "adapted": adapted}


def load_shared(plan: RunPlan, spec: SystemSpec) -> Mapping[str, Any]:
    """Load what actors share read-only; done once, before the fork.

    Raises:
        ValueError: airport or mission are unsound; the message names file and value.
    """
    from rampart.actors.osmosis.airport.formats import load_airport, load_mission, load_world  # noqa: PLC0415 heavy

    airport = load_airport(plan.airport) if plan.airport else None
    return {
        "system": spec,
        "document": load_document(plan),
        "airport": airport,
        "world": load_world(plan.airport) if airport else None,
        "mission": load_mission(plan.mission, airport) if airport else None,
        "run_id": plan.run_id,
        "seed": plan.seed,
        "obstacles": plan.obstacles,
        "hmi_port": plan.hmi_port,
        "hmi_host": plan.hmi_host,
        "hmi_token": plan.hmi_token,
        "faults": plan.faults,
        "waits": plan.waits,
        "signal_node": partial(signal_node, port=plan.base_port),
        "joystick": plan.joystick,
        "plan": plan,
    }
