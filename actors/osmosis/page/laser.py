"""A sweep of the laser, thinned for the wire: as many points as the eye can use. Pure.

Neighbouring rays are replaced by the nearest echo among them, never by a mean: an obstacle that
only one ray has hit must not vanish from the picture.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rampart.actors.osmosis.messages import LaserScan
from rampart.actors.osmosis.readings import ray_distances

POINTS = 91
"""At most so many are shown of a sweep."""

MAX_RANGE_M = 1000.0
"""Beyond, no laser of a robot has an echo; what says so is wrong."""


def thin(scan: LaserScan | None) -> dict[str, Any] | None:
    """Return a sweep for the page, in `base_link`.

    Returns:
        `from_rad` and `step_rad`, the angle of the first point and between two; `max_m`, the range
        of the laser; `cm`, the ranges in whole centimetres, with -1 where there is no echo. None
        for a sweep that makes no sense (a corrupt one, for instance), and for no sweep.
    """
    if scan is None or len(scan.ranges_f32) % 4 or len(scan.ranges_f32) < 8 \
            or not all(map(math.isfinite, (scan.angle_min_rad, scan.angle_increment_rad))) \
            or not 0 < scan.range_max_m < math.inf:
        return None
    ranges = ray_distances(scan.ranges_f32, scan.range_max_m)
    rays = -(-len(ranges) // POINTS)
    padded = np.full(-(-len(ranges) // rays) * rays, np.inf)
    padded[:len(ranges)] = np.nan_to_num(ranges, nan=np.inf, posinf=np.inf)
    nearest = padded.reshape(-1, rays).min(axis=1)
    echo = nearest < min(scan.range_max_m, MAX_RANGE_M) - 0.005
    centimetres = np.where(echo, np.round(100 * np.where(echo, nearest, 0)), -1).astype(int)
    return {"from_rad": round(scan.angle_min_rad + scan.angle_increment_rad * (rays - 1) / 2, 5),
            "step_rad": round(scan.angle_increment_rad * rays, 6), "max_m": scan.range_max_m,
            "cm": centimetres.tolist()}
