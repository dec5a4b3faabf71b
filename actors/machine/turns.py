"""How long a process may keep a processor while others of the run wait for it: not long.

The processes of a run are awake for a tenth of a millisecond at a time, and the one that does more
than that, because it is being set up or computes, keeps the others waiting: for up to a whole turn
of the scheduler, 1.4 to 3 ms, though another processor is idle. On two processors a report of a
detection module stood for 1.4 ms behind the process that was to replace the dead one.

Since Linux 6.12 a thread says how long its turns are to be (sched_setattr(2), `sched_runtime`), no
privilege needed, and who asks for short ones is let in before the turn of one with longer ones is
over. It gets no more of the processor for it. What is forked inherits it. Older kernels take no
notice.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import platform
import struct
from collections.abc import Iterator

_SHORT_NS = 200_000
_USUAL_NS = 0
"""What the kernel takes for itself."""

_NUMBERS = {"x86_64": 314, "aarch64": 274, "riscv64": 274, "armv7l": 380, "ppc64le": 355}
"""Of the system call, which the C library has no function for before glibc 2.41."""

_ATTRIBUTES = struct.Struct("IIQiIQQQII")
_NUMBER = _NUMBERS.get(platform.machine(), 0)
_call = ctypes.CDLL(None).syscall


def _ask_for(turn_ns: int) -> None:
    if _NUMBER and os.sched_getscheduler(0) == os.SCHED_OTHER:  # else it was started with another
        nice = os.getpriority(os.PRIO_PROCESS, 0)
        attributes = _ATTRIBUTES.pack(_ATTRIBUTES.size, 0, 0, nice, 0, turn_ns, 0, 0, 0, 0)
        _call(_NUMBER, 0, ctypes.c_char_p(attributes), 0)  # if it may not, it does without


def short() -> None:
    """Ask for short turns for the calling thread, and for what it starts from now on."""
    _ask_for(_SHORT_NS)


@contextlib.contextmanager
def usual() -> Iterator[None]:
    """Have the usual ones in a `with` block: what is started there is none of the run's own."""
    _ask_for(_USUAL_NS)
    try:
        yield
    finally:
        short()
