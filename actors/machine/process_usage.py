"""What the processes of a run use: processor time, memory, age, as the kernel counts them.

One read of `/proc/PID/stat` a process (proc_pid_stat(5)). Memory is the resident set; nodes are
forked from a spawner that has loaded everything, so most of it is shared and the sum over all
nodes says more than the machine gives.
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
    """What the kernel has counted for one process so far.

    Attributes:
        cpu_s: processor time, in user and kernel mode, of all its threads.
        memory_bytes: resident set.
        started_s: when it was started, on the clock of `CLOCK_BOOTTIME`; with the pid it tells
            two processes apart.
    """

    cpu_s: float
    memory_bytes: int
    started_s: float


@dataclass(frozen=True, slots=True)
class ProcessUsage:
    """What a process uses now.

    Attributes:
        cpu_share: processor time over real time since it was last looked at; 1.0 is one core.
            At the first look, since its start.
        cpu_s: processor time since its start.
        memory_bytes: resident set.
        age_s: real seconds since its start.
    """

    cpu_share: float
    cpu_s: float
    memory_bytes: int
    age_s: float


def read_count(pid: int) -> ProcessCount | None:
    """Return the kernel's counts for a process, None if there is no such process."""
    stat = stat_fields(pid)
    if not stat:
        return None
    user, system, start, pages = (int(stat[i]) for i in (11, 12, 19, 21))
    return ProcessCount((user + system) / _TICKS_PER_S, pages * _PAGE_BYTES, start / _TICKS_PER_S)


class UsageMeter:
    """Looks at processes again and again, and says what they have used since the last look.

    Args:
        read: how to count for one process.
        now: real seconds on the clock of `ProcessCount.started_s`.
    """

    def __init__(
        self, read: Callable[[int], ProcessCount | None] = read_count,
        now: Callable[[], float] = lambda: time.clock_gettime(time.CLOCK_BOOTTIME),
    ) -> None:
        self._read = read
        self._now = now
        self._last: dict[int, tuple[float, ProcessCount]] = {}

    def look(self, pids: Iterable[int]) -> dict[int, ProcessUsage]:
        """Return what those of the processes use that exist; the others are forgotten."""
        before, self._last = self._last, {}
        found = {}
        for pid in pids:
            count = self._read(pid) if pid > 0 else None
            if count is None:
                continue
            now_s = self._now()
            self._last[pid] = (now_s, count)
            since_s, start = before.get(pid, (0.0, None))
            if start is None or start.started_s != count.started_s:  # new, or its number is reused
                since_s, start = count.started_s, ProcessCount(0.0, 0, count.started_s)
            spent_s, span_s = max(0.0, count.cpu_s - start.cpu_s), now_s - since_s
            found[pid] = ProcessUsage(
                spent_s / span_s if span_s > 0 else 0.0, count.cpu_s, count.memory_bytes,
                max(0.0, now_s - count.started_s))
        return found
