"""The robot's footprint, and distances from it that are exact where it matters and cheap elsewhere.

An exact distance costs tens of microseconds; the physics of the same 50 ms cost sixty. But no part
of the robot can come nearer to anything by more than it has moved, so after one exact look the
bound "distance then, less the way since" does until it falls below `EXACT_BELOW_M`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from rampart.actors.osmosis.airport.model import rectangle
from rampart.sim.osmosis.robot import CIRCUMRADIUS_M, LENGTH_M, WIDTH_M

EXACT_BELOW_M = 1.0
"""Clearances are exact below this; above it they may be lower bounds."""

Pose = tuple[float, float, float]
"""x m, y m, yaw rad in `map`."""


def footprint(pose: Pose) -> Any:
    """Return the robot's outline on the ground as a shapely polygon in `map`."""
    return rectangle(*pose, LENGTH_M, WIDTH_M)


class Clearance:
    """A distance from the footprint to something that stands still until `forget` is called.

    Args:
        exact: distance for a pose, m.
    """

    def __init__(self, exact: Callable[[Pose], float]) -> None:
        self._exact = exact
        self._pose: Pose = (0.0, 0.0, 0.0)
        self._distance_m = -math.inf

    def forget(self) -> None:
        """Make the next look an exact one."""
        self._distance_m = -math.inf

    def measure(self, pose: Pose) -> float:
        """Return the distance for a pose: exact below `EXACT_BELOW_M`, else a lower bound, m."""
        x_m, y_m, yaw_rad = self._pose
        turned_rad = abs(math.remainder(pose[2] - yaw_rad, math.tau))
        moved_m = math.dist(pose[:2], (x_m, y_m)) + turned_rad * CIRCUMRADIUS_M
        bound_m = self._distance_m - moved_m
        if bound_m > EXACT_BELOW_M:
            return bound_m
        self._pose, self._distance_m = pose, self._exact(pose)
        return self._distance_m
