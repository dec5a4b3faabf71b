"""A second actor's access to a session that another actor of the same process has opened."""

from __future__ import annotations

from typing import Any

from rampart.actors.bus.bus import Bus, Deliver, PeerChange
from rampart.actors.bus.topic import Topic


class SharedBus:
    """Passes everything on to a bus that somebody else opens and closes.

    For an actor that nobody knows to dial: a node that is respawned dials the owner of the session.

    Args:
        owner: The bus; opened before this one.
    """

    bursts = True

    def __init__(self, owner: Bus) -> None:
        self._owner = owner
        self._open = False

    async def open(self) -> None:
        """Nothing to do: the owner has opened it."""
        self._open = True

    def publish(self, topic: Topic[Any], key: str, payload: bytes) -> None:
        """Send over the owner's session."""
        if self._open:
            self._owner.publish(topic, key, payload)

    def has_readers(self, key: str) -> bool:
        """Whether somebody hears a key, as far as the owner knows."""
        return self._owner.has_readers(key)

    def subscribe(self, topic: Topic[Any], key_expression: str, deliver: Deliver) -> None:
        """Subscribe in the owner's session."""
        self._owner.subscribe(
            topic, key_expression,
            lambda key, payload: deliver(key, payload) if self._open else None)

    def watch(self, node: str, changed: PeerChange) -> None:
        """Watch in the owner's session."""
        self._owner.watch(
            node, lambda *change: changed(*change) if self._open else None)

    async def close(self) -> None:
        """Hear and say nothing more; the session stays open."""
        self._open = False
