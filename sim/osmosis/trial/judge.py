"""The judge: whether a mission succeeded and was safe, by ground truth alone. Pure."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rampart.actors.osmosis.airport.model import MissionGoal
from rampart.actors.osmosis.messages import GroundTruth
from rampart.sim.runs.judge import Verdict

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
