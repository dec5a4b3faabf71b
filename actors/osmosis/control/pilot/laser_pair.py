"""Combines two lasers into one view, and excludes a wrong or silent laser. Pure.

Each laser is checked by its reference measurement (`LaserCheck`), its coverage (`LaserReach`) and
its age. While both are trusted, an echo of either counts: the shorter range if their rays
coincide, else all echoes. If neither is trusted there is no view.

A safety laser also measures a target inside its housing at a known distance, once a sweep. Real
light never gives the same value twice. So a stuck device repeats the reference bit by bit, even
where there is no echo, and an error of its time base or receiver shows in the reference.
(IEC 61496-3 requires such self-monitoring; here the reader does it.)

A sweep with less coverage than the robot's spec is not trusted either: a missing ray would look
like free space. The same holds for invalid rays (`rampart.actors.osmosis.readings`): the other
laser's ray replaces them. If neither laser has a valid ray within an angle wider than the spec's
gap, there is no view.
"""

from __future__ import annotations

import math
from functools import lru_cache

import msgspec
import numpy as np

from rampart.actors.ftm.plausible import is_possible
from rampart.actors.osmosis.control.polyline import NO_POINTS, Array, ray_directions
from rampart.actors.osmosis.messages import LaserScan
from rampart.actors.osmosis.readings import ray_distances

LOWER, UPPER = 0, 1

NO_REFERENCE_M = -1.0
"""Reported by a device without a reference target."""

REFERENCE_M = 0.1
"""Distance of the reference target."""

TOLERANCE_M = 0.06
"""Largest error of a healthy device: six standard deviations, exceeded once in 10^9 sweeps."""

REPEATS = 4
"""Consecutive equal measurements of a stuck device."""

DISTRUST_S = 1.0
"""Time of exclusion after a wrong measurement."""

_TOGETHER_S = 0.12
"""Greatest time between the sweeps of a view: two periods of a laser and a delay."""


class LaserReach(msgspec.Struct, frozen=True):
    """Least coverage of a sweep.

    Args:
        range_m: least range.
        field_rad: field of view, half of it on either side of straight ahead.
        gap_rad: greatest angle between rays.
        near_m: least distance of an echo; a nearer one would lie within the robot.
    """

    range_m: float
    field_rad: float
    gap_rad: float
    near_m: float = 0.0

    @property
    def edge_rad(self) -> float:
        """Least angle of the outermost ray on either side."""
        return (self.field_rad - self.gap_rad) / 2

    def lack(self, sweep: LaserScan) -> str:
        """Return what a sweep does not cover, or ""."""
        count, odd = divmod(len(sweep.ranges_f32), 4)
        first_rad, step_rad = sweep.angle_min_rad, sweep.angle_increment_rad
        last_rad = first_rad + (count - 1) * step_rad
        edge_rad = self.edge_rad
        if odd or not 0 < step_rad <= self.gap_rad:
            return (f"the laser's rays are {step_rad:.3g} rad apart, expected at most "
                    f"{self.gap_rad:.3g} rad")
        if not (-math.pi <= first_rad <= -edge_rad and edge_rad <= last_rad <= math.pi):
            return (f"the laser sweeps from {first_rad:.2f} to {last_rad:.2f} rad, "
                    f"expected {self.field_rad:.2f} rad around straight ahead")
        if not self.range_m <= sweep.range_max_m < math.inf:
            return (f"the laser's range is {sweep.range_max_m:.2f} m, expected at least "
                    f"{self.range_m:.2f} m")
        return ""


class LaserCheck:
    """Checks the reference measurement of each sweep."""

    def __init__(self) -> None:
        self._last_m = math.nan
        self._equal = 1
        self._distrusted_until_s = -math.inf
        self._why = ""

    def fault(self, reference_m: float, stamp_s: float) -> str:
        """Return why a sweep is not trusted, or "".

        Args:
            reference_m: reference measurement; `NO_REFERENCE_M` is trusted only from a device that
                never had one.
            stamp_s: time of the sweep, simulated seconds.
        """
        if reference_m == NO_REFERENCE_M and math.isnan(self._last_m):
            return ""
        self._equal = self._equal + 1 if reference_m == self._last_m else 1
        self._last_m = reference_m
        off_m = reference_m - REFERENCE_M
        repeats = self._equal >= REPEATS
        if repeats or not abs(off_m) <= TOLERANCE_M:
            self._distrusted_until_s = stamp_s + DISTRUST_S
            self._why = "the laser repeats itself" if repeats else (
                f"the laser's reference is off by {off_m:.2f} m")
        return self._why if stamp_s < self._distrusted_until_s else ""


