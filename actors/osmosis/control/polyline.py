"""Planar geometry of the control nodes: angles, polylines, laser points, the robot's hull.

Frames follow REP-103 and REP-105: `map` for routes and poses, `base_link` (x forward, y left) for
laser points. Route coordinates are (s, n): arc length from the start and lateral offset, left
positive.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from functools import lru_cache

import msgspec
import numpy as np
from numpy.typing import NDArray

Point = tuple[float, float]
Pose2 = tuple[float, float, float]
"""Planar pose: x m, y m, yaw rad."""
Array = NDArray[np.float64]

NO_POINTS: Array = np.zeros((0, 2))
"""An empty set of laser points."""


def wrap_angle(angle_rad: float) -> float:
    """Return the angle in (-pi, pi]."""
    wrapped = math.remainder(angle_rad, math.tau)
    return math.pi if wrapped == -math.pi else wrapped


class Hull(msgspec.Struct, frozen=True):
    """Footprint of the robot: a rectangle centred on `base_link` (Summit XL: 0.72 m by 0.614 m)."""

    length_m: float = 0.72
    width_m: float = 0.614

    @property
    def half_length_m(self) -> float:
        """Distance from the centre to the front."""
        return self.length_m / 2

    @property
    def half_width_m(self) -> float:
        """Distance from the centre to a side."""
        return self.width_m / 2

    @property
    def turning_radius_m(self) -> float:
        """Radius of the disc swept when turning in place."""
        return math.hypot(self.half_length_m, self.half_width_m)

    def distance(self, points: Array) -> Array:
        """Return the signed distance of points in `base_link` to the hull, m; negative inside.

        Args:
            points: shape (..., 2).
        """
        beyond = np.abs(points)
        ahead, aside = beyond[..., 0] - self.half_length_m, beyond[..., 1] - self.half_width_m
        outside = np.hypot(np.maximum(ahead, 0.0), np.maximum(aside, 0.0))
        return np.asarray(outside + np.minimum(np.maximum(ahead, aside), 0.0))


@lru_cache(maxsize=16)
def ray_directions(count: int, angle_min_rad: float, angle_increment_rad: float) -> Array:
    """Return the unit vectors of a sweep's rays in `base_link`, shape (count, 2)."""
    angles = angle_min_rad + angle_increment_rad * np.arange(count)
    return np.column_stack((np.cos(angles), np.sin(angles)))


def to_map(points: Array, x_m: float, y_m: float, yaw_rad: float) -> Array:
    """Transform points from `base_link` at a pose to `map`."""
    if not len(points):
        return points
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.asarray(points @ np.array(((cos, sin), (-sin, cos))) + (x_m, y_m))


class Projection(msgspec.Struct, frozen=True, gc=False):
    """Projection of a point on a polyline: arc length, lateral offset (left positive), segment."""

    s_m: float
    n_m: float
    segment: int


