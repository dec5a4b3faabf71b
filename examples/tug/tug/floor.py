"""The floor: walls, shelves, stations, and distances to them."""

from __future__ import annotations

import math
from collections.abc import Iterator

RADIUS_M = 0.35
"""Radius of the tug."""

FIELD_M = 0.2
"""Width of the protective field around the tug."""

DOCK, PICK_UP, DROP_OFF = (1.0, 0.9), (7.0, 3.0), (1.0, 3.0)

SOLID = (  # x and y from, x and y to, m: four walls, two shelves
    (-1.0, -1.0, 0.0, 7.0), (8.0, -1.0, 9.0, 7.0), (-1.0, -1.0, 9.0, 0.0), (-1.0, 6.0, 9.0, 7.0),
    (2.0, 1.8, 6.0, 2.2), (2.0, 3.8, 6.0, 4.2))


def _nearest(x_m: float, y_m: float) -> Iterator[tuple[float, float, float]]:
    """Yield the gap to each wall and shelf, and x and y of its nearest point from the tug."""
    for x0, y0, x1, y1 in SOLID:
        dx, dy = min(max(x_m, x0), x1) - x_m, min(max(y_m, y0), y1) - y_m
        yield math.hypot(dx, dy) - RADIUS_M, dx, dy


def clearance_m(x_m: float, y_m: float) -> float:
    """Return the gap between the tug and the nearest obstacle, m."""
    return min(gap_m for gap_m, _, _ in _nearest(x_m, y_m))


def free_m(x_m: float, y_m: float, heading_rad: float) -> float:
    """Return how far it can go straight on with its field free, at most 20 m.

    All obstacles are convex, so only their nearest points count.
    """
    free = 20.0
    for gap_m, dx, dy in _nearest(x_m, y_m):
        towards = math.cos(heading_rad) * dx + math.sin(heading_rad) * dy
        if towards > 0:
            free = min(free, (gap_m - FIELD_M) * math.hypot(dx, dy) / towards)
    return max(0.0, free)
