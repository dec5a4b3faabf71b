"""A router of the bus as an actor: its Zenoh session does all the work.

As an actor it is supervised like any node, and its heartbeat passes the session in question.

It never closes that session; SIGTERM ends its process at once (`node_process`). `Session.close`
deletes the router's table of keys while threads still read its links. A message on such a link then
makes Zenoh (1.10.2) panic on stderr, mostly by an `unwrap` in `undeclare_subscriber`. The kernel
closes the links as quickly, and without a panic.
"""

from __future__ import annotations

import ctypes

from rampart.actors.runtime.actor import Actor, Context

_M_MMAP_THRESHOLD = -3  # malloc.h of glibc
LARGE_BYTES = 32_768


def keep_large_apart() -> None:
    """Give each large block its own pages from now on, which return to the kernel when it is freed.

    In the heap, small blocks that stay would fill the space of a freed block, and the next large
    one would take new pages. By default glibc raises the threshold to the size of a freed block
    (mallopt(3)).
    """
    ctypes.CDLL(None).mallopt(_M_MMAP_THRESHOLD, LARGE_BYTES)


class Router(Actor):
    """Forwards the messages of its clients and of the other router (`actors/bus/zenoh_bus.py`)."""

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        keep_large_apart()  # before it has links, whose buffers come and go with its clients
