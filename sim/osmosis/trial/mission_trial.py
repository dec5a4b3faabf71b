"""A run of Osmosis: a mission on an airport, judged by ground truth."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO

import msgspec

from rampart.actors.bus.bounds import MOST
from rampart.actors.bus.limits import Remembered
from rampart.actors.bus.topic import Topic
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.runtime.actor import Header, on
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.run_context import RunContext
from rampart.sim.faults.injector import Injector, PlannedAction
from rampart.sim.osmosis.trial.faults import SuddenObstacle
from rampart.sim.osmosis.trial.record import MissionRecord, MissionRecorder
from rampart.sim.osmosis.trial.report import headline, render
from rampart.sim.osmosis.world import EXACT_BELOW_M
from rampart.sim.runs.console import Console
from rampart.sim.runs.judge import Verdict
from rampart.sim.runs.observer import Observer, Sink
from rampart.sim.runs.record import RunRecord
from rampart.sim.runs.report import Written, try_report
from rampart.sim.runs.trial import Trial

_ENDED = (m.MissionPhase.SUCCEEDED, m.MissionPhase.FAILED, m.MissionPhase.CANCELLED)

SETTLE_S = 1.5
"""Time after the mission's end for the robot to stop and for the last messages to arrive."""

WATCH_S = 60.0
"""Longest observation of a moving robot after the mission's end."""

STANDING_MPS, STANDING_RADPS = 0.05, 0.1
"""The robot stands below both, by ground truth."""

LOST_AFTER_S = 3.0
ACCEPT_WITHIN_S = 30.0
WORLD_LATE_S = 30.0
"""On an overloaded machine the ground truth of a running world may be missing for ten seconds."""
_STEP_TOWARDS_GOAL_M = 0.5
_DETOURS = 10
"""Most detours that count as progress; a planner that finds more alternates between them."""


@dataclass(slots=True)
class RunEnd:
    """Decides the end of a run. Times are simulated seconds, infinite before their event.

    A run ends when the mission has ended, when the Mission Manager has lost it, or without progress
    for `patience_s`, and then when the robot stands. A robot that keeps driving is observed for a
    minute, since it may leave the pavement. A run whose world is silent ends after half a minute.
    `rampart.sim.runs.trial` ends a run whose world has died.

    Args:
        patience_s: longest time without progress: a step, a measured light, half a metre towards
            the goal, or a detour.
        waits: whether the operator starts the mission at any time.
        begins_s: start of this part of the run.
    """

    patience_s: float
    waits: bool = False
    begins_s: float = 0.0
    _mission_id: str = ""
    _progress: tuple[int, int] = (-1, -1)
    _nearest_m: float = math.inf
    _reasons: set[str] = field(default_factory=lambda: {""})
    _progress_at_s: float = -math.inf
    _over_at_s: float = math.inf
    _over: str = ""
    _paused: str = ""
    _lost_at_s: float = math.inf
    _truth_at_s: float = math.inf
    _moves: bool = False

    def __post_init__(self) -> None:
        """Start the patience."""
        self._progress_at_s = self.begins_s

    def take(self, message: Any, now_s: float) -> None:
        """Take a message; irrelevant ones are ignored."""
        if isinstance(message, m.MissionStatus):
            self.mission(message, now_s)
        elif isinstance(message, m.ControlStatus):
            self.control(message, now_s)
        elif isinstance(message, m.GroundTruth):
            self.truth(message.twist, now_s)

    def mission(self, status: m.MissionStatus, now_s: float) -> None:
        """Take the mission's state."""
        if self._mission_id and status.mission_id != self._mission_id:
            self._lost_at_s = min(self._lost_at_s, now_s)
            return
        self._lost_at_s = math.inf
        if status.phase is m.MissionPhase.IDLE:
            return
        self._mission_id = status.mission_id
        self._paused = (f": mission paused, {status.reason}"
                        if status.phase is m.MissionPhase.PAUSED else "")
        progress = (status.step, len(status.lights))
        detour = status.phase is m.MissionPhase.RUNNING and status.reason not in self._reasons \
            and len(self._reasons) < _DETOURS
        if detour:
            self._reasons.add(status.reason)
        if progress != self._progress or detour:
            self._progress, self._progress_at_s = progress, now_s
            self._nearest_m = math.inf
        if status.phase in _ENDED:
            self._over_at_s = min(self._over_at_s, now_s)
            self._over = status.reason or f"mission {status.phase.value}"

    def control(self, status: m.ControlStatus, now_s: float) -> None:
        """Take the progress along the route, which is valid only while it is followed."""
        if status.phase is m.ControlPhase.FOLLOWING and \
                status.distance_to_go_m < self._nearest_m - _STEP_TOWARDS_GOAL_M:
            self._nearest_m, self._progress_at_s = status.distance_to_go_m, now_s

    def truth(self, twist: m.Twist, now_s: float) -> None:
        """Take a sign of the world, and whether the robot moves."""
        self._truth_at_s = now_s
        self._moves = (abs(twist.linear_mps) > STANDING_MPS
                       or abs(twist.angular_radps) > STANDING_RADPS)

    def excuse(self, stall_s: float) -> None:
        """Do not count a time in which the launcher was stopped."""
        self._progress_at_s += stall_s
        self._truth_at_s += stall_s
        self._lost_at_s += stall_s

    def world_gone(self, now_s: float) -> str:
        """Return that ground truth is missing, or ""."""
        return ("the world is gone: no ground truth from the simulator"
                if now_s - self._truth_at_s > WORLD_LATE_S else "")

    def ended(self, now_s: float) -> str | None:
        """Return why the run is over, or None while it goes on."""
        why, since_s = self._outcome(now_s)
        if not why or (self._moves and now_s - since_s < WATCH_S):
            return None
        return why

    def _outcome(self, now_s: float) -> tuple[str, float]:
        """Return the outcome of the mission, or "", and its time."""
        if self._over_at_s < math.inf:
            return (self._over if now_s - self._over_at_s >= SETTLE_S else ""), self._over_at_s
        if now_s - self._lost_at_s > LOST_AFTER_S:
            return "mission lost: the Mission Manager restarted without it", self._lost_at_s
        accepted_by_s = self.begins_s + ACCEPT_WITHIN_S
        if not self._mission_id and not self.waits and now_s > accepted_by_s:
            return f"no mission was accepted within {ACCEPT_WITHIN_S:.0f} s", accepted_by_s
        stuck_s = self._progress_at_s + self.patience_s
        if (self._mission_id or not self.waits) and now_s > stuck_s:
            return f"no progress for {self.patience_s:.0f} s{self._paused}", stuck_s
        return "", now_s


