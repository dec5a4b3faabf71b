"""A run on a further host: `launch.py --host NAME`, where NAME is not the first host.

It waits for the first host, runs the processes of this host, and ends with the run.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import socket
import sys
from pathlib import Path

import msgspec

from rampart.actors.bus.run_folder import register_of
from rampart.actors.ftm.messages import ProcessEvent
from rampart.actors.hosts.host_supervisor import HostObserver
from rampart.actors.hosts.launchers import OtherLauncher
from rampart.actors.hosts.meeting import MeetingError
from rampart.actors.runtime.actor import Context
from rampart.actors.runtime.clock import clock_of
from rampart.actors.runtime.run_plan import OBSERVER, RunPlan, on_host
from rampart.actors.supervision.unseen import watch
from rampart.cli.output import FORMAT, UsageError
from rampart.cli.run_options import ERROR_LOG, audited, refuse
from rampart.files.plain_text import one_line

_LEFT_TO_THE_FIRST = ("wait", "strategy", "shadow", "no_ftm", "rate", "seed", "patience",
                      "duration", "record", "overwrite", "virtual", "network", "fault")

EXIT_OVER, EXIT_FAILED = 0, 1


def plan_of_host(options: argparse.Namespace, plan: RunPlan, directory: Path) -> RunPlan:
    """Return the part of the plan that this host chooses.

    Args:
        options: options of the command line.
        plan: the plan that they make.
        directory: directory of checkpoints and tracebacks.

    Raises:
        UsageError: the first host chooses one of the given options.
    """
    why = f"on host {plan.host}, the command line of the first host decides this"
    refuse(options, _LEFT_TO_THE_FIRST, why)
    for name, value in plan.options.items():
        raise UsageError(f"--{name.replace('_', '-')} {value}: {why}")
    kept = directory.resolve()
    return msgspec.structs.replace(
        plan, error_log=str(kept / ERROR_LOG), checkpoints=str(kept / "checkpoints"),
        page=audited(plan.page, kept / f"audit-{plan.host}.jsonl"))


async def take_part(plan: RunPlan, link: socket.socket, *, as_json: bool) -> int:
    """Take part in a run until it is over, and return the exit code.

    Args:
        plan: as of `plan_of_host`.
        link: connection to the root.
        as_json: print the end as JSON.

    Raises:
        UsageError: the first host refuses this host.
        LaunchError: the processes of this host cannot be started.
    """
    launcher, task, why = OtherLauncher(plan, _say, link), asyncio.current_task(), ""
    assert task is not None  # noqa: S101 for the type checker

    def interrupt(_signal: str) -> None:
        launcher.on_interrupt = lambda _signal: None  # the end has begun
        task.cancel()

    launcher.on_interrupt = interrupt
    try:
        await launcher.connect()
        await launcher.join()
        await launcher.start()
        why = await _stay(launcher)
    except asyncio.CancelledError:
        task.uncancel()
    except MeetingError as error:
        raise UsageError(f"--host {plan.host}: {error}") from None
    finally:
        await launcher.end()
    _say(f"the run is over: {why or launcher.failure or 'interrupted'}")
    if as_json:
        print(json.dumps({"format": FORMAT, "host": plan.host, "over": why}), flush=True)
    return EXIT_OVER if why else EXIT_FAILED


async def _stay(launcher: OtherLauncher) -> str:
    """Show what happens to the processes of this host until the run is over; return why it is."""
    plan = launcher.plan
    clock = clock_of(plan)

    def event(event: ProcessEvent, stamp_s: float) -> None:
        if event.event not in {"started", "running"}:
            _say(f"{stamp_s:8.2f} s  {event.node} {event.event} "
                 f"{one_line(event.detail)}".rstrip())

    launcher.report = _say
    launcher.on_restart = lambda name: _say(f"{clock.now():8.2f} s  {name} restarted")
    name = on_host(OBSERVER, plan.host)
    observer = HostObserver(Context(
        name, 1, clock, launcher.observers_bus(), {"supervisor": plan.supervisor},
        register=register_of(plan.folder), members=frozenset(launcher.names)),
        event)
    task = asyncio.create_task(observer.run())
    watch(task, f"the launcher's {name}", launcher.failed)
    _say(f"host {plan.host} takes part in run {plan.run_id}; ctrl-C ends it here")
    try:
        return await launcher.stay()
    finally:
        observer.stop()
        with contextlib.suppress(Exception):
            await task


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
