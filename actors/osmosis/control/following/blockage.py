"""Detects whether something on the route blocks the robot, and since when.

The criterion is progress along the route, and not the state of the follower or the Safety Pilot: a
robot that turns back and forth in front of a crate is blocked too. An echo ahead is required: a
robot that a recovery holds on an empty runway is not blocked.
"""

from __future__ import annotations

import math

import numpy as np

from rampart.actors.osmosis.control.polyline import Array, Point, Pose2, to_map
from rampart.actors.osmosis.messages import Blockage

AFTER_S = 3.0
"""Time without progress."""

PROGRESS_M = 0.3
"""Least progress along the route."""

REACH_M = 3.0
"""Greatest distance of the echo from the robot's centre."""

HALF_ANGLE_RAD = math.radians(60)
"""Greatest bearing of the echo."""


class BlockageWatch:
    """Watches one route. Times are simulated seconds."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Restart for another route."""
        self._best_m = math.inf
        self._since_s: float | None = None
        self._place: Point | None = None

    def update(self, to_go_m: float, pose: Pose2, points: Array, now_s: float) -> Blockage | None:
        """Return the blockage, or None.

        Args:
            to_go_m: distance to the goal along the route.
            pose: (x, y, yaw) in `map`.
            points: laser echoes in `base_link`, shape (n, 2).
            now_s: now.
        """
        if self._since_s is None or to_go_m < self._best_m - PROGRESS_M:
            self._best_m, self._since_s, self._place = to_go_m, now_s, None
            return None
        if now_s - self._since_s < AFTER_S:
            return None
        # The first echo stays the blockage, so that its place is stable while the robot turns.
        self._place = self._place or nearest_ahead(points, pose)
        if self._place is None:
            return None
        return Blockage(*self._place, self._since_s)


def nearest_ahead(points: Array, pose: Pose2) -> Point | None:
    """Return the nearest echo ahead of the robot as a point in `map`, or None."""
    distance_m = np.hypot(points[:, 0], points[:, 1])
    ahead = np.abs(np.arctan2(points[:, 1], points[:, 0])) <= HALF_ANGLE_RAD
    near = np.flatnonzero(ahead & (distance_m <= REACH_M))
    if not len(near):
        return None
    first = near[int(np.argmin(distance_m[near]))]
    x_m, y_m = to_map(points[first:first + 1], *pose)[0].tolist()
    return x_m, y_m
