"""Two lasers, one view: what either sees counts, and one that is wrong or silent is left out. Pure.

Each device is judged by its own reference measurement (`LaserCheck`), by what its sweeps cover
(`LaserReach`) and by its age. While both can be believed, an obstacle that one of them misses is
there all the same: where their rays are alike the shorter range counts, else all echoes do. Only
when neither can be believed is there no view.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from rampart.actors.bus.plausible import is_possible
from rampart.actors.osmosis.control.pilot.laser_check import LaserCheck, LaserReach
from rampart.actors.osmosis.control.polyline import NO_POINTS, Array, scan_points
from rampart.actors.osmosis.messages import LaserScan

LOWER, UPPER = 0, 1

_TOGETHER_S = 0.12
"""Sweeps less apart than this make one view: two periods of a laser, and some delay."""


class LaserView(msgspec.Struct, frozen=True):
    """What can be seen.

    Attributes:
        points: Echoes in `base_link`, shape (n, 2), m.
        stamp_s: When they were measured, simulated seconds.
        fault: Why they must not be believed, or an empty text.
    """

    points: Array
    stamp_s: float
    fault: str


class LaserPair:
    """Takes sweeps of either laser, gives the view. A robot with one laser gives only `LOWER`.

    Args:
        reach: What each sweep has to cover.
    """

    def __init__(self, reach: LaserReach) -> None:
        self._reach = reach
        self._checks = (LaserCheck(), LaserCheck())
        self._sweeps: list[LaserScan | None] = [None, None]
        self._stamps_s = [-math.inf, -math.inf]
        self._faults = ["", ""]
        self._seen_s = -math.inf

    def take(self, laser: int, sweep: LaserScan, stamp_s: float, now_s: float) -> LaserView | None:
        """Take a sweep of one laser; return the new view, or None if the present one stays.

        Args:
            laser: `LOWER` or `UPPER`.
            sweep: In `base_link`.
            stamp_s: When it was measured. A sweep from the future, or with a stamp that is no
                number, shows nothing: the view grows old.
            now_s: Now.
        """
        if not is_possible(stamp_s, now_s) or stamp_s < self._seen_s - _TOGETHER_S:
            return None  # late: what the other one has seen since is worth more
        other = 1 - laser
        self._sweeps[laser] = sweep
        self._stamps_s[laser] = stamp_s
        untrue = self._checks[laser].fault(sweep.reference_m, stamp_s)
        self._faults[laser] = untrue or self._reach.lack(sweep)
        partner = self._partner(other, stamp_s)
        if self._faults[laser]:
            # The other one gives the view, as it did; it will be heard as soon as this one.
            return None if partner else LaserView(NO_POINTS, stamp_s, self._faults[laser])
        if laser == UPPER and partner:
            return None  # the lower one's sweeps make the view: twice as often is of no use
        self._seen_s = max(stamp_s, self._seen_s)
        return LaserView(_echoes(sweep, partner), stamp_s, "")

    def _partner(self, laser: int, now_s: float) -> LaserScan | None:
        """Return the last sweep of the other laser if it is of now and can be believed."""
        if self._faults[laser] or abs(now_s - self._stamps_s[laser]) > _TOGETHER_S:
            return None
        return self._sweeps[laser]


def _echoes(sweep: LaserScan, partner: LaserScan | None) -> Array:
    if partner is None or (sweep.ranges_f32 == partner.ranges_f32 and _same_rays(sweep, partner)):
        return _points(sweep)
    if not _same_rays(sweep, partner):
        return np.concatenate((_points(sweep), _points(partner)))
    nearest = np.fmin(np.frombuffer(sweep.ranges_f32, "<f4"),
                      np.frombuffer(partner.ranges_f32, "<f4"))
    return _points(sweep, nearest.tobytes())


def _points(sweep: LaserScan, ranges_f32: bytes | None = None) -> Array:
    return scan_points(sweep.ranges_f32 if ranges_f32 is None else ranges_f32, sweep.angle_min_rad,
                       sweep.angle_increment_rad, sweep.range_max_m)


def _same_rays(a: LaserScan, b: LaserScan) -> bool:
    return (len(a.ranges_f32), a.angle_min_rad, a.angle_increment_rad, a.range_max_m) == (
        len(b.ranges_f32), b.angle_min_rad, b.angle_increment_rad, b.range_max_m)
