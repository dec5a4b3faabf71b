"""Blockage: has the robot come to stand before something on its way, and since when?

What counts is progress along the route, not what the follower or the Safety Pilot says about it:
a robot that turns to and fro before a crate is blocked as well as one that waits for it. And it
takes something to see: one that is held by a recovery on an empty runway is not blocked.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from rampart.actors.osmosis.control.polyline import Array, Point, Pose2, to_map
from rampart.actors.osmosis.messages import Blockage


class BlockageLimits(msgspec.Struct, frozen=True):
    """When a robot counts as blocked.

    Args:
        after_s: so long without progress.
        progress_m: so much nearer to the goal along the route is progress.
        reach_m: what blocks is at most so far from the robot's centre.
        half_angle_rad: and at most so far to a side of straight ahead.
    """

    after_s: float = 3.0
    progress_m: float = 0.3
    reach_m: float = 3.0
    half_angle_rad: float = math.radians(60)


class BlockageWatch:
    """Watches one route. All times in simulated seconds.

    Args:
        limits: when the robot counts as blocked.
    """

    def __init__(self, limits: BlockageLimits | None = None) -> None:
        self._limits = limits or BlockageLimits()
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
        if self._since_s is None or to_go_m < self._best_m - self._limits.progress_m:
            self._best_m, self._since_s, self._place = to_go_m, now_s, None
            return None
        if now_s - self._since_s < self._limits.after_s:
            return None
        # What was seen first stays what blocks, lest the place wander as the robot turns.
        self._place = self._place or nearest_ahead(points, pose, self._limits)
        if self._place is None:
            return None
        return Blockage(*self._place, self._since_s)


def nearest_ahead(points: Array, pose: Pose2, limits: BlockageLimits) -> Point | None:
    """Return the nearest echo ahead of the robot as a point in `map`, or None."""
    distance_m = np.hypot(points[:, 0], points[:, 1])
    ahead = np.abs(np.arctan2(points[:, 1], points[:, 0])) <= limits.half_angle_rad
    near = np.flatnonzero(ahead & (distance_m <= limits.reach_m))
    if not len(near):
        return None
    first = near[int(np.argmin(distance_m[near]))]
    x_m, y_m = to_map(points[first:first + 1], *pose)[0].tolist()
    return x_m, y_m
