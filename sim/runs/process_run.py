"""A mission on real processes: the launcher, and in this process the observer and the injector."""

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
from rampart.manager.spec.schema import SystemSpec
from rampart.sim.faults.injector import INJECTOR, Injector, can_be_hit
from rampart.sim.faults.process_signals import ProcessSignals
from rampart.sim.faults.scenario import PlannedFault
from rampart.sim.osmosis.report_record import RunRecord
from rampart.sim.runs.mission_run import MissionRun
from rampart.sim.runs.observer import Observer, Sink

_LOOK_S = 0.05
_STALL_S = 0.5


class ProcessRun:
    """One mission on processes. Use: `run`, once; `interrupt` ends it early.

    Args:
        launcher: Of the processes.
        spec: The system.
        mission: Judge, end and record.
        scenario: What goes wrong, and when.
    """

    def __init__(self, launcher: Launcher, spec: SystemSpec, mission: MissionRun,
                 scenario: Sequence[PlannedFault] = ()) -> None:
        self.launcher = launcher
        self.interrupted = ""
        self._spec = spec
        self._mission = mission
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
                if self._mission.console:
                    self._mission.console.trouble(f"at the end: {type(error).__name__}: {error}")

    async def _observe(self) -> RunRecord:
        launcher, mission = self.launcher, self._mission
        plan = launcher.plan
        clock = Clock(plan.origin_s, plan.rate)
        launcher.guard.on_restart = lambda name: mission.brought_back(name, clock.now())
        if console := mission.console:
            launcher.guard.report = lambda text: console.line(clock.now(), text)

        def to_launcher(_topic: Topic[Any], message: Any, _header: Header) -> None:
            if isinstance(message, NodeTable):
                launcher.supervisor_heard(message)

        bus = launcher.observers_bus()
        sinks: list[Sink] = [to_launcher, *mission.sinks(clock)]
        of_the_run: dict[str, Any] = {
            "register": register_of(plan.folder), "members": frozenset(launcher.names)}
        actors: list[Actor] = [Observer(Context(OBSERVER, 1, clock, bus, **of_the_run), sinks)]
        injector = None
        if self._scenario:
            injector = Injector(
                Context(INJECTOR, 1, clock, SharedBus(bus), **of_the_run), self._scenario,
                ProcessSignals(plan.base_port), can_be_hit(self._spec), system_topics(self._spec))
            actors.append(injector)
        tasks = [asyncio.create_task(actor.run()) for actor in actors]
        for task, actor in zip(tasks, actors, strict=True):
            watch(task, f"the launcher's {actor.name}", launcher.failed)
        if mission.console:
            mission.console.banner(
                mission.airport.name, mission.mission, plan, self._spec)
        try:
            why = None
            while why is None and not self.interrupted and not launcher.failure:
                looked_s = clock.now()
                await asyncio.sleep(_LOOK_S)
                stall_s = clock.now() - looked_s - _LOOK_S * plan.rate
                if stall_s > _STALL_S * plan.rate:  # ctrl-Z; what was sent meanwhile comes now
                    mission.excuse(stall_s)
                why = mission.over(clock.now())
            if launcher.failure:
                why = launcher.failure
                launcher.guard.report(why)
        finally:
            for actor in reversed(actors):
                actor.stop()
            await asyncio.gather(*tasks, return_exceptions=True)
            if mission.console:
                mission.console.close()
        return mission.conclude(clock.now(), self.interrupted or why or "ended",
                                injector.outcomes() if injector else ())
