"""Processor time, memory and age of processes, by `/proc/PID/stat` (proc_pid_stat(5)).

Memory is the resident set. Nodes are forks of a root that has loaded everything and share most of
it, so the sum over all nodes exceeds the memory in use.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from rampart.actors.machine.unix_peer import stat_fields

_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True, slots=True)
class ProcessCount:
    """The kernel's figures for one process.

    Attributes:
        cpu_s: Processor time, in user and kernel mode, of all its threads.
        memory_bytes: Resident set.
        started_s: When it started, by `CLOCK_BOOTTIME`; pid and start identify a process.
    """

    cpu_s: float
    memory_bytes: int
    started_s: float


@dataclass(frozen=True, slots=True)
class ProcessUsage:
    """The present usage of a process.

    Attributes:
        cpu_share: Processor time per real time since the last reading, or since its start; 1.0 is
            one core.
        cpu_s: Processor time since its start.
        memory_bytes: Resident set.
        age_s: Real seconds since its start.
    """

    cpu_share: float
    cpu_s: float
    memory_bytes: int
    age_s: float


def read_count(pid: int) -> ProcessCount | None:
    """Return the kernel's figures for a process, None if there is no such process."""
    stat = stat_fields(pid)
    if not stat:
        return None
    user, system, start, pages = (int(stat[i]) for i in (11, 12, 19, 21))
    return ProcessCount((user + system) / _TICKS_PER_S, pages * _PAGE_BYTES, start / _TICKS_PER_S)


class UsageMeter:
    """Reads processes repeatedly, and returns their usage since the last reading.

    Args:
        read: Returns the figures of one process.
        now: Returns real seconds by the clock of `ProcessCount.started_s`.
    """

    def __init__(
        self, read: Callable[[int], ProcessCount | None] = read_count,
        now: Callable[[], float] = lambda: time.clock_gettime(time.CLOCK_BOOTTIME),
    ) -> None:
        self._read = read
        self._now = now
        self._last: dict[int, tuple[float, ProcessCount]] = {}

    def look(self, pids: Iterable[int]) -> dict[int, ProcessUsage]:
        """Return the usage of those processes that exist, and forget all others."""
        before, self._last = self._last, {}
        found = {}
        for pid in pids:
            count = self._read(pid) if pid > 0 else None
            if count is None:
                continue
            now_s = self._now()
            self._last[pid] = (now_s, count)
            since_s, start = before.get(pid, (0.0, None))
            if start is None or start.started_s != count.started_s:  # new, or its pid is reused
                since_s, start = count.started_s, ProcessCount(0.0, 0, count.started_s)
            spent_s, span_s = max(0.0, count.cpu_s - start.cpu_s), now_s - since_s
            found[pid] = ProcessUsage(
                spent_s / span_s if span_s > 0 else 0.0, count.cpu_s, count.memory_bytes,
                max(0.0, now_s - count.started_s))
        return found
