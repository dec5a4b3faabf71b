"""A run on real processes: the launcher, and in this process the observer and the injector."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from typing import Any

from rampart.actors.bus.run_folder import register_of
from rampart.actors.bus.shared_bus import SharedBus
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm.messages import NodeTable
from rampart.actors.layout.system_topics import system_topics
from rampart.actors.run.run_plan import OBSERVER
from rampart.actors.runtime.actor import Actor, Context, Header
from rampart.actors.runtime.clock import Clock
from rampart.actors.supervision.launcher import Launcher
from rampart.actors.supervision.unseen import watch
from rampart.sim.faults.faults import faults_of
from rampart.sim.faults.injector import INJECTOR, can_be_hit
from rampart.sim.faults.process_signals import ProcessSignals
from rampart.sim.faults.scenario import PlannedFault
from rampart.sim.runs.observer import Sink, observer_class
from rampart.sim.runs.record import RunRecord
from rampart.sim.runs.trial import Trial

_LOOK_S = 0.05
_STALL_S = 0.5

_RELINK_S = 4.0
"""Wall seconds in which a launcher that was stopped has its links again: those that it has lost are
dialled after one second, and after two more."""


def excused_s(late_s: float) -> float:
    """Return how long nothing that was not heard counts, wall seconds.

    Args:
        late_s: how much too late the launcher looked again. It was stopped (ctrl-Z) if that is
            more than a loaded machine does; then what was sent meanwhile comes now, or after its
            links have been dialled again.
    """
    return late_s + _RELINK_S if late_s > _STALL_S else 0.0


class ProcessRun:
    """One run on processes. Use: `run`, once.

    Args:
        trial: What is run.
        scenario: What goes wrong, and when.

    Attributes:
        interrupted: Whoever sets it ends the run for this reason.
        failure: Why it could not go on; "" if it could.
    """

    def __init__(self, trial: Trial, scenario: Sequence[PlannedFault] = ()) -> None:
        self.launcher = Launcher(trial.run.plan, trial.title)
        self.interrupted = ""
        self.failure = ""
        self._trial = trial
        self._scenario = tuple(scenario)

    async def run(self) -> RunRecord:
        """Start everything, run to the end, and return the record.

        Raises:
            LaunchError: The system cannot be started.
        """
        self.launcher.begin()
        try:
            await self.launcher.load()
            await self.launcher.start()
            return await self._observe()
        finally:
            try:
                await self.launcher.end()
            except Exception as error:  # the verdict stands; the lifeline ends who is left
                if self._trial.console:
                    self._trial.console.say(f"at the end: {type(error).__name__}: {error}")

    async def _observe(self) -> RunRecord:
        launcher, trial, spec = self.launcher, self._trial, self._trial.run.system
        plan = launcher.plan
        clock = Clock(plan.origin_s, plan.rate)
        launcher.guard.on_restart = lambda name: trial.brought_back(name, clock.now())
        if console := trial.console:
            launcher.guard.report = lambda text: console.line(clock.now(), text)

        def to_launcher(_topic: Topic[Any], message: Any, _header: Header) -> None:
            if isinstance(message, NodeTable):
                launcher.supervisor_heard(message)

        bus = launcher.observers_bus()
        sinks: list[Sink] = [to_launcher, *trial.sinks(clock)]
        of_the_run: dict[str, Any] = {
            "register": register_of(plan.folder), "members": frozenset(launcher.names)}
        actors: list[Actor] = [
            observer_class(spec)(Context(OBSERVER, 1, clock, bus, **of_the_run), sinks)]
        injector = None
        if self._scenario:
            injector = trial.injector(
                Context(INJECTOR, 1, clock, SharedBus(bus), **of_the_run), self._scenario,
                ProcessSignals(plan.base_port), nodes=can_be_hit(spec),
                known=system_topics(spec), faults=faults_of(spec))
            actors.append(injector)
        tasks = [asyncio.create_task(actor.run()) for actor in actors]
        for task, actor in zip(tasks, actors, strict=True):
            watch(task, f"the launcher's {actor.name}", launcher.failed)
        if trial.console:
            trial.console.banner(trial.about, plan, spec)
        try:
            why = None
            while why is None and not self.interrupted and not launcher.failure:
                looked_s = clock.now()
                await asyncio.sleep(_LOOK_S)
                if wall_s := excused_s((clock.now() - looked_s) / plan.rate - _LOOK_S):
                    trial.excuse(wall_s * plan.rate)
                why = trial.over(clock.now())
            if launcher.failure:  # before its observer is told to end
                why = self.failure = launcher.failure
                launcher.guard.report(why)
        finally:
            for actor in reversed(actors):
                actor.stop()
            await asyncio.gather(*tasks, return_exceptions=True)
            if trial.console:
                trial.console.close()
        return trial.conclude(clock.now(), self.interrupted or why or "ended",
                                injector.outcomes() if injector else ())
