"""Whether a figure grows: a slope, and what noise could make of it. Pure.

Samples of one mission have a level of their own, so each is compared with the mean of its mission
alone (fixed effects): what differs between missions is no growth. Neighbouring samples say nearly
the same, so the means of whole minutes are taken. The first five minutes of a mission are left out:
processes begin as copies of the root, and what they share with it becomes their own as they touch
it (all together 310 MB after 5 s, 323 after 4 minutes, 329.1 after 7, 329.7 after 9). The slope is
that of least squares, with 95 % of Student's t; a figure grows if even the low end of it is more
than what counts.
"""

from __future__ import annotations

import math
import statistics
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

BLOCK_S = 60.0
WARM_UP_S = 300.0
LEAST_BLOCKS = 6
"""Below it nothing is said."""


@dataclass(frozen=True, slots=True)
class Sample:
    """A figure at one moment: seconds of the soak, the mission, seconds of that, and its value."""

    at_s: float
    mission: int
    into_s: float
    value: float


@dataclass(frozen=True, slots=True)
class Growth:
    """How a figure changes in an hour; `low` to `high` holds the truth in 95 of 100 cases.

    Attributes:
        what: figure, of whom.
        unit: of it.
        mean: over all blocks.
        slope: in an hour.
        low: end of the interval.
        high: the other one.
        counts: in an hour: less does not matter.
        blocks: of a minute, that it was made of.
    """

    what: str
    unit: str
    mean: float
    slope: float
    low: float
    high: float
    counts: float
    blocks: int

    @property
    def verdict(self) -> str:
        """In words."""
        if self.blocks < LEAST_BLOCKS or not math.isfinite(self.low):
            return "too short to tell"
        if self.low > self.counts:
            return "GROWS"
        if self.low > 0:
            return "grows, less than counts"
        return "within noise"

    def __str__(self) -> str:
        return (f"{self.what:<34} {self.mean:9.1f} {self.unit:<4} {self.slope:+8.2f} an hour "
                f"({self.low:+.2f} to {self.high:+.2f}; {self.counts:g} counts): {self.verdict}")


def growth(what: str, unit: str, samples: Iterable[Sample], counts: float) -> Growth:
    """Return how a figure grows.

    Args:
        what: for people.
        unit: for people.
        samples: of any missions, in any order.
        counts: in an hour: less does not matter.
    """
    blocks: dict[tuple[int, int], list[Sample]] = defaultdict(list)
    for s in samples:
        if s.into_s >= WARM_UP_S:
            blocks[s.mission, int(s.into_s // BLOCK_S)].append(s)
    points: dict[int, list[tuple[float, float]]] = defaultdict(list)
    for (mission, _), some in blocks.items():
        points[mission].append((statistics.fmean(s.at_s / 3600 for s in some),
                                statistics.fmean(s.value for s in some)))
    usable = [p for p in points.values() if len(p) > 1]
    count = sum(map(len, usable))
    mean = statistics.fmean([v for p in usable for _, v in p]) if usable else 0.0
    slope, low, high = _slope(usable)
    return Growth(what, unit, mean, slope, low, high, counts, count)


def _slope(groups: list[list[tuple[float, float]]]) -> tuple[float, float, float]:
    """Return the common slope of groups that have each a level of their own, and its interval."""
    around = []
    for group in groups:
        t, v = (statistics.fmean(column) for column in zip(*group, strict=True))
        around += [(x - t, y - v) for x, y in group]
    free = len(around) - len(groups) - 1
    spread = sum(t * t for t, _ in around)
    if free < 1 or spread <= 0:
        return 0.0, -math.inf, math.inf
    slope = sum(t * v for t, v in around) / spread
    left = sum((v - slope * t) ** 2 for t, v in around)
    half = student(free) * math.sqrt(left / free / spread)
    return slope, slope - half, slope + half


def student(free: int) -> float:
    """Return the 97.5 % quantile of Student's t (Cornish-Fisher; 0.5 % at 5 degrees of freedom)."""
    z = statistics.NormalDist().inv_cdf(0.975)
    exact = {1: 12.706, 2: 4.303, 3: 3.182, 4: 2.776}
    return exact.get(free) or (
        z + (z**3 + z) / (4 * free) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * free**2)
        + (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / (384 * free**3))