class LaserView(msgspec.Struct, frozen=True):
    """The combined view.

    Attributes:
        points: echoes in `base_link`, shape (n, 2), m.
        stamp_s: time of measurement, simulated seconds.
        fault: why there is no trusted view, or "".
    """

    points: Array
    stamp_s: float
    fault: str


class LaserPair:
    """Combines sweeps. A robot with one laser has only `LOWER`.

    Args:
        reach: least coverage of a sweep.
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
            sweep: in `base_link`.
            stamp_s: time of measurement; a sweep with an invalid stamp or one in the future is
                ignored, so that the view becomes stale.
            now_s: now.
        """
        if not is_possible(stamp_s, now_s) or stamp_s < self._seen_s - _TOGETHER_S:
            return None  # late: the other laser has a newer sweep
        other = 1 - laser
        self._sweeps[laser] = sweep
        self._stamps_s[laser] = stamp_s
        untrue = self._checks[laser].fault(sweep.reference_m, stamp_s)
        self._faults[laser] = untrue or self._reach.lack(sweep)
        partner = self._partner(other, stamp_s)
        if self._faults[laser]:
            # The other laser provides the view.
            return None if partner else LaserView(NO_POINTS, stamp_s, self._faults[laser])
        if laser == UPPER and partner:
            return None  # the view is updated with the sweeps of the lower laser
        points, hole = _seen(self._reach, _rays(sweep), partner and _rays(partner))
        if not hole:
            self._seen_s = max(stamp_s, self._seen_s)
        return LaserView(points, stamp_s, hole)

    def _partner(self, laser: int, now_s: float) -> LaserScan | None:
        """Return the last sweep of a laser if it is fresh and trusted."""
        if self._faults[laser] or abs(now_s - self._stamps_s[laser]) > _TOGETHER_S:
            return None
        return self._sweeps[laser]


_Rays = tuple[float, float, float, bytes]
"""Geometry of a sweep: first angle, step, greatest range, ranges."""


def _rays(sweep: LaserScan) -> _Rays:
    return sweep.angle_min_rad, sweep.angle_increment_rad, sweep.range_max_m, sweep.ranges_f32


@lru_cache(maxsize=8)
def _seen(reach: LaserReach, sweep: _Rays, partner: _Rays | None) -> tuple[Array, str]:
    """Return the echoes of one or two sweeps, and a fault or "".

    Repeated sweeps, such as those without an echo, share the cached, read-only array.
    """
    looks = [(_distances(reach, sweep), *sweep[:2])]
    if partner is not None and partner != sweep:
        other = _distances(reach, partner)
        if sweep[:3] == partner[:3] and len(other) == len(looks[0][0]):
            looks = [(np.fmin(looks[0][0], other), *sweep[:2])]  # ignores NaN
        else:
            looks.append((other, *partner[:2]))
    if hole := _hole(reach, looks):
        return NO_POINTS, hole
    echoes = []
    for distances, *angles in looks:
        echo = np.isfinite(distances)
        if echo.any():
            echoes.append(distances[echo, None] * ray_directions(len(distances), *angles)[echo])
    if not echoes:
        return NO_POINTS, ""
    points = echoes[0] if len(echoes) == 1 else np.concatenate(echoes)
    points.flags.writeable = False
    return points, ""


def _distances(reach: LaserReach, rays: _Rays) -> Array:
    return ray_distances(rays[3], rays[2], reach.near_m)


def _hole(reach: LaserReach, looks: list[tuple[Array, float, float]]) -> str:
    """Return an angle without a valid ray that is wider than the gap, or ""."""
    unknown = [np.isnan(distances) for distances, *_ in looks]
    if not all(nothing.any() for nothing in unknown):
        return ""  # one sweep is complete
    known = np.sort(np.concatenate([
        first_rad + step_rad * np.flatnonzero(~nothing)
        for nothing, (_, first_rad, step_rad) in zip(unknown, looks, strict=True)]))
    ends = np.concatenate(((-math.inf,), known, (math.inf,)))
    wide = (np.diff(ends) > reach.gap_rad * (1 + 1e-6)) \
        & (ends[:-1] < reach.edge_rad) & (ends[1:] > -reach.edge_rad)
    if not wide.any():
        return ""
    first = int(np.argmax(wide))
    return (f"the laser has no valid range between {max(ends[first], -math.pi):.2f} and "
            f"{min(ends[first + 1], math.pi):.2f} rad")
