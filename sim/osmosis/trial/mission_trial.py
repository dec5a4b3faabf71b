"""A run of Osmosis: a mission on an airport, judged by ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TextIO

import msgspec

from rampart.actors.bus.bounds import MOST
from rampart.actors.bus.limits import Remembered
from rampart.actors.bus.topic import Topic
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.runtime.actor import Header
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.run_context import RunContext
from rampart.manager.spec.schema import SystemSpec
from rampart.sim.osmosis.trial.injector import OsmosisInjector
from rampart.sim.osmosis.trial.record import MissionRecord, MissionRecorder
from rampart.sim.osmosis.trial.report import headline, render
from rampart.sim.osmosis.trial.run_end import RunEnd
from rampart.sim.osmosis.world import EXACT_BELOW_M
from rampart.sim.runs.console import Console
from rampart.sim.runs.judge import Verdict
from rampart.sim.runs.observer import Sink
from rampart.sim.runs.record import RunRecord
from rampart.sim.runs.report import Written, try_report
from rampart.sim.runs.trial import Trial

_PATIENCE_S = 60.0


class MissionConsole(Console):
    """Prints the events of a mission."""

    example = "osmosis_control"

    def __init__(self, stream: TextIO, *more: Any) -> None:
        super().__init__(stream, *more)
        self._step = -1
        self._phase: m.MissionPhase | None = None
        self._lights: dict[str, m.LightVerdict] = Remembered(MOST)
        self._mission: m.MissionStatus | None = None
        self._pilot = ""
        self._unsafe = (0, False)

    def take(self, topic: Topic[Any], message: Any, header: Header) -> None:
        """Take one message of the run."""
        super().take(topic, message, header)
        if isinstance(message, m.MissionStatus):
            self._take_mission(message, header.stamp)
        elif isinstance(message, m.PilotStatus):
            self._pilot = message.reason if message.stopped else ""
        elif isinstance(message, m.GroundTruth):
            self._show(message, header.stamp)

    def verdict(self, record: RunRecord) -> list[str]:
        """Return the lines of the verdict."""
        if isinstance(record, MissionRecord):
            return [f"Mission {record.mission_name}: {record.mission}, {record.safety}, "
                    f"{record.duration_s:.1f} s simulated, {record.distance_m:.0f} m driven.",
                    headline(record)]
        return super().verdict(record)

    def _take_mission(self, status: m.MissionStatus, at: float) -> None:
        self._mission = status
        if status.phase is not self._phase:
            self._phase = status.phase
            reason = f": {status.reason}" if status.reason else ""
            self.line(at, f"mission {status.name or '-'} {status.phase.value}{reason}")
        if status.phase is m.MissionPhase.RUNNING and status.step != self._step:
            self._step = status.step
            if status.step < len(status.goals):
                goal = status.goals[status.step]
                self.line(at, f"goal {status.step + 1}/{len(status.goals)}: ({goal.x_m:g}, "
                          f"{goal.y_m:g}), {goal.mode.value}")
        for light in status.lights:
            if light.light not in self._lights:
                self._lights[light.light] = light.verdict
                if light.verdict is not m.LightVerdict.OK:
                    self.line(at, f"light {light.light} is {light.verdict.value} "
                              f"({light.ratio:.0%} of nominal)")

    def _show(self, truth: m.GroundTruth, at: float) -> None:
        unsafe = (truth.collisions, truth.prohibited_s > 0)
        if unsafe != self._unsafe:
            self._unsafe = unsafe
            self.say(f"[{at:7.2f} s] UNSAFE: " + ("in the prohibited area" if unsafe[1] else "")
                     + (f" {unsafe[0]} collisions" if unsafe[0] else ""))
        mission = self._mission
        step = f"goal {mission.step + 1}/{len(mission.goals)}" if mission and mission.goals \
            else "no mission"
        self.show_live(
            f"{at:7.1f} s  {step}  ({truth.pose.x_m:6.1f}, {truth.pose.y_m:6.1f})  "
            f"{truth.twist.linear_mps:4.2f} m/s  {len(self._lights)} lights  {self._pilot}", at)


class MissionTrial(Trial):
    """A mission on an airport; it ends without progress for `limit_s`."""

    recorder: MissionRecorder
    judges = True
    patient = True
    injector = OsmosisInjector
    tells = MissionConsole
    retunings = {"mechanisms as in the paper": {"RM2": {"latched": True}, "RM5": {"latched": True}}}
    margins = {"obstacle_m": "nearest obstacle", "prohibited_m": "nearest prohibited area"}
    exact_below = EXACT_BELOW_M
    pictures = "rampart.sim.osmosis.trial.report:RunMaps"

    def __init__(self, run: RunContext, limit_s: float | None = None,
                 stream: TextIO | None = None) -> None:
        super().__init__(run, limit_s, stream)
        known = Osmosis.of_run(run)
        self.name = known.mission.name
        self.goals = len(known.mission.goals)
        self.title = f"{self.name} on {known.airport.name}"
        self.about = f"mission {self.name} ({self.goals} goals) on {known.airport.name}"
        self._end = RunEnd(
            _PATIENCE_S if limit_s is None else limit_s, run.plan.waits, run.plan.begins_s)
        self.recorder = MissionRecorder(run.plan, self.strategy, known.airport, known.mission,
                                        run.system.titles)

    def sinks(self, clock: Clock) -> list[Sink]:
        """Return the sinks of the run's messages."""

        def to_end(_topic: Topic[Any], message: Any, _header: Header) -> None:
            self._end.take(message, clock.now())

        return [to_end, *super().sinks(clock)]

    def excuse(self, stall_s: float) -> None:
        """Do not count simulated seconds in which the launcher was stopped."""
        self._end.excuse(stall_s)

    def over(self, now_s: float) -> str | None:
        """Return why the run is over, or None while it goes on."""
        self._unjudged = self._unjudged or self._end.world_gone(now_s)
        return self._unjudged or self._end.ended(now_s)

    def conclude(self, now_s: float, why: str) -> RunRecord:
        """Return the record of the run with the judge's verdict and the outcome of faults."""
        return self.concluded(self.recorder.judge.verdict(), now_s, why)

    def summary(self, record: RunRecord) -> dict[str, Any]:
        """Return the summary for scripts, with the lights."""
        return {**super().summary(record),
                "lights": [msgspec.to_builtins(light) for light in _mission(record).lights]}

    def judgement(self, record: RunRecord) -> Verdict:
        """Return the verdict by ground truth: clearances, and when it became unsafe."""
        del record
        return self.settled(self.recorder.judge.verdict())

    @classmethod
    def moments(cls, spec: SystemSpec, *, searched: bool = False) -> tuple[float, float]:
        """Return the range of moments within the shipped missions, longer for a search."""
        del spec
        return 2.0, 150.0 if searched else 120.0

    def report(self, record: RunRecord, directory: Path) -> Written:
        """Write the inspection report as far as possible."""
        return try_report(record, render, directory)


def _mission(record: RunRecord) -> MissionRecord:
    if not isinstance(record, MissionRecord):
        raise TypeError(f"{type(record).__name__}: expected a MissionRecord")
    return record
