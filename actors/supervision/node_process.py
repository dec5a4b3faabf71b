"""The process of a node after the fork: title, signals, actors, exit code.

SIGTERM ends the actors in order, and a router at once (see `router`). SIGUSR2 hangs the event loop
permanently, while process and session stay: only a missing heartbeat shows this fault.
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
from rampart.actors.bus.bus import BusError
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
"""More than the incarnations of a node in one part of a run. The numbers of the next part, in a
resumed run, begin above it, so its states are newer."""

EXIT_OK = 0
EXIT_FAILED = 1


def make_actor(layout: Layout, name: str, incarnation: int, run: RunContext,
               loop: asyncio.AbstractEventLoop, *,
               failed: Callable[[Exception], None] = lambda _error: None,
               bus: ZenohBus | None = None) -> Actor:
    """Build one actor of the system; it does not run yet.

    Args:
        layout: Of the run.
        name: Of the actor.
        incarnation: Of its process.
        run: The context that all actors of the run share.
        loop: The event loop that it will run on.
        failed: Called with its error.
        bus: An open bus, which takes its name; None for a new one.
    """
    member = layout.members.get(name) or router(name)
    return member.actor(Context(
        name, incarnation, clock_of(layout.plan, loop.time), _bus_of(layout, name, bus),
        member.parameters, run,
        register=register_of(layout.plan.folder),
        checkpoints=make_store(layout, name, incarnation),
        heartbeat_period_s=layout.spec.timing.heartbeat_period_s,
        renewed=partial(_take_place, layout, (name,)), failed=failed,
        is_here=partial(is_here, layout.plan.folder),
        members=frozenset((*layout.members, *layout.routers)), topics=layout.topics,
        publishers=layout.publishers,
        command_age_s=layout.hosts.command_age_s))


def _bus_of(layout: Layout, name: str, bus: ZenohBus | None) -> ZenohBus:
    """Return the bus of an actor: the given one, which takes its name, or a new one."""
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
    """Return the endpoints that an actor's session dials, and those where a router listens."""
    folder, place = layout.plan.folder, layout.plan.routers.get(name)
    if place is None:
        return endpoints(folder), []
    number, protocol = ROUTERS.index(place), "tls" if layout.plan.keys else "tcp"
    own, hosts = endpoint(folder, place), layout.hosts
    beside = [one for one in endpoints(folder) if one != own]
    return [*beside, *hosts.dials(number, protocol)], [own, *hosts.listens(number, protocol)]


def make_store(layout: Layout, name: str, incarnation: int) -> CheckpointStore | None:
    """Return the checkpoint store of a node; None if it keeps no state."""
    plan = layout.plan
    if not (plan.checkpoints and layout.spec.layers.checkpoints):
        return None
    return FileCheckpoints(Path(plan.checkpoints), name, plan.run_id,
                           plan.part * OF_A_PART + incarnation)


class Role(NamedTuple):
    """The actors of a process, and its incarnation."""

    names: tuple[str, ...]
    incarnation: int

    def __str__(self) -> str:
        return f"{'+'.join(self.names)} #{self.incarnation}"


async def live(layout: Layout, role: Role, run: RunContext, bus: ZenohBus | None = None) -> int:
    """Run the actors of one process to their end and return the exit code.

    Args:
        layout: Of the run.
        role: The actors.
        run: The context that all actors of the run share.
        bus: An open bus for the first actor, if there is one.
    """
    reported: list[Exception] = []

    def report(error: Exception) -> None:  # at once: the supervisor may kill this process
        reported.append(error)
        complain(f"{role} failed: {type(error).__name__}: {error}")
        _log_traceback(layout.plan.error_log, str(role), error)

    try:
        _take_place(layout, *role)
        if any(node.kind is Kind.WORLD for node in layout.spec.nodes if node.name in role.names):
            go_first()
        signal.signal(signal.SIGUSR2, wedge)
        await _run_actors(layout, role, run, report, bus)
    except BusError as error:
        if error not in reported:
            complain(f"{'+'.join(role.names)}: {error}")
        return EXIT_FAILED
    except Exception as error:  # the last handler before the exit: every error is reported
        if error not in reported:
            report(error)
        return EXIT_FAILED
    return EXIT_OK


def _take_place(layout: Layout, names: tuple[str, ...], incarnation: int) -> None:
    """Make this process known as that of its nodes."""
    set_title(layout.plan.base_port, layout.plan.launcher_pid, names, incarnation)
    issue(layout.plan.folder, names, incarnation, os.getpid())


async def _run_actors(layout: Layout, role: Role, run: RunContext,
                      failed: Callable[[Exception], None], bus: ZenohBus | None) -> None:
    loop = asyncio.get_running_loop()
    report_callbacks(loop, lambda line: complain(f"{role}: {line}"))
    buses = (bus, *(None for _ in role.names[1:]))
    actors = [make_actor(layout, name, role.incarnation, run, loop, failed=failed, bus=each)
              for name, each in zip(role.names, buses, strict=True)]

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
    """Raise the priority of this process and its later threads, if that is permitted.

    A real world does not wait for a processor, so a busy machine should not slow the simulated one.
    """
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, WORLD_NICE)


def wedge(_signal: int, _frame: Any) -> None:
    """Handle SIGUSR2: hang permanently."""
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
