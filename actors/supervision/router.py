"""A router of the bus as an actor: all that it does is done by its Zenoh session.

So it is supervised like everybody else: its heartbeat goes through the session that it is about.

It never closes that session; SIGTERM ends its process (`node_process`). `Session.close` takes the
router's table of keys apart while threads still read its links, and what comes on one of them then
finds a key without its context: Zenoh (1.10.2) panics, on stderr, with an `unwrap` in
`undeclare_subscriber` as a rule. The kernel closes the links as soon, and harms nobody.
"""

from __future__ import annotations

from rampart.actors.machine.heap import keep_large_apart
from rampart.actors.runtime.actor import Actor, Context


class Router(Actor):
    """Hands on what its clients and the other router send (`rampart.actors.bus.zenoh_bus`)."""

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        keep_large_apart()  # before it has links: their buffers come and go with its clients
