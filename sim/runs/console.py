"""What a run tells on the terminal: one line per event, and a live line where there is a tty."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

from rampart.actors.bus.bounds import MANY, MOST, clip
from rampart.actors.bus.limits import RateLimit, Remembered
from rampart.actors.bus.messages import Diagnostic
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm.messages import (
    DecisionRecord,
    DetectionReport,
    DetectionState,
    ManagerStatus,
    ProcessEvent,
    ShadowRecord,
)
from rampart.actors.osmosis.airport.model import Mission
from rampart.actors.osmosis.messages import (
    GroundTruth,
    LightVerdict,
    MissionPhase,
    MissionStatus,
    PilotStatus,
)
from rampart.actors.run.run_plan import SUPERVISOR, RunPlan
from rampart.actors.runtime.actor import Header
from rampart.files.plain_text import LINE_CHARS, printable
from rampart.manager.spec.schema import SystemSpec
from rampart.sim.osmosis.trial.record import RunRecord
from rampart.sim.osmosis.trial.report import headline

_EXAMPLE = "osmosis_control"
"""Of a node to kill; a system that has it not offers its first that a recovery brings back."""

_QUIET_EVENTS = frozenset({"started", "running", "adopted"})


REPORTS_PER_S = 10
"""Error reports shown in a real second."""

LINES_PER_S = 50
"""Other lines shown in a real second."""


class Console:
    """Writes the story of a run to a stream as it happens.

    What it is told comes from the bus, and from anybody: each line is made printable and clipped,
    and of more lines than can be read the number is told instead. In virtual time nobody else is
    there, and a second may be a whole mission: there all lines are shown.

    Args:
        stream: where to.
        clock: real seconds.
    """

    def __init__(self, stream: TextIO, clock: Callable[[], float] = time.monotonic) -> None:
        self._stream = stream
        self._clock = clock
        self._is_limited = True
        self._reports = RateLimit(REPORTS_PER_S)
        self._others = RateLimit(LINES_PER_S)
        self._live = stream.isatty()
        self._live_text = ""
        self._step = -1
        self._phase: MissionPhase | None = None
        self._lights: dict[str, LightVerdict] = Remembered(MOST)
        self._detections: dict[str, DetectionState] = Remembered(MANY)
        self._silent: tuple[str, ...] = ()
        self._mission: MissionStatus | None = None
        self._pilot = ""
        self._last_live_s = 0.0
        self._unsafe = (0, False)

    def banner(self, airport: str, mission: Mission, plan: RunPlan, spec: SystemSpec) -> None:
        """Say what is about to run and how to disturb it."""
        strategy = spec.strategy
        mode = strategy if plan.ftm else "no fault tolerance"
        self._print(f"Rampart: mission {mission.name} ({len(mission.goals)} goals) on {airport}, "
                    f"{mode}, rate {plan.rate:g}")
        if plan.hmi_port:
            self._print(f"Operator's page: {plan.hmi_page_to_open}")
        comes_back = [node.name for node in spec.nodes if node.respawn != SUPERVISOR]
        if comes_back:
            example = _EXAMPLE if _EXAMPLE in comes_back else comes_back[0]
            self._print(f"Try from another shell: kill-node {example}")

    def virtual_banner(
        self, airport: str, mission: Mission, plan: RunPlan, strategy: str
    ) -> None:
        """Say what is about to run in virtual time."""
        self._is_limited = False
        mode = strategy if plan.ftm else "no fault tolerance"
        self._print(f"Rampart: mission {mission.name} ({len(mission.goals)} goals) on {airport}, "
                    f"{mode}, virtual time, seed {plan.seed}")

    def speed(self, times: float, messages: int, trace: str) -> None:
        """Say how fast virtual time went, and by what the run can be recognised."""
        self._print(f"{times:.0f} times real time, {messages} messages, trace {trace[:16]}")

    def take(self, _topic: Topic[Any], message: Any, header: Header) -> None:
        """Take one message of the run."""
        at = header.stamp
        self._tell_left_out(at)
        if isinstance(message, MissionStatus):
            self._take_mission(message, at)
        elif isinstance(message, ProcessEvent):
            if message.event not in _QUIET_EVENTS and message.detail != "already":
                detail = f" ({message.detail})" if message.detail else ""
                self.line(at, f"{message.node} {message.event}, incarnation "
                          f"{message.incarnation}{detail}")
        elif isinstance(message, DetectionReport):
            self._take_detection(message, header)
        elif isinstance(message, ManagerStatus):
            self._take_silence(message.silent, at)
        elif isinstance(message, DecisionRecord):
            what = " and ".join(message.recoveries) or "nothing to recover"
            word = "block" if message.strategy == "safety-first" else "rule"  # figure 7's word
            block = f", {word} {message.rule}" if message.rule else ""
            self.line(at, f"decision {message.decision}: {what}{block}"
                      + (f" for {', '.join(message.active)}" if message.active else ""))
        elif isinstance(message, ShadowRecord):
            self.line(at, f"  in shadow {message.strategy} would run "
                          f"{' and '.join(message.recoveries) or 'nothing'}")
        elif isinstance(message, Diagnostic):
            self.line(at, f"{message.node}: {message.context}: {message.reason} "
                      f"[{message.offender}]", self._reports)
        elif isinstance(message, PilotStatus):
            self._pilot = message.reason if message.stopped else ""
        elif isinstance(message, GroundTruth):
            self._show_live(message, at)

    def line(self, at_s: float, text: str, limit: RateLimit | None = None) -> None:
        """Write one line with its simulated time, unless there are too many of its kind."""
        if not self._is_limited or (limit or self._others).allows(self._clock()):
            self._print(f"[{at_s:7.2f} s] {clip(text, LINE_CHARS)}")

    def _tell_left_out(self, at_s: float) -> None:
        now_s = self._clock()
        count = self._reports.left_out(now_s) + self._others.left_out(now_s)
        if count:
            self._print(f"[{at_s:7.2f} s] {count} more lines were left out")

    def trouble(self, text: str) -> None:
        """Write a line of what went wrong at no time of the run."""
        self._print(f"launch.py: {' '.join(text.split())}")

    def close(self) -> None:
        """Take the live line away."""
        self._clear()

    def conclusion(self, record: RunRecord, report: Path | None) -> None:
        """Say how it ended, and where the report is, if there is one."""
        self._print(f"Mission {record.mission_name}: {record.mission}, {record.safety}, "
                    f"{record.duration_s:.1f} s simulated, {record.distance_m:.0f} m driven.")
        self._print(headline(record))
        for reason in record.reasons:
            self._print(f"  {reason}")
        if report is not None:
            self._print(f"Report: {report}")

    def _take_mission(self, status: MissionStatus, at: float) -> None:
        self._mission = status
        if status.phase is not self._phase:
            self._phase = status.phase
            reason = f": {status.reason}" if status.reason else ""
            self.line(at, f"mission {status.name or '-'} {status.phase.value}{reason}")
        if status.phase is MissionPhase.RUNNING and status.step != self._step:
            self._step = status.step
            if status.step < len(status.goals):
                goal = status.goals[status.step]
                self.line(at, f"goal {status.step + 1}/{len(status.goals)}: ({goal.x_m:g}, "
                          f"{goal.y_m:g}), {goal.mode.value}")
        for light in status.lights:
            if light.light not in self._lights:
                self._lights[light.light] = light.verdict
                if light.verdict is not LightVerdict.OK:
                    self.line(at, f"light {light.light} is {light.verdict.value} "
                              f"({light.ratio:.0%} of nominal)")

    def _take_detection(self, report: DetectionReport, header: Header) -> None:
        before = self._detections.get(header.source, DetectionState.IDLE)
        self._detections[header.source] = report.state
        if report.state is not before:
            what = report.reason if report.state is DetectionState.ACTIVE else "clear"
            self.line(header.stamp, f"{header.source}: {what}")

    def _take_silence(self, silent: tuple[str, ...], at: float) -> None:
        for name in silent:
            if name not in self._silent:
                self.line(at, f"{name} silent: it counts as active")
        for name in self._silent:
            if name not in silent:
                self.line(at, f"{name}: no longer silent")
        self._silent = silent

    def _show_live(self, truth: GroundTruth, at: float) -> None:
        unsafe = (truth.collisions, truth.prohibited_s > 0)
        if unsafe != self._unsafe:
            self._unsafe = unsafe
            self._print(f"[{at:7.2f} s] UNSAFE: " + ("in the prohibited area" if unsafe[1] else "")
                      + (f" {unsafe[0]} collisions" if unsafe[0] else ""))
        if not self._live or at - self._last_live_s < 0.25:
            return
        self._last_live_s = at
        m = self._mission
        step = f"goal {m.step + 1}/{len(m.goals)}" if m and m.goals else "no mission"
        self._clear()
        text = (f"{at:7.1f} s  {step}  ({truth.pose.x_m:6.1f}, {truth.pose.y_m:6.1f})  "
                f"{truth.twist.linear_mps:4.2f} m/s  {len(self._lights)} lights  {self._pilot}")
        self._live_text = printable(text)[:shutil.get_terminal_size().columns - 1]
        self._stream.write(self._live_text)
        self._stream.flush()

    def _clear(self) -> None:
        if self._live_text:
            self._stream.write("\r\x1b[K")
            self._live_text = ""

    def _print(self, text: str) -> None:
        self._clear()
        self._stream.write(printable(text) + "\n")
        self._stream.flush()
