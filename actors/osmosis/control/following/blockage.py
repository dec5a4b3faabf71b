"""Blockage: has the robot come to stand before something on its way, and since when?

What counts is progress along the route, not what the follower or the Safety Pilot says about it:
a robot that turns to and fro before a crate is blocked as well as one that waits for it. And it
takes something to see: one that is held by a recovery on an empty runway is not blocked.
"""

from __future__ import annotations

import math

import numpy as np

from rampart.actors.osmosis.control.polyline import Array, Point, Pose2, to_map
from rampart.actors.osmosis.messages import Blockage

# When a robot counts as blocked.
AFTER_S = 3.0
"""So long without progress."""

PROGRESS_M = 0.3
"""So much nearer to the goal along the route is progress."""

REACH_M = 3.0
"""What blocks is at most so far from the robot's centre."""

HALF_ANGLE_RAD = math.radians(60)
"""And at most so far to a side of straight ahead."""


class BlockageWatch:
    """Watches one route. All times in simulated seconds."""

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Begin anew, for another route."""
        self._best_m = math.inf
        self._since_s: float | None = None
        self._place: Point | None = None

    def update(self, to_go_m: float, pose: Pose2, points: Array, now_s: float) -> Blockage | None:
        """Return what blocks the robot, or None.

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
        # What was seen first stays what blocks, lest the place wander as the robot turns.
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
