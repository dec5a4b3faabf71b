"""What a process uses of the machine, as the kernel counts it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


class Usage(NamedTuple):
    """Processor time since its start, s, and resident memory, bytes."""

    processor_s: float
    memory_bytes: int


def read_usage(pid: int) -> Usage | None:
    """Return what a process of this machine uses, None if there is none (Linux: /proc/PID)."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_bytes()
        pages = Path(f"/proc/{pid}/statm").read_bytes().split()[1]
        # The name in brackets may hold anything; field 14 and 15 are utime and stime.
        fields = stat[stat.rindex(b")") + 2:].split()
        return Usage((int(fields[11]) + int(fields[12])) / _TICKS_PER_S, int(pages) * _PAGE_BYTES)
    except (OSError, ValueError, IndexError):
        return None
