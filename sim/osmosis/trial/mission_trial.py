"""What makes a run a mission: judge, end, record and console, whether it is real or virtual.

Whoever runs the robot makes a `MissionRun`, gives its sinks to the observer, asks it now and then
whether the run is over, and has it conclude.
"""

from __future__ import annotations

from typing import Any

import msgspec

from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import ProcessEvent
from rampart.actors.osmosis.airport.model import Airport, Mission
from rampart.actors.osmosis.messages import ControlStatus, GroundTruth, MissionStatus
from rampart.actors.run.run_plan import RunPlan
from rampart.actors.runtime.actor import Header
from rampart.actors.runtime.clock import Clock
from rampart.sim.faults.scenario import FaultOutcome
from rampart.sim.osmosis.trial.injector import OsmosisInjector
from rampart.sim.osmosis.trial.judge import Judge, Verdict
from rampart.sim.osmosis.trial.record import RunRecord, RunRecorder, Safety
from rampart.sim.osmosis.trial.run_end import RunEnd
from rampart.sim.runs.console import Console
from rampart.sim.runs.observer import JudgeSink, Sink

LAUNCHER = "launch.py"

_SAFETY: dict[bool | None, Safety] = {True: "safe", False: "unsafe", None: "not known"}


class MissionRun:
    """One mission on one airport.

    Args:
        plan: What is run.
        airport: Where.
        mission: What is to be done.
        strategy: Of the manager, empty without FTMs.
        patience_s: Simulated seconds without progress after which it is over.
        console: For the story; None keeps quiet.
    """

    injector = OsmosisInjector

    def __init__(self, plan: RunPlan, airport: Airport, mission: Mission, *, strategy: str,
                 patience_s: float, console: Console | None = None) -> None:
        self.plan = plan
        self.airport = airport
        self.mission = mission
        self.judge = Judge(mission.goals)
        self.console = console
        self.strategy = strategy if plan.ftm else ""
        self._end = RunEnd(patience_s, plan.waits)
        self._recorder = RunRecorder(
            plan.run_id, airport, mission, seed=plan.seed, rate=plan.rate, strategy=self.strategy)
        self._brought_back = 0

    def sinks(self, clock: Clock) -> list[Sink]:
        """Return what wants to hear the run's messages."""

        def to_end(_topic: Topic[Any], message: Any, _header: Header) -> None:
            if isinstance(message, MissionStatus):
                self._end.mission(message, clock.now())
            elif isinstance(message, ControlStatus):
                self._end.control(message, clock.now())
            elif isinstance(message, GroundTruth):
                self._end.truth(message.twist, clock.now())

        sinks: list[Sink] = [to_end, JudgeSink(self.judge), self._recorder.feed]
        return [*sinks, self.console.take] if self.console else sinks

    def brought_back(self, name: str, now_s: float) -> None:
        """Note that the launcher has brought somebody back."""
        self._brought_back += 1
        if self.console:
            self.console.line(now_s, f"{name} brought back")
        self._recorder.feed(
            topics.PROCESS_EVENT,
            ProcessEvent(name, "respawned", 0, self._brought_back, LAUNCHER, ""),
            Header(LAUNCHER, 1, self._brought_back, now_s))

    def excuse(self, stall_s: float) -> None:
        """Do not count simulated seconds in which the launcher heard nothing, being stopped."""
        self._end.excuse(stall_s)

    def over(self, now_s: float) -> str | None:
        """Return why the run is over, or None while it goes on."""
        return self._end.ended(now_s)

    def conclude(self, now_s: float, why: str, faults: tuple[FaultOutcome, ...] = ()
                 ) -> RunRecord:
        """Return the record of the run with the judge's verdict, and what became of faults."""
        verdict = self.verdict()
        reasons = () if verdict.success and verdict.safe else (*verdict.reasons, f"ended: {why}")
        record = self._recorder.record(
            "success" if verdict.success else "fail", _SAFETY[verdict.safe],
            reasons, now_s)
        return msgspec.structs.replace(record, faults=faults)

    def verdict(self) -> Verdict:
        """Return the judge's verdict on what was seen so far."""
        return self.judge.verdict()


def summary(record: RunRecord, /, **more: str | None) -> dict[str, Any]:
    """Return what scripts rely on: the last line of stdout with --json."""
    return {
        "mission": record.mission, "safety": record.safety, "reasons": list(record.reasons),
        "duration_s": round(record.duration_s, 2),
        "lights": [msgspec.to_builtins(light) for light in record.lights],
        "decisions": [msgspec.to_builtins(decision) for decision in record.decisions],
        "restarts": record.restarts,
        "faults": [{**msgspec.to_builtins(fault), "effective": fault.effective}
                   for fault in record.faults],
        **more,
    }
