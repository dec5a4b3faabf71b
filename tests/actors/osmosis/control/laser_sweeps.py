"""Sweeps as the shipped robot's laser makes them."""

from __future__ import annotations

import math

import numpy as np

from rampart.actors.osmosis.messages import LaserScan

RAYS = 181
TOP_M = 8.0
STEP_RAD = math.radians(270) / (RAYS - 1)


def full_sweep(range_m: float = TOP_M, number: int = 0) -> LaserScan:
    """Return a sweep with one range in all directions; `number` distinguishes sweeps."""
    return LaserScan(
        -math.radians(135), STEP_RAD, TOP_M, np.full(RAYS, range_m, "<f4").tobytes(),
        0.1 + 0.001 * math.sin(number + 1))
