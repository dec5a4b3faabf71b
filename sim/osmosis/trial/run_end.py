"""When is a run over? Pure: fed with what the observer hears, asked once in a while.

A run ends when the mission has ended, when it was lost (the Mission Manager forgot it), or when
nothing has progressed for the patience of the person who started it; and then when the robot
stands. One that drives on is looked at for a minute: it may be on its way into the grass. A run
without a world ends at once, one with a world that is not heard after half a minute.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

from rampart.actors.ftm.messages import ProcessEvent
from rampart.actors.osmosis import messages as m

_ENDED = (m.MissionPhase.SUCCEEDED, m.MissionPhase.FAILED, m.MissionPhase.CANCELLED)

SETTLE_S = 1.5
"""After the mission's end the robot gets this long to come to rest, and the records to arrive."""

WATCH_S = 60.0
"""After the mission's end a robot that does not come to rest is looked at this long."""

STANDING_MPS, STANDING_RADPS = 0.05, 0.1
"""Slower than this, by ground truth, it stands."""

LOST_AFTER_S = 3.0
ACCEPT_WITHIN_S = 30.0
WORLD_SILENT_S = 3.0
WORLD_LATE_S = 30.0
"""A machine that is overloaded may keep the ground truth away for ten seconds, of a world whose
process is there."""
_STEP_TOWARDS_GOAL_M = 0.5
_WAYS = 10
"""So many ways round something are followed patiently; who finds more goes to and fro."""


@dataclass(slots=True)
class RunEnd:
    """Decides the end of one run. Times are simulated seconds, infinite of what has not happened.

    Args:
        patience_s: longest time without progress: no new step, no light measured, not half
            a metre nearer to the goal, and no way round something that is on the way.
        waits: whether the mission comes when the operator wants it, however late.
        worlds: names of the nodes that simulate the world.
        begins_s: when this part of the run begins.
    """

    patience_s: float
    waits: bool = False
    worlds: Collection[str] = ()
    begins_s: float = 0.0
    _mission_id: str = ""
    _progress: tuple[int, int] = (-1, -1)
    _nearest_m: float = math.inf
    _ways: set[str] = field(default_factory=lambda: {""})
    _progress_at_s: float = -math.inf
    _over_at_s: float = math.inf
    _over: str = ""
    _lost_at_s: float = math.inf
    _truth_at_s: float = math.inf
    _moves: bool = False
    _is_gone: bool = False

    def __post_init__(self) -> None:
        """Count the patience from the beginning."""
        self._progress_at_s = self.begins_s

    def take(self, message: Any, now_s: float) -> None:
        """Take what the observer hears; what says nothing of the end does not matter."""
        if isinstance(message, m.MissionStatus):
            self.mission(message, now_s)
        elif isinstance(message, m.ControlStatus):
            self.control(message, now_s)
        elif isinstance(message, m.GroundTruth):
            self.truth(message.twist, now_s)
        elif isinstance(message, ProcessEvent) and message.node in self.worlds:
            self._is_gone = message.event not in {"running", "resumed", "adopted"}

    def mission(self, status: m.MissionStatus, now_s: float) -> None:
        """Take the mission's state."""
        if self._mission_id and status.mission_id != self._mission_id:
            self._lost_at_s = min(self._lost_at_s, now_s)
            return
        self._lost_at_s = math.inf
        if status.phase is m.MissionPhase.IDLE:
            return
        self._mission_id = status.mission_id
        progress = (status.step, len(status.lights))
        another_way = status.phase is m.MissionPhase.RUNNING and status.reason not in self._ways \
            and len(self._ways) < _WAYS
        if another_way:
            self._ways.add(status.reason)
        if progress != self._progress or another_way:
            self._progress, self._progress_at_s = progress, now_s
            self._nearest_m = math.inf
        if status.phase in _ENDED:
            self._over_at_s = min(self._over_at_s, now_s)
            self._over = status.reason or f"mission {status.phase.value}"

    def control(self, status: m.ControlStatus, now_s: float) -> None:
        """Take the progress along the route; only who follows it knows how far it is."""
        if status.phase is m.ControlPhase.FOLLOWING and \
                status.distance_to_go_m < self._nearest_m - _STEP_TOWARDS_GOAL_M:
            self._nearest_m, self._progress_at_s = status.distance_to_go_m, now_s

    def truth(self, twist: m.Twist, now_s: float) -> None:
        """Note that the world turns, and whether the robot moves in it."""
        self._truth_at_s = now_s
        self._moves = (abs(twist.linear_mps) > STANDING_MPS
                       or abs(twist.angular_radps) > STANDING_RADPS)

    def excuse(self, stall_s: float) -> None:
        """Do not count a time in which nobody here listened: the launcher itself was stopped."""
        self._progress_at_s += stall_s
        self._truth_at_s += stall_s
        self._lost_at_s += stall_s

    def world_gone(self, now_s: float) -> str:
        """Return that ground truth is missing, so that no judge watches, or ""."""
        late_s = WORLD_SILENT_S if self._is_gone else WORLD_LATE_S
        return ("the world is gone: no ground truth from the simulator"
                if now_s - self._truth_at_s > late_s else "")

    def ended(self, now_s: float) -> str | None:
        """Return why the run is over, or None while it goes on."""
        why, since_s = self._outcome(now_s)
        if not why or (self._moves and now_s - since_s < WATCH_S):
            return None
        return why

    def _outcome(self, now_s: float) -> tuple[str, float]:
        """Return what became of the mission, and since when that is certain; "" if it is not."""
        if self._over_at_s < math.inf:
            return (self._over if now_s - self._over_at_s >= SETTLE_S else ""), self._over_at_s
        if now_s - self._lost_at_s > LOST_AFTER_S:
            return "mission lost: the Mission Manager came back without it", self._lost_at_s
        accepted_by_s = self.begins_s + ACCEPT_WITHIN_S
        if not self._mission_id and not self.waits and now_s > accepted_by_s:
            return f"no mission was accepted within {ACCEPT_WITHIN_S:.0f} s", accepted_by_s
        stuck_s = self._progress_at_s + self.patience_s
        if (self._mission_id or not self.waits) and now_s > stuck_s:
            return f"no progress for {self.patience_s:.0f} s", stuck_s
        return "", now_s
