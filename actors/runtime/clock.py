"""Simulated time, the same in every process.

All processes of a run share one origin on the machine's monotonic clock and one rate, so
`now()` agrees between them without any message. On a virtual event loop the loop's own time is
the simulated time (origin 0, rate 1) and the same class serves.
"""

from __future__ import annotations

import time
from collections.abc import Callable


class Clock:
    """Converts between simulated seconds and the seconds of a time source.

    Args:
        origin_s: reading of `source` at simulated time 0.
        rate: simulated seconds per second of `source`; above 0.
        source: monotonic time source in seconds; an event loop's `time` in actors.

    Attributes:
        rate: simulated seconds per second of the time source.

    Raises:
        ValueError: the rate is not positive.
    """

    __slots__ = ("_origin_s", "_source", "rate")

    def __init__(self, origin_s: float, rate: float = 1.0,
                 source: Callable[[], float] = time.monotonic) -> None:
        if not rate > 0:
            raise ValueError(f"rate = {rate}: must be above 0")
        self._origin_s = origin_s
        self.rate = rate
        self._source = source

    def now(self) -> float:
        """Return simulated seconds since the start of the run."""
        return (self._source() - self._origin_s) * self.rate

    def source_time(self, simulated_s: float) -> float:
        """Return the reading of the time source at a simulated time."""
        return self._origin_s + simulated_s / self.rate
