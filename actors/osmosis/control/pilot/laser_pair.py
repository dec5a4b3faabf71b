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
or not that far, it shows nothing, and nothing looks like free space.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from rampart.actors.ftm.plausible import is_possible
from rampart.actors.osmosis.control.polyline import NO_POINTS, Array, scan_points
from rampart.actors.osmosis.messages import LaserScan

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
    """

    range_m: float
    field_rad: float
    gap_rad: float

    def lack(self, sweep: LaserScan) -> str:
        """Return what a sweep does not cover, or an empty text."""
        count, odd = divmod(len(sweep.ranges_f32), 4)
        first_rad, step_rad = sweep.angle_min_rad, sweep.angle_increment_rad
        last_rad = first_rad + (count - 1) * step_rad
        edge_rad = (self.field_rad - self.gap_rad) / 2
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
