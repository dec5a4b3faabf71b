"""The C heap of this process, and what the machine may have back of it."""

from __future__ import annotations

import ctypes


def give_back() -> None:
    """Give the machine the pages of the C heap that hold nothing; nothing, where libc cannot.

    glibc keeps what is freed below or between what is in use: malloc_trim(3).
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
