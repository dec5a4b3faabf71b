"""A run of Osmosis: a mission on an airport, judged by ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TextIO

import msgspec

from rampart.actors.bus.topic import Topic
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.run.run_context import RunContext
from rampart.actors.runtime.actor import Header
from rampart.actors.runtime.clock import Clock
from rampart.manager.spec.schema import SystemSpec
from rampart.sim.osmosis.clearance import EXACT_BELOW_M
from rampart.sim.osmosis.trial.console import MissionConsole
from rampart.sim.osmosis.trial.injector import OsmosisInjector
from rampart.sim.osmosis.trial.record import MissionRecord, MissionRecorder
from rampart.sim.osmosis.trial.report import render
from rampart.sim.osmosis.trial.run_end import RunEnd
from rampart.sim.runs.judge import Verdict
from rampart.sim.runs.observer import Sink
from rampart.sim.runs.record import RunRecord
from rampart.sim.runs.report import Written, try_report
from rampart.sim.runs.trial import Trial

_PATIENCE_S = 60.0


class MissionTrial(Trial):
    """One mission on one airport; it is over when nothing progresses for `limit_s`."""

    recorder: MissionRecorder
    judges = True
    patient = True
    injector = OsmosisInjector
    tells = MissionConsole
    retunings = {"mechanisms as in the paper": {"RM2": {"latched": True}, "RM5": {"latched": True}}}
    margins = {"obstacle_m": "nearest obstacle", "prohibited_m": "nearest prohibited area"}
    exact_below = EXACT_BELOW_M
    pictures = "rampart.sim.osmosis.trial.run_maps:RunMaps"

    def __init__(self, run: RunContext, limit_s: float | None = None,
                 stream: TextIO | None = None) -> None:
        super().__init__(run, limit_s, stream)
        known = Osmosis.of_run(run)
        self.name = known.mission.name
        self.goals = len(known.mission.goals)
        self.title = f"{self.name} on {known.airport.name}"
        self.about = f"mission {self.name} ({self.goals} goals) on {known.airport.name}"
        self._end = RunEnd(_PATIENCE_S if limit_s is None else limit_s, run.plan.waits)
        self.recorder = MissionRecorder(run.plan, self.strategy, known.airport, known.mission)

    def sinks(self, clock: Clock) -> list[Sink]:
        """Return what wants to hear the run's messages."""

        def to_end(_topic: Topic[Any], message: Any, _header: Header) -> None:
            self._end.take(message, clock.now())

        return [to_end, *super().sinks(clock)]

    def excuse(self, stall_s: float) -> None:
        """Do not count simulated seconds in which the launcher heard nothing, being stopped."""
        self._end.excuse(stall_s)

    def over(self, now_s: float) -> str | None:
        """Return why the run is over, or None while it goes on."""
        return self._end.ended(now_s)

    def conclude(self, now_s: float, why: str) -> RunRecord:
        """Return the record of the run with the judge's verdict, and what became of faults."""
        return self.concluded(self.recorder.judge.verdict(), now_s, why)

    def summary(self, record: RunRecord) -> dict[str, Any]:
        """Return what scripts rely on, the lights too."""
        return {**super().summary(record),
                "lights": [msgspec.to_builtins(light) for light in _mission(record).lights]}

    def judgement(self, record: RunRecord) -> Verdict:
        """Return what ground truth shows: clearances, and when it became unsafe."""
        found = _mission(record)
        return Verdict(
            success=found.mission == "success", safe=found.safety == "safe", reasons=found.reasons,
            margins={"obstacle_m": _metres(found.obstacle_clearance_m),
                     "prohibited_m": _metres(found.prohibited_clearance_m)},
            severity=_severity(found.prohibited_s, found.collisions),
            unsafe_s=self.recorder.judge.first_unsafe_s, narrowest_s=found.narrowest_s)

    @classmethod
    def moments(cls, spec: SystemSpec, *, searched: bool = False) -> tuple[float, float]:
        """Return moments within every mission of the shipped airport; a search goes further."""
        del spec
        return 2.0, 150.0 if searched else 120.0

    @classmethod
    def upgraded(cls, result: dict[str, Any]) -> dict[str, Any]:
        """Return a result with its clearances as margins, collisions and trespass as severity."""
        margins = {name: result.pop(name) for name in cls.margins}
        severity = _severity(result.pop("prohibited_s"), result.pop("collisions"))
        return {**result, "margins": margins, "severity": severity}

    def report(self, record: RunRecord, directory: Path) -> Written:
        """Write as much of the inspection report as can be written."""
        return try_report(record, render, directory)


def _mission(record: RunRecord) -> MissionRecord:
    if not isinstance(record, MissionRecord):
        raise TypeError(f"{type(record).__name__}: no record of a mission")
    return record


def _severity(prohibited_s: float, collisions: int) -> float:
    return round(prohibited_s, 3) + collisions


def _metres(value: float | None) -> float | None:
    return None if value is None else round(value, 4)
