"""What runs in a node's process after the fork: title, signals, actors, exit code.

SIGTERM asks the actors to end in order; a router it ends at once (see `router`). SIGUSR2 wedges the
event loop for good, process and liveliness token still there: the fault that only a heartbeat from
the loop can show.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import time
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from rampart.actors.access.rules import access_of
from rampart.actors.bus.bus import Bus, BusError
from rampart.actors.bus.recorder_connection import RecorderConnection
from rampart.actors.bus.run_folder import ROUTERS, board_of, is_here, issue, register_of
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.bus.zenoh_session import endpoint, endpoints
from rampart.actors.runtime.actor import Actor, Context
from rampart.actors.runtime.checkpoint import CheckpointStore
from rampart.actors.runtime.checkpoint_file import FileCheckpoints
from rampart.actors.runtime.clock import clock_of
from rampart.actors.runtime.run_context import RunContext
from rampart.actors.supervision.process_title import set_title
from rampart.actors.supervision.unseen import report_callbacks
from rampart.actors.system.layout import Layout, router
from rampart.files.streams import complain
from rampart.manager.spec.schema import Kind

WORLD_NICE = -10
"""Niceness of the simulated world, where that is permitted."""

OF_A_PART = 10**9
"""More incarnations of a node than one part of a run has: in a resumed run the next part's begin
there, so that its states are newer."""

EXIT_OK = 0
EXIT_FAILED = 1
EXIT_BUS = 3


def make_actor(layout: Layout, name: str, incarnation: int, run: RunContext,
               loop: asyncio.AbstractEventLoop, *,
               failed: Callable[[Exception], None] = lambda _error: None,
               bus: Bus | None = None) -> Actor:
    """Build one actor of the system, not yet running.

    Args:
        layout: of the run.
        name: of the actor.
        incarnation: of its process.
        run: what all actors of the run have in common.
        loop: that it will run on.
        failed: is told its error.
        bus: that it is to have; None for one of its own.
    """
    member = layout.members.get(name) or router(name)
    clock = clock_of(layout.plan, loop.time)
    bus = bus or _bus_of(layout, name)

    return member.actor(Context(
        name, incarnation, clock, bus, member.parameters, run,
        register=register_of(layout.plan.folder),
        checkpoints=make_store(layout, name, incarnation),
        heartbeat_period_s=layout.spec.timing.heartbeat_period_s,
        renewed=partial(_take_place, layout, (name,)), failed=failed,
        is_here=partial(is_here, layout.plan.folder),
        members=frozenset((*layout.members, *layout.routers)), topics=layout.topics,
        command_age_s=layout.hosts.command_age_s))


def _bus_of(layout: Layout, name: str, bus: ZenohBus | None = None) -> ZenohBus:
    """Return the bus of an actor: the one given, under its name from now on, or one of its own."""
    plan = layout.plan
    recorder = RecorderConnection(plan.base_port)
    board = None if layout.hosts.several else board_of(plan.folder)
    if bus is not None:
        bus.take_name(name, recorder, board)
        return bus
    access = access_of(layout, plan.keys) if plan.keys and name in plan.routers else None
    return ZenohBus(name, *_ends(layout, name), recorder, access=access,
                    credentials=plan.credentials(name), board=board)


def _ends(layout: Layout, name: str) -> tuple[list[str], list[str]]:
    """Return what an actor's session dials, and where it listens, which a router's does."""
    folder, place = layout.plan.folder, layout.plan.routers.get(name)
    if place is None:
        return endpoints(folder), []
    number, protocol = ROUTERS.index(place), "tls" if layout.plan.keys else "tcp"
    own, hosts = endpoint(folder, place), layout.hosts
    beside = [one for one in endpoints(folder) if one != own]
    return [*beside, *hosts.dials(number, protocol)], [own, *hosts.listens(number, protocol)]


def make_store(layout: Layout, name: str, incarnation: int) -> CheckpointStore | None:
    """Return where a node of the system keeps its state; nothing is opened yet."""
    plan = layout.plan
    if not (plan.checkpoints and layout.spec.layers.checkpoints):
        return None
    return FileCheckpoints(Path(plan.checkpoints), name, plan.run_id,
                           plan.part * OF_A_PART + incarnation)


class Role(NamedTuple):
    """Which actors a process runs, and its incarnation."""

    names: tuple[str, ...]
    incarnation: int

    def __str__(self) -> str:
        return f"{'+'.join(self.names)} #{self.incarnation}"


async def live(layout: Layout, role: Role, run: RunContext, bus: ZenohBus | None = None) -> int:
    """Run the actors of one process to their end and return the exit code.

    Args:
        layout: of the run.
        role: who they are.
        run: what all actors of the run have in common.
        bus: open already, if there is one.
    """
    told: list[Exception] = []

    def tell(error: Exception) -> None:  # at once: what replaces this process may kill it
        told.append(error)
        complain(f"{role} failed: {type(error).__name__}: {error}")
        _log_traceback(layout.plan.error_log, str(role), error)

    try:
        _take_place(layout, *role)
        if any(node.kind is Kind.WORLD for node in layout.spec.nodes if node.name in role.names):
            go_first()
        signal.signal(signal.SIGUSR2, wedge)
        await _run_actors(layout, role, run, tell, bus)
    except BusError as error:
        if error not in told:
            complain(f"{'+'.join(role.names)}: {error}")
        return EXIT_BUS
    except Exception as error:  # the last stop before the exit code: nothing may pass unseen
        if error not in told:
            tell(error)
        return EXIT_FAILED
    return EXIT_OK


def _take_place(layout: Layout, names: tuple[str, ...], incarnation: int) -> None:
    """Have others know this process as that of its nodes."""
    set_title(layout.plan.base_port, layout.plan.launcher_pid, names, incarnation)
    issue(layout.plan.folder, names, incarnation, os.getpid())


async def _run_actors(layout: Layout, role: Role, run: RunContext,
                      failed: Callable[[Exception], None], bus: ZenohBus | None) -> None:
    loop = asyncio.get_running_loop()
    report_callbacks(loop, lambda line: complain(f"{role}: {line}"))
    buses = {name: _bus_of(layout, name, bus if name == role.names[0] else None)
             for name in role.names}
    actors = [make_actor(layout, name, role.incarnation, run, loop, failed=failed, bus=one)
              for name, one in buses.items()]

    def stop_all() -> None:
        for actor in actors:
            actor.stop()

    if layout.routers.keys().isdisjoint(role.names):
        loop.add_signal_handler(signal.SIGTERM, stop_all)
    tasks = [asyncio.create_task(actor.run()) for actor in actors]
    try:
        await asyncio.gather(*tasks)
    finally:  # one actor's failure ends the others of its process too
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def go_first() -> None:
    """Give this process, its threads to come included, the processor before others, if possible.

    The world is to be where it would be at this time, however busy the machine: a real one does
    not wait for a processor. It takes the privilege of lowering one's niceness.
    """
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, WORLD_NICE)


def wedge(_signal: int, _frame: Any) -> None:
    """Handle SIGUSR2: turn no more, and stay."""
    while True:
        time.sleep(3600)


def _log_traceback(file: str, who: str, failed: Exception) -> None:
    if not file:
        return
    try:
        with Path(file).open("a", encoding="utf-8") as log:
            log.write(f"--- {who} pid {os.getpid()}\n")
            traceback.print_exception(failed, file=log)
    except OSError as error:
        complain(f"cannot write {file}: {error}")