class OsmosisInjector(Injector):
    """Executes a scenario of planned faults."""

    outputs = (*Injector.outputs, topics.ACTUATOR_FAULT, topics.OBSTACLE)

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, **more)
        self._pose: m.Pose | None = None
        self._obstacles: dict[str, PlannedAction] = {}

    @on(topics.MISSION_STATUS)
    def mission(self, status: m.MissionStatus, _header: Header) -> None:
        """Take the current goal."""
        if status.phase is m.MissionPhase.RUNNING:
            self.goals_begun(status.step + 1)

    @on(topics.TRUTH)
    def truth(self, truth: m.GroundTruth, _header: Header) -> None:
        """Take the pose of the robot."""
        self._pose = truth.pose

    @on(topics.OBSTACLES)
    def obstacles(self, listed: m.ObstacleList, _header: Header) -> None:
        """Take the present obstacles."""
        for obstacle in listed.obstacles:
            if obstacle.present and obstacle.name in self._obstacles:
                self._obstacles[obstacle.name].hit = 1

    def carry_out(self, fault: PlannedAction) -> None:
        """Add an obstacle ahead of the robot."""
        action, pose = fault.action, self._pose
        if not isinstance(action, SuddenObstacle):
            raise TypeError(f"{action!r}: expected a SuddenObstacle")
        if pose is None:
            fault.reason = "the pose of the robot is unknown"
            return
        name = f"sudden-{self.planned.index(fault) + 1}"
        self._obstacles[name] = fault
        there = m.ObstacleCommand(
            name, True, pose.x_m + action.distance_m * math.cos(pose.yaw_rad),
            pose.y_m + action.distance_m * math.sin(pose.yaw_rad), action.radius_m)
        fault.reason = "no room for the obstacle"
        self.publish(topics.OBSTACLE, there)
        if math.isfinite(action.duration_s):
            gone = m.ObstacleCommand(name, False, there.x_m, there.y_m, there.radius_m)
            self.call_later(action.duration_s, lambda: self.publish(topics.OBSTACLE, gone))


class OsmosisObserver(Observer):
    """Passes the robot's messages to its sinks too."""

    @on(topics.MISSION_STATUS)
    @on(topics.CONTROL_STATUS)
    @on(topics.LIGHT_MEASURED)
    @on(topics.POSE)
    @on(topics.PILOT_STATUS)
    @on(topics.TRUTH)
    @on(topics.OBSTACLES)
    def robot_message(self, message: Any, header: Header) -> None:
        """Pass one message on."""
        self.heard(message, header)


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
        made = _mission(record)
        return [f"Mission {made.mission_name}: {made.mission}, {made.safety}, "
                f"{made.duration_s:.1f} s simulated, {made.distance_m:.0f} m driven.",
                headline(made)]

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
    draws = False
    injector = OsmosisInjector
    tells = MissionConsole
    retunings = {"mechanisms as in the paper": {"RM2": {"latched": True}, "RM5": {"latched": True}}}
    margins = {"obstacle_m": "nearest obstacle", "prohibited_m": "nearest prohibited area"}
    exact_below = EXACT_BELOW_M
    moments = 2.0, 120.0

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

    def report(self, record: RunRecord, directory: Path) -> Written:
        """Write the inspection report as far as possible."""
        return try_report(record, render, directory)


def _mission(record: RunRecord) -> MissionRecord:
    if not isinstance(record, MissionRecord):
        raise TypeError(f"{type(record).__name__}: expected a MissionRecord")
    return record
