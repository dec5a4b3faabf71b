"""Where the C library puts what this process asks it for."""

from __future__ import annotations

import ctypes

_M_MMAP_THRESHOLD = -3  # malloc.h of glibc
LARGE_BYTES = 32_768


def keep_large_apart() -> None:
    """Have what is large lie in pages of its own from now on, which go back when it is freed.

    Else the space that it leaves in the heap is filled with what is small and stays, and the next
    large block takes new pages: mallopt(3), without which glibc raises the threshold to the size of
    what was freed. Nothing, where libc cannot.
    """
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    if set_option is not None:
        set_option(_M_MMAP_THRESHOLD, LARGE_BYTES)
