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
    """

    def __init__(self, rates_hz: Mapping[str, float], start_s: float, keep_s: float) -> None:
        self._start_s = start_s
        self._keep_s = keep_s
        # Due time, place in the sequence, name, count of periods, period.
        self._queue = [(start_s, place, name, 0, 1.0 / rate_hz)
                       for place, (name, rate_hz) in enumerate(rates_hz.items())]

    def due(self, now_s: float) -> Iterator[tuple[float, str]]:
        """Yield (due time, job) in order of time, up to and including `now_s`."""
        queue, start_s = self._queue, self._start_s
        oldest_s = now_s - self._keep_s
        while queue[0][0] < oldest_s:
            due_s, place, name, count, period_s = queue[0]
            count += int((oldest_s - due_s) / period_s) + 1
            heapreplace(queue, (start_s + count * period_s, place, name, count, period_s))
        while queue[0][0] <= now_s + 1e-9:
            due_s, place, name, count, period_s = queue[0]
            count += 1
            heapreplace(queue, (start_s + count * period_s, place, name, count, period_s))
            yield due_s, name
