"""A node that does nothing: its loop turns, its heart beats, and it can be killed."""

from __future__ import annotations

from rampart.actors.runtime.actor import Actor


class StubNode(Actor):
    """Stands for a functional node that is not written yet."""
