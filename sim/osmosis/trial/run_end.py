"""Decides when a run is over. Pure.

A run ends when the mission has ended, when the Mission Manager has lost it, or without progress for
`patience_s`, and then when the robot stands. A robot that keeps driving is observed for a minute,
since it may leave the pavement. A run whose world is silent ends after half a minute.
`rampart.sim.runs.trial` ends a run whose world has died.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from rampart.actors.osmosis import messages as m

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
