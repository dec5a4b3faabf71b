"""Simulated time, the same in every process.

All processes of a run share one origin on the machine's monotonic clock and one rate. So their
`now()` agrees without any message. In virtual time the event loop's time is the simulated time
(origin 0, rate 1).
"""

from __future__ import annotations

import mmap
import os
import struct
import time
from collections.abc import Callable
from pathlib import Path

from rampart.actors.runtime.run_plan import RunPlan


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
            raise ValueError(f"rate = {rate}: expected a number above 0")
        self._origin_s = origin_s
        self.rate = rate
        self._source = source

    def now(self) -> float:
        """Return simulated seconds since the start of the run."""
        return (self._source() - self._origin_s) * self.rate

    def source_time(self, simulated_s: float) -> float:
        """Return the reading of the time source at a simulated time."""
        return self._origin_s + simulated_s / self.rate


class FollowedClock(Clock):
    """Clock of a host that follows the first host's; its origin is in a file, and changes.

    Args:
        file: contains the origin.
        rate: see `Clock`.
        source: see `Clock`.

    Raises:
        OSError: the file cannot be read.
    """

    __slots__ = ("_shared",)

    def __init__(self, file: Path, rate: float = 1.0,
                 source: Callable[[], float] = time.monotonic) -> None:
        descriptor = os.open(file, os.O_RDONLY | os.O_CLOEXEC)
        try:
            self._shared = mmap.mmap(descriptor, _ORIGIN.size, prot=mmap.PROT_READ)
        finally:
            os.close(descriptor)
        super().__init__(self._read(), rate, source)

    def _read(self) -> float:
        origin_s: float = _ORIGIN.unpack_from(self._shared)[0]
        return origin_s

    def now(self) -> float:
        """Return simulated seconds since the start of the run."""
        self._origin_s = self._read()
        return super().now()

    def source_time(self, simulated_s: float) -> float:
        """Return the reading of the time source at a simulated time."""
        self._origin_s = self._read()
        return super().source_time(simulated_s)


_ORIGIN = struct.Struct("d")


def keep_origin(file: Path, origin_s: float) -> None:
    """Set the origin of all clocks that follow a file.

    Raises:
        OSError: the file cannot be written.
    """
    descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        os.pwrite(descriptor, _ORIGIN.pack(origin_s), 0)  # readers see all eight bytes or none
    finally:
        os.close(descriptor)


def origin_file(folder: str) -> Path:
    """Return the file of the origin in a run folder, on a host that follows another."""
    return Path(folder, "origin")


def clock_of(plan: RunPlan, source: Callable[[], float] = time.monotonic) -> Clock:
    """Return this host's clock of a run."""
    if plan.host:
        return FollowedClock(origin_file(plan.folder), plan.rate, source)
    return Clock(plan.origin_s, plan.rate, source)
