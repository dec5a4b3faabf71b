"""Is the laser telling the truth? Its reference measurement says so, once a sweep. Pure.

A safety laser measures, besides the world, a target inside its own housing at a known distance,
and real light never gives the same number twice. So a device that repeats itself repeats the
reference to the last bit, also where there is no echo in which one could see it; and one whose
time base or receiver has an error shows it in the reference. (Self-monitoring of this kind is what
IEC 61496-3 asks of such devices; here it is done by who depends on it.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

NO_REFERENCE_M = -1.0
"""What a device reports that has no reference target."""


@dataclass(frozen=True, slots=True)
class LaserLimits:
    """What a healthy laser does.

    Args:
        reference_m: Distance of the reference target.
        tolerance_m: A single measurement is farther off than this only if the device is wrong:
            six standard deviations of a healthy one, once in 10^9 sweeps.
        repeats: So many equal measurements in a row are no coincidence.
        distrust_s: After a wrong one the device is not believed for so long.
    """

    reference_m: float = 0.1
    tolerance_m: float = 0.06
    repeats: int = 4
    distrust_s: float = 1.0


class LaserCheck:
    """Judges sweep by sweep whether the laser can be believed."""

    def __init__(self, limits: LaserLimits | None = None) -> None:
        self._limits = limits or LaserLimits()
        self._last_m = math.nan
        self._equal = 1
        self._distrusted_until_s = -math.inf
        self._why = ""

    def fault(self, reference_m: float, stamp_s: float) -> str:
        """Return why a sweep must not be believed, or an empty text.

        Args:
            reference_m: Its reference measurement; `NO_REFERENCE_M` for a device that makes none,
                which is believed.
            stamp_s: When it was made, simulated seconds.
        """
        if reference_m == NO_REFERENCE_M:
            return ""
        limits = self._limits
        self._equal = self._equal + 1 if reference_m == self._last_m else 1
        self._last_m = reference_m
        off_m = reference_m - limits.reference_m
        if self._equal >= limits.repeats:
            self._distrust(stamp_s, "the laser repeats itself")
        elif not abs(off_m) <= limits.tolerance_m:
            self._distrust(stamp_s, f"the laser's reference is off by {off_m:.2f} m")
        return self._why if stamp_s < self._distrusted_until_s else ""

    def _distrust(self, stamp_s: float, why: str) -> None:
        self._distrusted_until_s, self._why = stamp_s + self._limits.distrust_s, why
