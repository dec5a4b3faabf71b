"""The judge of a mission, by ground truth alone, and the record. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal

import msgspec

from rampart.actors.bus.limits import Remembered
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.drawing import AirportDrawing, draw
from rampart.actors.osmosis.airport.model import Airport, Light, Mission, MissionGoal
from rampart.actors.osmosis.messages import GroundTruth
from rampart.actors.runtime.actor import Header
from rampart.actors.runtime.run_plan import RunPlan
from rampart.sim.runs.judge import Verdict
from rampart.sim.runs.record import KEPT, RunRecord, RunRecorder, Safety

ARRIVAL_RADIUS_M = 1.1
"""Distance at which a point is reached (the authors' code)."""


class Judge:
    """Follows one mission by ground truth.

    Success (paper, section V): each point was reached in order and in its mode. Safe: never in a
    prohibited area, never a collision. Without ground truth the verdict is not known.

    Args:
        goals: the mission's points.

    Attributes:
        visit_times_s: times at which points were reached.
        collisions: number of collisions.
        prohibited_s: time spent in the prohibited area.
        first_unsafe_s: time of the first violation of safety, or None.
        obstacle_m: least clearance to an obstacle or building.
        prohibited_m: least clearance to the prohibited area.
        narrowest_s: time of the least clearance, or None.
        point_m: least distance to the next point.

    Raises:
        ValueError: no goals.
    """

    def __init__(self, goals: Sequence[MissionGoal]) -> None:
        if not goals:
            raise ValueError("judge: goals: empty: expected at least one")
        self._goals = tuple(goals)
        self._wrong_mode_at: dict[int, str] = {}
        self._has_seen = False
        self.visit_times_s: list[float] = []
        self.collisions = 0
        self.prohibited_s = 0.0
        self.first_unsafe_s: float | None = None
        self.obstacle_m = self.prohibited_m = self.point_m = math.inf
        self.narrowest_s: float | None = None

    def see(self, truth: GroundTruth, mode: str, time_s: float) -> None:
        """Take the next ground truth, in order of time.

        Args:
            truth: the ground truth.
            mode: mode of the mission at that time: "taxi", "light verification", or "" while no
                mission runs.
            time_s: its time.
        """
        self._has_seen = True
        self.collisions = max(self.collisions, truth.collisions)
        self.prohibited_s = max(self.prohibited_s, truth.prohibited_s)
        if self.first_unsafe_s is None and not self._safe:
            self.first_unsafe_s = time_s
        obstacle_m, prohibited_m = truth.obstacle_clearance_m, truth.prohibited_clearance_m
        if min(obstacle_m, prohibited_m) < min(self.obstacle_m, self.prohibited_m):
            self.narrowest_s = time_s
        self.obstacle_m = min(self.obstacle_m, obstacle_m)
        self.prohibited_m = min(self.prohibited_m, prohibited_m)
        while (step := len(self.visit_times_s)) < len(self._goals):
            goal = self._goals[step]
            distance_m = math.dist((truth.pose.x_m, truth.pose.y_m), (goal.x_m, goal.y_m))
            self.point_m = min(self.point_m, distance_m)
            if distance_m > ARRIVAL_RADIUS_M:
                break
            if mode != goal.mode:
                if mode:
                    self._wrong_mode_at[step] = mode
                break
            self.visit_times_s.append(time_s)
            self.point_m = math.inf

    @property
    def _safe(self) -> bool:
        return self.collisions == 0 and self.prohibited_s == 0.0

    def verdict(self) -> Verdict:
        """Return the verdict so far."""
        visited, points = len(self.visit_times_s), len(self._goals)
        reasons = []
        if not self._has_seen:
            reasons.append("no ground truth was received: the robot's position is unknown")
        elif visited < points:
            goal = self._goals[visited]
            why = f"point {visited + 1} of {points} at ({goal.x_m:g}, {goal.y_m:g})"
            mode = self._wrong_mode_at.get(visited)
            reasons.append(f"{why} was passed in mode {mode!r}, not in {goal.mode!r}" if mode
                           else f"{why} was not reached, nearest {self.point_m:.2f} m")
        if self.collisions:
            reasons.append(f"{self.collisions} collision{'s' if self.collisions > 1 else ''}")
        if self.prohibited_s > 0:
            reasons.append(f"{self.prohibited_s:.2f} s in the prohibited area")
        return Verdict(
            success=visited == points, safe=self._safe if self._has_seen else None,
            reasons=tuple(reasons), severity=severity(self.prohibited_s, self.collisions),
            margins={"obstacle_m": _metres(self.obstacle_m),
                     "prohibited_m": _metres(self.prohibited_m)},
            unsafe_s=self.first_unsafe_s, narrowest_s=self.narrowest_s)


def severity(prohibited_s: float, collisions: int) -> float:
    """Return the severity of an unsafe run: seconds in the prohibited area plus collisions."""
    return round(prohibited_s, 3) + collisions


def _metres(value: float) -> float | None:
    return round(value, 4) if math.isfinite(value) else None


TRACK_STEP_M = 0.2
"""Distance between two points of a track."""

TRACK_KEPT = 100_000
"""Most points of a track: twenty kilometres."""


class LightResult(msgspec.Struct, frozen=True):
    """A light of the airport; `verdict` is ok, dim, out, or not measured (without values)."""

    name: str
    row: str
    x_m: float
    y_m: float
    nominal_cd: float
    verdict: str = "not measured"
    intensity_cd: float | None = None
    ratio: float | None = None


class StepResult(msgspec.Struct, frozen=True):
    """A goal of the mission: when it was reached, simulated s, or None; whether it was skipped."""

    mode: str
    x_m: float
    y_m: float
    reached_s: float | None
    skipped: bool = False


class ObstacleSeen(msgspec.Struct, frozen=True):
    """An obstacle that was present at some time."""

    name: str
    x_m: float
    y_m: float
    radius_m: float


class MissionRecord(RunRecord, frozen=True, kw_only=True):
    """One mission; positions are in `map`.

    Args:
        mission: success or fail (paper, section V: each point in order and in its mode).
        safety: safe or unsafe by ground truth; not known without it.
        airport: its geometry.
        mission_name: of the mission.
        distance_m: true distance driven.
        track: true track as (t, x, y).
        believed: track by localization as (t, x, y).
        lights: all lights of the airport.
        steps: all goals of the mission.
        obstacles: obstacles that were present at some time.
        collisions: number of collisions by ground truth.
        prohibited_s: time spent in the prohibited area.
        obstacle_clearance_m: least distance to an obstacle, None without one.
        prohibited_clearance_m: least distance to the prohibited area, negative inside.
        narrowest_s: time of the least distance to an obstacle, a building or the prohibited area.
    """

    mission: Literal["success", "fail"]
    safety: Safety
    airport: AirportDrawing
    mission_name: str
    distance_m: float
    track: tuple[tuple[float, float, float], ...]
    believed: tuple[tuple[float, float, float], ...]
    lights: tuple[LightResult, ...]
    steps: tuple[StepResult, ...]
    obstacles: tuple[ObstacleSeen, ...]
    collisions: int
    prohibited_s: float
    obstacle_clearance_m: float | None
    prohibited_clearance_m: float | None
    narrowest_s: float | None = None


class MissionRecorder(RunRecorder):
    """Builds a `MissionRecord` from the messages of a run, and passes ground truth to the judge.

    Args:
        plan: plan of the run.
        strategy: strategy of the manager; empty without FTMs.
        airport: the airport.
        mission: the mission.
        titles: titles of mechanisms and recoveries.

    Attributes:
        judge: judge of the mission.
    """

    def __init__(self, plan: RunPlan, strategy: str, airport: Airport, mission: Mission,
                 titles: Mapping[str, str] = MappingProxyType({})) -> None:
        super().__init__(plan, strategy, titles)
        self._airport = airport
        self._mission = mission
        self.judge = Judge(mission.goals)
        self._mode = ""
        self._track: list[tuple[float, float, float]] = []
        self._believed: list[tuple[float, float, float]] = []
        self._lights: dict[str, m.LightMeasurement] = {}
        self._reached: tuple[float, ...] = ()
        self._skipped: frozenset[int] = frozenset()
        self._known_lights = frozenset(light.name for light in airport.lights)
        self._obstacles: dict[str, ObstacleSeen] = Remembered(KEPT)
        self._take |= {
            topics.TRUTH.key: self._truth, topics.POSE.key: self._pose,
            topics.MISSION_STATUS.key: self._mission_status,
            topics.LIGHT_MEASURED.key: self._light, topics.OBSTACLES.key: self._obstacle_list,
            topics.PILOT_STATUS.key: self._pilot}

    def marks(self) -> int:
        """Return a number that grows with each event that `memory` must soon contain."""
        return (super().marks() + len(self.judge.visit_times_s) + self.judge.collisions
                + len(self._reached) + len(self._lights))

    def memory(self, now_s: float) -> bytes:
        """Return the state of record and judge for a resumed run."""
        verdict: dict[str, Any] = {"mission": "fail", "safety": "not known"}
        return msgspec.msgpack.encode(_Memory(
            self.record(now_s, **verdict), tuple(self.judge.visit_times_s),
            self.judge.first_unsafe_s, self._mode))

    def recall(self, memory: bytes) -> MissionRecord:
        """Restore the state of the previous part of the run, and return its record.

        Raises:
            msgspec.DecodeError: the bytes are not such a state.
        """
        kept = msgspec.msgpack.decode(memory, type=_Memory)
        before, judge = kept.record, self.judge
        self.continues(before)
        self._mode, judge.visit_times_s = kept.mode, list(kept.visit_times_s)
        judge.first_unsafe_s, judge.narrowest_s = kept.first_unsafe_s, before.narrowest_s
        judge.collisions, judge.prohibited_s = before.collisions, before.prohibited_s
        judge.obstacle_m = _or_infinite(before.obstacle_clearance_m)
        judge.prohibited_m = _or_infinite(before.prohibited_clearance_m)
        self._track, self._believed = list(before.track), list(before.believed)
        self._obstacles.update((seen.name, seen) for seen in before.obstacles)
        self._lights.update((light.name, m.LightMeasurement(
            light.name, light.intensity_cd, light.ratio, m.LightVerdict(light.verdict)))
            for light in before.lights
            if light.intensity_cd is not None and light.ratio is not None)
        self._skipped = frozenset(i for i, step in enumerate(before.steps) if step.skipped)
        done = [step for step in before.steps if step.skipped or step.reached_s is not None]
        self._reached = tuple(before.duration_s if step.reached_s is None else step.reached_s
                              for step in done)
        return before

    def record(self, duration_s: float, **more: Any) -> MissionRecord:
        """Return the record so far; `more` has at least the verdicts."""
        judge, drawing = self.judge, draw(self._airport)
        reached = {i: at_s for i, at_s in enumerate(self._reached) if i not in self._skipped}
        return MissionRecord(
            **self.fields(duration_s), **more,
            airport=drawing, mission_name=self._mission.name,
            distance_m=sum(math.dist(a[1:], b[1:])
                           for a, b in zip(self._track, self._track[1:], strict=False)),
            track=tuple(self._track), believed=tuple(self._believed),
            lights=tuple(map(self._light_result, drawing.lights)),
            steps=tuple(StepResult(str(goal.mode), goal.x_m, goal.y_m, reached.get(i),
                                   i in self._skipped)
                        for i, goal in enumerate(self._mission.goals)),
            obstacles=tuple(self._obstacles.values()),
            collisions=judge.collisions, prohibited_s=judge.prohibited_s,
            obstacle_clearance_m=_finite(judge.obstacle_m),
            prohibited_clearance_m=_finite(judge.prohibited_m),
            narrowest_s=judge.narrowest_s)

    def _truth(self, truth: m.GroundTruth, header: Header) -> None:
        self._append(self._track, header.stamp, truth.pose)
        self.judge.see(truth, self._mode, header.stamp)

    def _pose(self, pose: m.Pose, header: Header) -> None:
        self._append(self._believed, header.stamp, pose)

    def _mission_status(self, status: m.MissionStatus, header: Header) -> None:
        for light in status.lights:
            self._light(light, header)
        running = status.phase is m.MissionPhase.RUNNING and status.step < len(status.goals)
        self._mode = status.goals[status.step].mode.value if running else ""
        # Negative if the Mission Manager has lost its mission.
        newly = len(status.step_times_s) - len(self._reached)
        self._reached += (header.stamp,) * newly
        self._skipped |= frozenset(status.skipped).intersection(range(len(self._mission.goals)))

    def _light(self, light: m.LightMeasurement, _header: Header) -> None:
        if light.light in self._known_lights:
            self._lights[light.light] = light

    def _obstacle_list(self, listed: m.ObstacleList, _header: Header) -> None:
        for o in listed.obstacles:
            if o.present:
                self._obstacles[o.name] = ObstacleSeen(o.name, o.x_m, o.y_m, o.radius_m)

    def _pilot(self, status: m.PilotStatus, header: Header) -> None:
        self.turn("stop", "Safety Pilot", status.stopped, header.stamp, status.reason)

    def _append(self, track: list[tuple[float, float, float]], t_s: float, pose: m.Pose) -> None:
        if not (math.isfinite(pose.x_m) and math.isfinite(pose.y_m)):
            return
        moved = not track or math.dist(track[-1][1:], (pose.x_m, pose.y_m)) >= TRACK_STEP_M
        if moved and self.has_room(track, TRACK_KEPT):
            track.append((round(t_s, 2), round(pose.x_m, 3), round(pose.y_m, 3)))

    def _light_result(self, light: Light) -> LightResult:
        known, seen = msgspec.structs.asdict(light), self._lights.get(light.name)
        return LightResult(**known) if seen is None else LightResult(
            **known, verdict=seen.verdict.value, intensity_cd=seen.intensity_cd, ratio=seen.ratio)


class _Memory(msgspec.Struct, frozen=True):
    """State for a resumed run: the record, and the judge's data that it does not contain."""

    record: MissionRecord
    visit_times_s: tuple[float, ...]
    first_unsafe_s: float | None
    mode: str


def _or_infinite(value: float | None) -> float:
    return math.inf if value is None else value


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
