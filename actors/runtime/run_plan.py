"""The plan of one run: which system, with what choices, and what all its processes need to know.

The launcher makes it, the spawner receives it once and hands it on through `fork`. It is plain
data (JSON), so that any process can be given it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from rampart.actors.bus.run_folder import ROUTERS
from rampart.actors.bus.zenoh_session import Credentials, credentials_in
from rampart.actors.ftm.messages import NamedFault
from rampart.actors.web.page_plan import PagePlan
from rampart.files import toml
from rampart.files.reading import FileError, read_text
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.spec.specification import check_document, read_document
from rampart.manager.spec.tables import Layers, SpecificationError

SUPERVISOR = "supervisor"
OBSERVER = "observer"
DEFAULT_PORT = 7450


def on_host(name: str, host: str) -> str:
    """Return what is called `name` on the first host as it is called on another one."""
    return f"{name}_{host}" if host else name


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
        ftm: False runs the paper's unprotected baseline.
        page: the operator's page of this host.
        launcher_pid: process id of the launcher; set by it.
        folder: folder of the run's sockets, which only its user can enter; made by the launcher.
        error_log: file that collects tracebacks of failed nodes; "" for none.
        origin_s: reading of the monotonic clock at simulated time 0; set when all is loaded.
        checkpoints: directory for the nodes' checkpoints; "" keeps none, whatever the spec says.
        faults: what the page offers to inject by name.
        waits: True has the mission wait until the operator starts it from the page.
        virtual: whether time is virtual: nothing outside of the process is used.
        keys: folder of keys, "" for a run without.
        ports: of loopback, on which the routers are spoken with in a run with keys; the launcher's.
        options: of the system's application, in place of what the spec says.
        host: name of the machine that this is the plan of; "" on the first, and on the only one.
        incarnations: of the supervisor and the routers of this host begin above this number.
        part: how often the run was resumed.
        begins_s: simulated time at which this part of the run begins; before, it is starting.
    """

    run_id: str = "run"
    base_port: int = DEFAULT_PORT
    rate: float = 1.0
    seed: int = 1
    system_file: str = ""
    strategy: str = ""
    ftm: bool = True
    page: PagePlan = PagePlan()
    launcher_pid: int = 0
    folder: str = ""
    shadow: str = ""
    error_log: str = ""
    origin_s: float = 0.0
    checkpoints: str = ""
    faults: tuple[NamedFault, ...] = ()
    waits: bool = False
    virtual: bool = False
    keys: str = ""
    ports: tuple[int, ...] = ()
    options: dict[str, Any] = {}
    host: str = ""
    incarnations: int = 0
    part: int = 0
    begins_s: float = 0.0

    @property
    def supervisor(self) -> str:
        """Name of this host's supervisor."""
        return on_host(SUPERVISOR, self.host)

    @property
    def routers(self) -> dict[str, str]:
        """Names of this host's routers, each with that of its socket."""
        return {on_host(name, self.host): name for name in ROUTERS}

    @property
    def description(self) -> dict[str, Any]:
        """What a recording keeps of it: no secrets, and nothing that is true of one run only."""
        return {**self.options, **{name: getattr(self, name) for name in (
            "system_file", "strategy", "shadow", "seed", "ftm")}}

    def credentials(self, name: str) -> Credentials | None:
        """Return those of one of its processes; None in a run without keys."""
        return credentials_in(self.keys, name, self.folder, self.ports)


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
    chosen = {"strategy": plan.strategy, "shadow": plan.shadow}
    return read_document(text, plan.system_file) | {k: name for k, name in chosen.items() if name}


def tailor(plan: RunPlan, spec: SystemSpec) -> SystemSpec:
    """Return a spec with the baseline's layers off, and commands played, where the plan says so.

    Raises:
        SpecificationError: time is virtual, and a node is a command that nothing plays.
    """
    if plan.virtual:
        nodes = tuple(node.in_virtual_time() for node in spec.nodes)
        for node in nodes:
            if node.command:
                raise SpecificationError(
                    plan.system_file, f"{node.name}: command", "there are no processes in virtual "
                    "time; name with stand_in = 'module:Class' the actor that plays it there",
                    list(node.command))
        spec = msgspec.structs.replace(spec, nodes=nodes, hosts=())
    return spec if plan.ftm else msgspec.structs.replace(spec, layers=Layers(
        dead_man=False, safety_pilot_checks=False, manager_watch=False,
        supervisor_respawn=False, ftm=False, checkpoints=False))
