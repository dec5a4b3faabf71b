"""A run of a system without a mission: no world, no judge, but an end.

For systems that are being specified, and for those whose world is not simulated here.
"""

from __future__ import annotations

import asyncio
from collections import deque
from typing import Any, TextIO

import msgspec

from rampart.actors.bus.bounds import MANY
from rampart.actors.bus.limits import Remembered
from rampart.actors.bus.run_folder import register_of
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import DecisionRecord, NodeTable, ProcessEvent
from rampart.actors.run.run_plan import OBSERVER, RunPlan
from rampart.actors.runtime.actor import Context, Header
from rampart.actors.runtime.clock import Clock
from rampart.actors.supervision.launcher import Launcher
from rampart.actors.supervision.unseen import watch
from rampart.manager.spec.schema import SystemSpec
from rampart.sim.runs.console import Console
from rampart.sim.runs.observer import Observer

KEPT_DECISIONS = 10_000
"""The last so many decisions of a run are kept."""


class WatchedRun:
    """One run. Use: `run`, and `summary` afterwards.

    Args:
        plan: What to run.
        spec: The system.
        duration_s: Simulated seconds after which it ends; None for when it is interrupted.
        stream: For the story.
    """

    def __init__(self, plan: RunPlan, spec: SystemSpec, duration_s: float | None,
                 stream: TextIO) -> None:
        self.launcher = Launcher(plan, spec.title)
        self.interrupted = ""
        self.failure = ""
        self._spec = spec
        self._duration_s = duration_s
        self._console = Console(stream)
        self._decisions: deque[DecisionRecord] = deque(maxlen=KEPT_DECISIONS)
        self._restarts: Remembered[str, int] = Remembered(MANY)
        self._lasted_s = 0.0

    async def run(self) -> None:
        """Start everything, and watch until the end.

        Raises:
            LaunchError: The system cannot be started.
        """
        self.launcher.begin()
        try:
            await self.launcher.load()
            await self.launcher.start()
            await self._watch()
        finally:
            await self.launcher.end()

    def summary(self) -> dict[str, Any]:
        """Return the result for scripts: there is no mission, and nobody to judge safety."""
        return {
            "mission": None, "safety": None, "duration_s": round(self._lasted_s, 2), "lights": [],
            "decisions": [msgspec.to_builtins(d) for d in self._decisions],
            "restarts": self._restarts}

    async def _watch(self) -> None:
        plan = self.launcher.plan
        clock = Clock(plan.origin_s, plan.rate)
        self.launcher.guard.on_restart = lambda name: self._console.line(
            clock.now(), f"{name} brought back")
        self.launcher.guard.report = lambda text: self._console.line(clock.now(), text)
        observer = Observer(Context(
            OBSERVER, 1, clock, self.launcher.observers_bus(), register=register_of(plan.folder),
            members=frozenset(self.launcher.names)), [self._take, self._console.take])
        task = asyncio.create_task(observer.run())
        watch(task, "the launcher's observer", self.launcher.failed)
        self._console.line(clock.now(), f"{self._spec.title} ({self._spec.name}), "
                           f"{self._spec.strategy}, rate {plan.rate:g}; ctrl-C ends it")
        if plan.hmi_port:
            self._console.line(clock.now(), f"operator's page: {plan.hmi_page_to_open}")
        try:
            while not (self.interrupted or self.launcher.failure  # noqa: ASYNC110 three ends
                       or self._is_over(clock.now())):
                await asyncio.sleep(0.05)
            self.failure = self.launcher.failure  # before its observer is told to end
            if self.failure:
                self._console.line(clock.now(), self.failure)
        finally:
            self._lasted_s = clock.now()
            observer.stop()
            await asyncio.gather(task, return_exceptions=True)
            self._console.close()

    def _is_over(self, now_s: float) -> bool:
        return self._duration_s is not None and now_s >= self._duration_s

    def _take(self, topic: Topic[Any], message: Any, _header: Header) -> None:
        if isinstance(message, NodeTable):
            self.launcher.supervisor_heard(message)
        elif topic is topics.DECISION:
            self._decisions.append(message)
        elif isinstance(message, ProcessEvent) and message.event == "respawned" \
                and message.detail != "already":
            self._restarts[message.node] = self._restarts.get(message.node, 0) + 1