class Polyline:
    """A route as a chain of straight segments in `map`.

    Args:
        points: at least one point; repeated points are merged.

    Attributes:
        points: the distinct points.
        end: the last point.
        length_m: length of the polyline.

    Raises:
        ValueError: no points.
    """

    def __init__(self, points: Sequence[Point]) -> None:
        kept = [points[0]]
        for point in points[1:]:
            if math.dist(point, kept[-1]) > 1e-9:
                kept.append(point)
        self.points: tuple[Point, ...] = tuple(kept)
        self.end = kept[-1]
        if len(kept) == 1:  # a segment of no extent keeps every formula below valid
            kept = [kept[0], (kept[0][0] + 1e-9, kept[0][1])]
        vertices = np.array(kept, dtype=float)
        steps = np.diff(vertices, axis=0)
        self._lengths = np.hypot(steps[:, 0], steps[:, 1])
        self._starts = vertices[:-1]
        self._directions = steps / self._lengths[:, None]
        self._arc = np.concatenate(((0.0,), np.cumsum(self._lengths)))
        # Plain numbers are ten times as fast for single points.
        self._arc_m: list[float] = self._arc.tolist()
        self.length_m = self._arc_m[-1]
        self._segments: list[list[float]] = np.column_stack(
            (self._starts, self._directions, self._lengths)).tolist()

    def point_at(self, s_m: float) -> Point:
        """Return the point at an arc length; the outer segments extend beyond the ends."""
        index = self._segment_at(s_m)
        x_m, y_m, along_x, along_y, _ = self._segments[index]
        beyond_m = s_m - self._arc_m[index]
        return x_m + along_x * beyond_m, y_m + along_y * beyond_m

    def part(self, s_from_m: float, s_to_m: float) -> tuple[Point, ...]:
        """Return the part between two arc lengths, reversed if the second is smaller."""
        low_m, high_m = min(s_from_m, s_to_m), max(s_from_m, s_to_m)
        corners = [self.point_at(s_m) for s_m in self._arc_m if low_m < s_m < high_m]
        way = (self.point_at(low_m), *corners, self.point_at(high_m))
        return way if s_from_m <= s_to_m else way[::-1]

    def heading_at(self, s_m: float) -> float:
        """Return the direction of travel at an arc length, in `map`."""
        _, _, along_x, along_y, _ = self._segments[self._segment_at(s_m)]
        return math.atan2(along_y, along_x)

    def smooth_heading_at(self, s_m: float, span_m: float = 0.6) -> float:
        """Return the direction of travel, which turns gradually within `span_m` of a corner."""
        x_from, y_from = self.point_at(max(s_m - span_m, 0.0))
        x_to, y_to = self.point_at(min(s_m, self.length_m) + span_m)
        if math.hypot(x_to - x_from, y_to - y_from) < 1e-3:
            return self.heading_at(s_m)
        return math.atan2(y_to - y_from, x_to - x_from)

    def _segment_at(self, s_m: float) -> int:
        return min(max(bisect_right(self._arc_m, s_m) - 1, 0), len(self._segments) - 1)

    def _stretch(self, s_from_m: float, s_to_m: float) -> tuple[int, int]:
        """Return the segments of a stretch within the route, as a half-open range."""
        low = self._segment_at(min(max(s_from_m, 0.0), self.length_m))
        high = self._segment_at(min(max(s_to_m, 0.0), self.length_m - 1e-9)) + 1
        return low, max(high, low + 1)

    def coordinates(self, points: Array, s_from_m: float, s_to_m: float) -> Array:
        """Return (s, n) of points in `map`, shape (k, 2), by the nearest segment of a stretch.

        Beside a corner the offset is the signed distance to the corner.

        Args:
            points: shape (k, 2).
            s_from_m: start of the stretch.
            s_to_m: end of the stretch; clipped to the route.
        """
        if not len(points):
            return NO_POINTS
        low, high = self._stretch(s_from_m, s_to_m)
        along_x, along_y = self._directions[low:high].T
        x, y = (points[:, None, :] - self._starts[low:high]).transpose(2, 0, 1)
        ahead = along_x * x + along_y * y
        left = along_x * y - along_y * x
        foot = np.minimum(np.maximum(ahead, 0.0), self._lengths[low:high])
        distance = np.hypot(ahead - foot, left)
        found = np.empty((len(points), 2))
        best = np.argmin(distance, axis=1)
        row = np.arange(len(points))
        off = distance[row, best]
        found[:, 0] = self._arc[low + best] + foot[row, best]
        found[:, 1] = np.where(left[row, best] < 0.0, -off, off)
        return found

    def project(self, x_m: float, y_m: float, near_s_m: float | None = None) -> Projection:
        """Return the projection of a point.

        Args:
            x_m: position in `map`.
            y_m: position in `map`.
            near_s_m: last progress; limits the search to 2 m before and 4 m after it, so that a
                route that comes near itself is not short-cut. None searches the whole route.
        """
        reach = (0.0, self.length_m) if near_s_m is None else (near_s_m - 2.0, near_s_m + 4.0)
        low, high = self._stretch(*reach)
        best = (math.inf, 0.0, 0.0)
        for index in range(low, high):
            x0_m, y0_m, along_x, along_y, length_m = self._segments[index]
            dx_m, dy_m = x_m - x0_m, y_m - y0_m
            ahead_m = along_x * dx_m + along_y * dy_m
            left_m = along_x * dy_m - along_y * dx_m
            foot_m = min(max(ahead_m, 0.0), length_m)
            distance_m = math.hypot(ahead_m - foot_m, left_m)
            if distance_m < best[0]:
                best = (distance_m, self._arc_m[index] + foot_m,
                        -distance_m if left_m < 0.0 else distance_m)
        _, s_m, n_m = best
        return Projection(s_m, n_m, self._segment_at(s_m))
