"""The plan of one run: its system, its choices, and the data that all its processes need.

The launcher makes it, and the processes inherit it by `fork`. It is plain data (JSON).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec

from rampart.actors.bus.run_folder import ROUTERS
from rampart.actors.bus.zenoh_session import Credentials, credentials_in
from rampart.actors.ftm.messages import NamedFault
from rampart.actors.web.access import PagePlan
from rampart.files import toml
from rampart.files.reading import FileError, read_text
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.spec.specification import check_document, read_document
from rampart.manager.spec.tables import Layers, SpecificationError

SUPERVISOR = "supervisor"
OBSERVER = "observer"
DEFAULT_PORT = 7450


def on_host(name: str, host: str) -> str:
    """Return the name that `name` of the first host has on a host."""
    return f"{name}_{host}" if host else name


class RunPlan(msgspec.Struct, frozen=True):
    """Data that all processes of a run share.

    Attributes:
        run_id: unique name of the run.
        base_port: distinguishes the runs of this machine.
        rate: simulated seconds per second.
        seed: seed of all random numbers.
        system_file: path of the specification.
        strategy: strategy in place of the specification's, or "".
        shadow: shadow strategy in place of the specification's, or "".
        ftm: False runs the paper's unprotected baseline.
        page: the operator's page of this host.
        launcher_pid: process id of the launcher, which sets it.
        folder: run folder, of mode 0700; the launcher makes it.
        error_log: file that collects tracebacks of failed nodes, or "".
        origin_s: reading of the monotonic clock at simulated time 0; set when all is loaded.
        checkpoints: directory of the nodes' checkpoints; "" keeps none.
        faults: faults that the page offers by name.
        waits: whether the mission waits until the operator starts it from the page.
        virtual: whether time is virtual, with nothing outside the process.
        keys: folder of credentials, "" for a run without.
        ports: the routers' loopback ports in a run with credentials; the launcher sets them.
        options: options of the application, in place of the specification's.
        host: name of this plan's host; "" on the first one.
        incarnations: incarnations of this host's supervisor and routers are above this number.
        watchdog: device that the root feeds while supervisor and manager work, or "".
        part: number of times the run was resumed.
        begins_s: simulated time at which this part of the run begins, after start-up.
        black_box: folder of the system's incidents and history; "" without a black box.
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
    watchdog: str = ""
    part: int = 0
    begins_s: float = 0.0
    black_box: str = ""

    @property
    def supervisor(self) -> str:
        """The name of this host's supervisor."""
        return on_host(SUPERVISOR, self.host)

    @property
    def routers(self) -> dict[str, str]:
        """The names of this host's routers, each with the name of its socket."""
        return {on_host(name, self.host): name for name in ROUTERS}

    @property
    def description(self) -> dict[str, Any]:
        """The part that a recording includes: no secrets, and nothing about one run only."""
        return {**self.options, **{name: getattr(self, name) for name in (
            "system_file", "strategy", "shadow", "seed", "ftm")}}

    def credentials(self, name: str) -> Credentials | None:
        """Return the credentials of a process; None in a run without."""
        return credentials_in(self.keys, name, self.folder, self.ports)


def load_system(plan: RunPlan) -> SystemSpec:
    """Read the plan's specification, and tailor it to the plan.

    Raises:
        SpecificationError: the specification is wrong.
        OSError: it cannot be read.
    """
    return tailor(plan, check_document(load_document(plan), plan.system_file))


def load_document(plan: RunPlan) -> dict[str, Any]:
    """Read the plan's specification as TOML data, with the plan's strategies.

    Raises:
        SpecificationError: the file is not TOML.
        OSError: it cannot be read.
    """
    try:
        text = read_text(Path(plan.system_file), toml.MAX_SIZE)
    except FileError as error:
        raise SpecificationError(plan.system_file, "$", str(error)) from None
    chosen = {"strategy": plan.strategy, "shadow": plan.shadow}
    return read_document(text, plan.system_file) | {k: name for k, name in chosen.items() if name}


def tailor(plan: RunPlan, spec: SystemSpec) -> SystemSpec:
    """Return a specification for virtual time or the unprotected baseline, if the plan asks for it.

    Raises:
        SpecificationError: time is virtual, and a command has no `stand_in`.
    """
    if plan.virtual:
        nodes = tuple(node.in_virtual_time() for node in spec.nodes)
        for node in nodes:
            if node.command:
                raise SpecificationError(
                    plan.system_file, f"{node.name}: command", "virtual time has no processes; "
                    "expected stand_in = 'module:Class', an actor in its place",
                    list(node.command))
        spec = msgspec.structs.replace(spec, nodes=nodes, hosts=())
    return spec if plan.ftm else msgspec.structs.replace(spec, layers=Layers(
        dead_man=False, safety_pilot_checks=False, manager_watch=False,
        supervisor_respawn=False, ftm=False, checkpoints=False))
