"""A run on real processes; this process has the observer and the injector."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from rampart.actors.access.register import KeysError
from rampart.actors.bus.bus import shared
from rampart.actors.bus.run_folder import register_of
from rampart.actors.runtime.actor import Context
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.run_plan import OBSERVER
from rampart.actors.supervision.kill_node import SignalError, signal_node
from rampart.actors.supervision.launcher import Launcher
from rampart.actors.supervision.unseen import watch
from rampart.actors.web.access import ANY
from rampart.sim.faults.injector import SIGNALS, can_be_hit
from rampart.sim.faults.scenario import PlannedFault
from rampart.sim.runs.record import RunRecord
from rampart.sim.runs.trial import Trial

_LOOK_S = 0.05
_STALL_S = 0.5

_KEEP_S = 1.0
"""Longest wall time between two saved copies of the record."""

_PAGE_S = 20.0
"""Wall seconds to wait for the operator's page."""

_KEYS_S = 5.0
"""Wall seconds between two checks of the certificates."""

_RELINK_S = 1.0
"""Wall seconds until a process that was stopped is linked to a router again."""


def hit(port: int, what: str, node: str, _pace_s: float) -> bool:
    """Signal the newest process of a node, as a `ProcessControl`."""
    try:
        signal_node(node, SIGNALS[what], port)
    except (SignalError, KeyError):
        return False
    return True


def excused_s(late_s: float) -> float:
    """Return the wall seconds for which missing messages do not count.

    Args:
        late_s: Lateness of this process. More than a loaded machine explains means that it was
            stopped. Then messages arrive now, or after it has joined a router again.
    """
    return late_s + _RELINK_S if late_s > _STALL_S else 0.0


class ProcessRun:
    """One run on processes. Use: `run`, once.

    Args:
        trial: The trial to run.
        link: Connection to the run's root.
        scenario: Faults and their times.
        keep: Saves a copy of the record for a resumed run; called in a thread. None saves nothing.

    Attributes:
        interrupted: Setting it ends the run for this reason.
        failure: Why the run could not continue; "" if it could.
        unrecorded: Why the recording ended early; "" if it did not.
        keep_alive: Called some 20 times a second.
    """

    def __init__(self, trial: Trial, link: socket.socket, scenario: Sequence[PlannedFault] = (),
                 keep: Callable[[bytes], None] | None = None) -> None:
        if trial.run.system.hosts:
            from rampart.actors.hosts.launchers import FirstLauncher  # noqa: PLC0415 few have

            self.launcher: Launcher = FirstLauncher(
                trial.run, trial.title, link, lambda: bool(self.interrupted),
                trial.console.say if trial.console else lambda _line: None)
        else:
            self.launcher = Launcher(trial.run.plan, trial.title, link)
        self.launcher.on_interrupt = self.interrupt
        self.interrupted = ""
        self.failure = ""
        self.unrecorded = ""
        self.keep_alive: Callable[[], None] = lambda: None
        self._trial = trial
        self._scenario = tuple(scenario)
        self._keep = keep
        self._kept_marks, self._keep_at_s = -1, 0.0

    def interrupt(self, by: str) -> None:
        """End the run because of a signal of the user."""
        self.interrupted = f"interrupted by {by}"

    async def run(self) -> RunRecord:
        """Start everything, run to the end, and return the record.

        Raises:
            LaunchError: The system cannot be started.
        """
        try:
            await self.launcher.load()
            await self.launcher.start()
            return await self._observe()
        finally:
            try:
                await self.launcher.end()
            except Exception as error:  # the verdict stands; the lifeline ends all processes
                if self._trial.console:
                    self._trial.console.say(f"at the end: {type(error).__name__}: {error}")

    async def _observe(self) -> RunRecord:
        launcher, trial = self.launcher, self._trial
        spec, plan = trial.run.system, launcher.plan
        clock = Clock(plan.origin_s, plan.rate)
        launcher.on_restart = lambda name: trial.brought_back(name, clock.now())
        if console := trial.console:
            launcher.report = lambda text: console.line(clock.now(), text)

        bus = launcher.observers_bus()

        def context(name: str) -> Context:
            return Context(
                name, 1, clock, bus if name == OBSERVER else shared(bus),
                run=trial.run, register=register_of(plan.folder),
                members=frozenset(launcher.names))

        actors = trial.outside(context, lambda _table: None, self._scenario,
                               partial(hit, plan.base_port), can_be_hit(spec))
        tasks = [asyncio.create_task(actor.run()) for actor in actors]
        for task, actor in zip(tasks, actors, strict=True):
            watch(task, f"the launcher's {actor.name}", launcher.failed)
        if console:
            console.banner(trial.about, plan, spec)
            tasks.append(asyncio.create_task(self._announce_page(console.say)))
        if plan.keys:
            tasks.append(asyncio.create_task(self._watch_keys()))
        try:
            why = None
            while why is None and not self.interrupted and not launcher.failure:
                looked_s = clock.now()
                await asyncio.sleep(_LOOK_S)
                if wall_s := excused_s((clock.now() - looked_s) / plan.rate - _LOOK_S):
                    trial.excuse(wall_s * plan.rate)
                recording, problem = launcher.look_at_recording()
                if problem and not self.unrecorded:
                    self.unrecorded = problem
                    actors[0].report_diagnostic("recording", problem, recording)
                    trial.not_recorded(problem, clock.now())
                self.keep_alive()
                await self._keep_memory(clock.now())
                why = trial.ended(clock.now())
            if launcher.failure:  # before its observer ends
                why = self.failure = launcher.failure
                launcher.report(why)
        finally:
            for actor in reversed(actors):
                actor.stop()
            for task in tasks[len(actors):]:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            if trial.console:
                trial.console.close()
        return trial.conclude(clock.now(), self.interrupted or why or "ended")

    async def _keep_memory(self, now_s: float) -> None:
        """Save a copy of the record for a resumed run, if that is due."""
        marks, wall_s = self._trial.recorder.marks(), time.monotonic()
        if self._keep is None or (marks == self._kept_marks and wall_s < self._keep_at_s):
            return
        self._kept_marks, self._keep_at_s = marks, wall_s + _KEEP_S
        try:
            await asyncio.to_thread(self._keep, self._trial.memory(now_s))
        except (OSError, RuntimeError) as error:  # no disk, no thread
            self._keep = None
            self.launcher.report(f"the run cannot be resumed any more: {error}")

    async def _announce_page(self, say: Callable[[str], None]) -> None:
        """Print the address of the operator's page as soon as it answers."""
        page = self.launcher.plan.page
        if not page.port:
            return
        host = "127.0.0.1" if page.host in ANY else page.host
        for _ in range(round(_PAGE_S / _LOOK_S)):
            with contextlib.suppress(OSError):
                _, writer = await asyncio.open_connection(host, page.port)
                writer.close()
                say(f"Operator's page: {page.invitation}")
                return
            await asyncio.sleep(_LOOK_S)
        say(f"Operator's page: no answer at {page.url} for {_PAGE_S:g} s")

    async def _watch_keys(self) -> None:
        """Report each certificate that expires, because its process would only seem to hang."""
        from rampart.actors.access import key_folder  # noqa: PLC0415 of the extra

        plan, reported = self.launcher.plan, set[str]()
        names = [*plan.routers, *self.launcher.names]
        while True:
            try:
                found = await asyncio.to_thread(key_folder.expired, Path(plan.keys), names)
            except (KeysError, OSError) as error:
                found = {plan.keys: str(error)}
            for name in found.keys() - reported:
                self.launcher.report(found[name])
            reported = set(found)
            await asyncio.sleep(_KEYS_S)
