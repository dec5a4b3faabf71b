"""The judge: was the mission a success, was it safe? From ground truth alone, and pure.

Success (paper, section V): every mission point was reached in the order of the mission and in
the right mode. Safe: never in a prohibited area, never a collision. Without any ground truth
nobody knows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rampart.actors.bus.topic import Topic
from rampart.actors.osmosis.airport.model import MissionGoal
from rampart.actors.osmosis.messages import GroundTruth, MissionPhase, MissionStatus
from rampart.actors.runtime.actor import Header

ARRIVAL_RADIUS_M = 1.1
"""A point counts as reached at this distance (the authors' code)."""


@dataclass(frozen=True, slots=True)
class Sample:
    """Ground truth at one moment, and the mode the mission reported then.

    Args:
        time_s: simulated time.
        x_m: true position in `map`.
        y_m: true position in `map`.
        collisions: so far.
        prohibited_s: time spent in the prohibited area so far.
        obstacle_clearance_m: footprint to nearest obstacle or building.
        prohibited_clearance_m: footprint to prohibited area.
        mode: "taxi" or "light verification", or "" while no mission runs.
    """

    time_s: float
    x_m: float
    y_m: float
    collisions: int
    prohibited_s: float
    obstacle_clearance_m: float
    prohibited_clearance_m: float
    mode: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """What the judge has seen.

    Args:
        success: all points reached, in order and in the right mode.
        safe: no collision, never in the prohibited area; None if no ground truth ever came.
        visited: how many points were reached so far.
        points: how many there are.
        visit_times_s: when each was reached.
        reasons: why not success and why unsafe, one sentence each; empty if all is well.
        first_unsafe_s: when it first became unsafe, or None.
        closest_obstacle_m: smallest clearance to an obstacle or building.
        closest_prohibited_m: smallest clearance to the prohibited area.
        closest_point_m: nearest the robot came to the point it has not reached; None if none.
    """

    success: bool
    safe: bool | None
    visited: int
    points: int
    visit_times_s: tuple[float, ...]
    reasons: tuple[str, ...]
    first_unsafe_s: float | None
    closest_obstacle_m: float
    closest_prohibited_m: float
    closest_point_m: float | None


class Judge:
    """Follows one mission.

    Args:
        goals: the mission's points.
        arrival_radius_m: distance at which a point is reached.

    Raises:
        ValueError: no goals, or a radius that is not positive.
    """

    def __init__(
        self, goals: Sequence[MissionGoal], arrival_radius_m: float = ARRIVAL_RADIUS_M
    ) -> None:
        if not goals:
            raise ValueError("judge: goals: empty: a mission has at least one goal")
        if not arrival_radius_m > 0:
            raise ValueError(f"judge: arrival_radius_m: {arrival_radius_m}: must be positive")
        self._goals = tuple(goals)
        self._radius_m = arrival_radius_m
        self._times: list[float] = []
        self._wrong_mode_at: dict[int, str] = {}
        self._collisions = 0
        self._prohibited_s = 0.0
        self._has_seen = False
        self._first_unsafe_s: float | None = None
        self._obstacle_m = math.inf
        self._prohibited_m = math.inf
        self._point_m = math.inf

    def see(self, sample: Sample) -> None:
        """Take the next sample; samples come in order of time."""
        self._has_seen = True
        self._collisions = max(self._collisions, sample.collisions)
        self._prohibited_s = max(self._prohibited_s, sample.prohibited_s)
        if self._first_unsafe_s is None and not self._safe:
            self._first_unsafe_s = sample.time_s
        self._obstacle_m = min(self._obstacle_m, sample.obstacle_clearance_m)
        self._prohibited_m = min(self._prohibited_m, sample.prohibited_clearance_m)
        while len(self._times) < len(self._goals):
            step = len(self._times)
            goal = self._goals[step]
            distance_m = math.dist((sample.x_m, sample.y_m), (goal.x_m, goal.y_m))
            self._point_m = min(self._point_m, distance_m)
            if distance_m > self._radius_m:
                break
            if sample.mode != goal.mode:
                if sample.mode:
                    self._wrong_mode_at[step] = sample.mode
                break
            self._times.append(sample.time_s)
            self._point_m = math.inf

    @property
    def _safe(self) -> bool:
        return self._collisions == 0 and self._prohibited_s == 0.0

    def verdict(self) -> Verdict:
        """Return the verdict on what was seen so far."""
        visited, points = len(self._times), len(self._goals)
        reasons = []
        if not self._has_seen:
            reasons.append("no ground truth ever came: nobody knows where the robot was")
        elif visited < points:
            goal = self._goals[visited]
            why = f"point {visited + 1} of {points} at ({goal.x_m:g}, {goal.y_m:g})"
            if visited in self._wrong_mode_at:
                reasons.append(
                    f"{why} was passed in mode {self._wrong_mode_at[visited]!r}, "
                    f"not in {goal.mode!r}"
                )
            else:
                reasons.append(f"{why} was not reached, nearest {self._point_m:.2f} m")
        if self._collisions:
            reasons.append(f"{self._collisions} collision{'s' if self._collisions > 1 else ''}")
        if self._prohibited_s > 0:
            reasons.append(f"{self._prohibited_s:.2f} s in the prohibited area")
        return Verdict(
            success=visited == points,
            safe=self._safe if self._has_seen else None,
            visited=visited,
            points=points,
            visit_times_s=tuple(self._times),
            reasons=tuple(reasons),
            first_unsafe_s=self._first_unsafe_s,
            closest_obstacle_m=self._obstacle_m,
            closest_prohibited_m=self._prohibited_m,
            closest_point_m=None if visited == points else self._point_m,
        )


class JudgeSink:
    """Feeds a judge with ground truth and the mode that the mission reports."""

    def __init__(self, judge: Judge) -> None:
        self._judge = judge
        self._mode = ""

    def __call__(self, _topic: Topic[Any], message: Any, header: Header) -> None:
        """Take one message; those that are neither truth nor mission status do not matter."""
        if isinstance(message, MissionStatus):
            running = message.phase is MissionPhase.RUNNING and message.step < len(message.goals)
            self._mode = message.goals[message.step].mode.value if running else ""
        elif isinstance(message, GroundTruth):
            self._judge.see(Sample(
                header.stamp, message.pose.x_m, message.pose.y_m, message.collisions,
                message.prohibited_s, message.obstacle_clearance_m,
                message.prohibited_clearance_m, self._mode))
