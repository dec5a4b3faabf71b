"""What a mission tells on the terminal: goals, lights, and where the robot is."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TextIO

from rampart.actors.bus.bounds import MOST
from rampart.actors.bus.limits import Remembered
from rampart.actors.bus.topic import Topic
from rampart.actors.osmosis import messages as m
from rampart.actors.runtime.actor import Header
from rampart.sim.osmosis.trial.record import MissionRecord
from rampart.sim.osmosis.trial.report import headline
from rampart.sim.runs.console import Console
from rampart.sim.runs.record import RunRecord


class MissionConsole(Console):
    """Writes the story of a mission."""

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

    def conclusion(self, record: RunRecord, report: Path | None) -> None:
        """Say how it ended, and where the report is, if there is one."""
        if isinstance(record, MissionRecord):
            self.say(f"Mission {record.mission_name}: {record.mission}, {record.safety}, "
                     f"{record.duration_s:.1f} s simulated, {record.distance_m:.0f} m driven.")
            self.say(headline(record))
        super().conclusion(record, report)

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
