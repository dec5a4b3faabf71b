"""Which sensor is due when: periods on one grid, whatever the rhythm of the wake-ups.

The simulator wakes up every 20 ms and the IMU is read every 10 ms, so a wake-up works off several
due times; each reading gets the stamp of its own due time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from heapq import heapreplace


class Schedule:
    """Due times of named periodic jobs.

    Args:
        rates_hz: rate of each job; all of them are first due at `start_s`.
        start_s: time of the first due times.
        keep_s: due times that are older than this when asked for are dropped, so that a
            simulator that was held up publishes fresh readings and not a flood of late ones.

    Raises:
        ValueError: a rate is not positive.
    """

    def __init__(self, rates_hz: Mapping[str, float], start_s: float, keep_s: float) -> None:
        for name, rate_hz in rates_hz.items():
            if not rate_hz > 0:
                raise ValueError(f"schedule: {name}: {rate_hz}: a rate must be positive")
        self._periods = {name: 1.0 / rate_hz for name, rate_hz in rates_hz.items()}
        self._start_s = start_s
        self._keep_s = keep_s
        self._counts = dict.fromkeys(rates_hz, 0)
        self._queue = [(start_s, place, name) for place, name in enumerate(rates_hz)]

    def due(self, now_s: float) -> Iterator[tuple[float, str]]:
        """Yield (due time, job) in order of time, up to and including `now_s`."""
        queue = self._queue
        oldest_s = now_s - self._keep_s
        while queue[0][0] < oldest_s:
            _, place, name = queue[0]
            missed = int((oldest_s - queue[0][0]) / self._periods[name]) + 1
            heapreplace(queue, (self._next_s(name, missed), place, name))
        while queue[0][0] <= now_s + 1e-9:
            due_s, place, name = queue[0]
            heapreplace(queue, (self._next_s(name, 1), place, name))
            yield due_s, name

    def _next_s(self, name: str, periods: int) -> float:
        self._counts[name] += periods
        return self._start_s + self._counts[name] * self._periods[name]
