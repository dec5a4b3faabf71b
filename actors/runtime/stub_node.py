"""A node that only sends heartbeats."""

from __future__ import annotations

from rampart.actors.runtime.actor import Actor


class StubNode(Actor):
    """Stands in for a functional node that is not written yet."""
