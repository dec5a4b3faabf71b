"""A router of the bus as an actor: its Zenoh session does all the work.

As an actor it is supervised like any node, and its heartbeat passes the session in question.

It never closes that session; SIGTERM ends its process at once (`node_process`). `Session.close`
deletes the router's table of keys while threads still read its links. A message on such a link then
makes Zenoh (1.10.2) panic on stderr, mostly by an `unwrap` in `undeclare_subscriber`. The kernel
closes the links as quickly, and without a panic.
"""

from __future__ import annotations

from rampart.actors.machine.heap import keep_large_apart
from rampart.actors.runtime.actor import Actor, Context


class Router(Actor):
    """Forwards the messages of its clients and of the other router (`actors/bus/zenoh_bus.py`)."""

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        keep_large_apart()  # before it has links, whose buffers come and go with its clients
