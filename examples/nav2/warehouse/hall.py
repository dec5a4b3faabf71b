"""The hall: walls, a rack in its middle, and the way around it. Pure."""

from __future__ import annotations

import math

WIDTH_M, DEPTH_M = 12.0, 8.0
RACK_M = (3.0, 3.0, 9.0, 5.0)
"""x and y of two opposite corners."""

WAY_M = ((1.5, 1.5), (10.5, 1.5), (10.5, 6.5), (1.5, 6.5))
"""Corners of the way around the rack."""

RADIUS_M = 0.3
"""Radius of the robot."""


def clearance_m(x_m: float, y_m: float) -> float:
    """Return the distance of the robot's edge from wall or rack; below 0 it touches."""
    left, low, right, high = RACK_M
    walls_m = min(x_m, y_m, WIDTH_M - x_m, DEPTH_M - y_m)
    aside = max(left - x_m, 0.0, x_m - right)
    above = max(low - y_m, 0.0, y_m - high)
    return min(walls_m, math.hypot(aside, above)) - RADIUS_M


def sweep_m(x_m: float, y_m: float, yaw_rad: float, rays: int, most_m: float) -> list[float]:
    """Return the ranges of a laser, from straight ahead counter-clockwise."""
    found = []
    for ray in range(rays):
        angle = yaw_rad + 2 * math.pi * ray / rays
        dx, dy = math.cos(angle) * 0.05, math.sin(angle) * 0.05
        step, x, y = 0, x_m, y_m
        while step * 0.05 < most_m and clearance_m(x, y) + RADIUS_M > 0:
            step, x, y = step + 1, x + dx, y + dy
        found.append(step * 0.05)
    return found
