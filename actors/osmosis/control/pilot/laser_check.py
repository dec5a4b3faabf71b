"""Is the laser telling the truth, and the whole truth? Pure.

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

from rampart.actors.osmosis.messages import LaserScan

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
