"""A router of the bus as an actor: all that it does is done by its Zenoh session.

So it is supervised like everybody else: its heartbeat goes through the session that it is about.
"""

from __future__ import annotations

from rampart.actors.runtime.actor import Actor


class Router(Actor):
    """Hands on what its clients and the other router send (`rampart.actors.bus.zenoh_bus`)."""
