"""Bridges a stale pose by odometry for a bounded distance, in the node that uses the pose.

While localization is dead, frozen or late, odometry is still received. The pose now is the last
pose plus the motion by odometry since *the stamp of the pose*. Odometry is accurate to a few
millimetres per metre straight ahead, and to a tenth of a radian in a turn of a skid-steer robot
(docs/case-study/localization.md). Beyond the bound there is no pose, and the reader has to stop.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from operator import itemgetter

from rampart.actors.ftm.plausible import is_possible, is_sane
from rampart.actors.osmosis.control.polyline import Pose2

AFTER_S = 0.15
"""Age of a stale pose: three periods."""

_ODOMETRY_FRESH_S = 0.2
_KEPT = 125
"""Readings of odometry: 2.5 s, the greatest age of a pose that can be bridged."""


class DeadReckoning:
    """Keeps the newest pose and the odometry since. Times are simulated seconds.

    Args:
        bridge_m: longest distance from the last pose, m.
        after_s: age at which a pose is stale, s.
    """

    def __init__(self, bridge_m: float, after_s: float = AFTER_S) -> None:
        self.bridge_m = bridge_m
        self.after_s = after_s
        self._pose: Pose2 | None = None
        self._stamp_s = -math.inf
        self._way: deque[tuple[float, Pose2, float]] = deque(maxlen=_KEPT)
        self._start: tuple[float, Pose2, float] | None = None

    def pose(self, stamp_s: float, pose: Pose2, now_s: float) -> None:
        """Take a pose in `map`; one that is old, invalid or from the future is ignored."""
        if stamp_s > self._stamp_s and is_possible(stamp_s, now_s) and is_sane(*pose):
            self._pose, self._stamp_s, self._start = pose, stamp_s, None

    def odometry(self, stamp_s: float, pose: Pose2, now_s: float) -> None:
        """Take a pose in `odom`."""
        last_s, last, made_m = self._way[-1] if self._way else (-math.inf, pose, 0.0)
        if stamp_s > last_s and is_possible(stamp_s, now_s) and is_sane(*pose):
            made_m += math.hypot(pose[0] - last[0], pose[1] - last[1])
            self._way.append((stamp_s, pose, made_m))

    def estimate(self, now_s: float) -> Pose2 | None:
        """Return the pose in `map`, bridged if stale; None if it is unknown."""
        if self._pose is None or now_s - self._stamp_s <= self.after_s:
            return self._pose
        way = self._way
        if not way or now_s - way[-1][0] > _ODOMETRY_FRESH_S:
            return None
        self._start = self._start or self._find_start()
        if self._start is None:
            return None
        _, (x0_m, y0_m, yaw0), made0_m = self._start
        _, (x_m, y_m, yaw), made_m = way[-1]
        if made_m - made0_m > self.bridge_m:
            return None
        turn = self._pose[2] - yaw0
        cos, sin = math.cos(turn), math.sin(turn)
        dx, dy = x_m - x0_m, y_m - y0_m
        return (self._pose[0] + dx * cos - dy * sin, self._pose[1] + dx * sin + dy * cos,
                math.remainder(yaw + turn, math.tau))

    def _find_start(self) -> tuple[float, Pose2, float] | None:
        """Return the odometry at the pose's stamp; None if that is no longer kept."""
        after = bisect_right(self._way, self._stamp_s + 1e-6, key=itemgetter(0))
        return self._way[after - 1] if after else None
