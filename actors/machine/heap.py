"""The heap of the C library."""

from __future__ import annotations

import ctypes

_M_MMAP_THRESHOLD = -3  # malloc.h of glibc
LARGE_BYTES = 32_768


def keep_large_apart() -> None:
    """Give each large block its own pages from now on, which return to the kernel when it is freed.

    In the heap, small blocks that stay would fill the space of a freed block, and the next large
    one would take new pages. By default glibc raises the threshold to the size of a freed block
    (mallopt(3)). A C library without mallopt is left as it is.
    """
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    if set_option is not None:
        set_option(_M_MMAP_THRESHOLD, LARGE_BYTES)
