"""Two lasers, one view: what either sees counts, and one that is wrong or silent is left out. Pure.

Each device is judged by its own reference measurement (`LaserCheck`), by what its sweeps cover
(`LaserReach`) and by its age. While both can be believed, an obstacle that one of them misses is
there all the same: where their rays are alike the shorter range counts, else all echoes do. Only
when neither can be believed is there no view.

Its reference measurement says whether it measures right, once a sweep.

A safety laser measures, besides the world, a target inside its own housing at a known distance,
and real light never gives the same number twice. So a device that repeats itself repeats the
reference to the last bit, also where there is no echo in which one could see it; and one whose
time base or receiver has an error shows it in the reference. (Self-monitoring of this kind is what
IEC 61496-3 asks of such devices; here it is done by who depends on it.)

A sweep that covers less than the robot's spec says is not believed either: where it does not look,
or not that far, it shows nothing, and nothing looks like free space. A ray that means nothing
(`rampart.actors.osmosis.readings`) does not look either. The other laser's ray takes its place;
where neither knows anything in an angle wider than the spec's gap, there is no view.
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
"""What a device reports that has no reference target."""

REFERENCE_M = 0.1
"""Distance of the reference target."""

TOLERANCE_M = 0.06
"""A single measurement is farther off than this only if the device is wrong: six standard
deviations of a healthy one, once in 10^9 sweeps."""

REPEATS = 4
"""So many equal measurements in a row are no coincidence."""

DISTRUST_S = 1.0
"""After a wrong measurement the device is not believed for so long."""

_TOGETHER_S = 0.12
"""Sweeps less apart than this make one view: two periods of a laser, and some delay."""


class LaserReach(msgspec.Struct, frozen=True):
    """What a sweep covers at least.

    Args:
        range_m: It shows everything up to this distance.
        field_rad: In this angle, half of it on either side of straight ahead.
        gap_rad: With rays no farther apart.
        near_m: Nearer than this a laser has no echo: it would lie within the robot.
    """

    range_m: float
    field_rad: float
    gap_rad: float
    near_m: float = 0.0

    @property
    def edge_rad(self) -> float:
        """Angle to either side at which there has to be a ray, or beyond."""
        return (self.field_rad - self.gap_rad) / 2

    def lack(self, sweep: LaserScan) -> str:
        """Return what a sweep does not cover, or an empty text."""
        count, odd = divmod(len(sweep.ranges_f32), 4)
        first_rad, step_rad = sweep.angle_min_rad, sweep.angle_increment_rad
        last_rad = first_rad + (count - 1) * step_rad
        edge_rad = self.edge_rad
        if odd or not 0 < step_rad <= self.gap_rad:
            return f"the laser's rays are {step_rad:.3g} rad apart, not up to {self.gap_rad:.3g}"
        if not (-math.pi <= first_rad <= -edge_rad and edge_rad <= last_rad <= math.pi):
            return (f"the laser sweeps from {first_rad:.2f} to {last_rad:.2f} rad, not "
                    f"{self.field_rad:.2f} rad around straight ahead")
        if not self.range_m <= sweep.range_max_m < math.inf:
            return f"the laser sees {sweep.range_max_m:.2f} m far, not {self.range_m:.2f} m"
        return ""


class LaserCheck:
    """Judges sweep by sweep whether the laser can be believed."""

    def __init__(self) -> None:
        self._last_m = math.nan
        self._equal = 1
        self._distrusted_until_s = -math.inf
        self._why = ""

    def fault(self, reference_m: float, stamp_s: float) -> str:
        """Return why a sweep must not be believed, or an empty text.

        Args:
            reference_m: Its reference measurement; `NO_REFERENCE_M` for a device that makes none,
                which is believed unless it once made some.
            stamp_s: When it was made, simulated seconds.
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
        points, hole = _seen(self._reach, _rays(sweep), partner and _rays(partner))
        if not hole:
            self._seen_s = max(stamp_s, self._seen_s)
        return LaserView(points, stamp_s, hole)

    def _partner(self, laser: int, now_s: float) -> LaserScan | None:
        """Return the last sweep of the other laser if it is of now and can be believed."""
        if self._faults[laser] or abs(now_s - self._stamps_s[laser]) > _TOGETHER_S:
            return None
        return self._sweeps[laser]


_Rays = tuple[float, float, float, bytes]
"""Of a sweep all that says where echoes are: first angle, step, greatest range, ranges."""


def _rays(sweep: LaserScan) -> _Rays:
    return sweep.angle_min_rad, sweep.angle_increment_rad, sweep.range_max_m, sweep.ranges_f32


@lru_cache(maxsize=8)
def _seen(reach: LaserReach, sweep: _Rays, partner: _Rays | None) -> tuple[Array, str]:
    """Return the echoes of one sweep or two, and where nothing is known, or an empty text.

    The array is read-only: sweeps that come again, as those without any echo do all the time,
    get the same one.
    """
    looks = [(_distances(reach, sweep), *sweep[:2])]
    if partner is not None and partner != sweep:
        other = _distances(reach, partner)
        if sweep[:3] == partner[:3] and len(other) == len(looks[0][0]):
            looks = [(np.fmin(looks[0][0], other), *sweep[:2])]  # of a number and NaN the number
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
    """Return in which angle, wider than the reach allows, nothing is known; else an empty text."""
    unknown = [np.isnan(distances) for distances, *_ in looks]
    if not all(nothing.any() for nothing in unknown):
        return ""  # one sweep is whole, as nearly always
    known = np.sort(np.concatenate([
        first_rad + step_rad * np.flatnonzero(~nothing)
        for nothing, (_, first_rad, step_rad) in zip(unknown, looks, strict=True)]))
    ends = np.concatenate(((-math.inf,), known, (math.inf,)))
    wide = (np.diff(ends) > reach.gap_rad * (1 + 1e-6)) \
        & (ends[:-1] < reach.edge_rad) & (ends[1:] > -reach.edge_rad)
    if not wide.any():
        return ""
    first = int(np.argmax(wide))
    return (f"the laser's ranges mean nothing between {max(ends[first], -math.pi):.2f} and "
            f"{min(ends[first + 1], math.pi):.2f} rad")
