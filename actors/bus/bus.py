"""What an actor needs of a bus. `ZenohBus` and `VirtualBus` fulfil it; one suite tests both."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from rampart.actors.bus.topic import Topic

Deliver = Callable[[str, bytes], None]
"""Called on the event loop with the concrete key and the payload."""

PeerChange = Callable[[str, int, bool], None]
"""Called on the event loop with node, incarnation, and whether it is there."""


class BusError(Exception):
    """The bus could not be opened or used; the text is one line for the user."""


class Bus(Protocol):
    """Publish and subscribe on keys, and know who is there.

    Attributes:
        bursts: Whether several messages may be delivered one after the other before the event
            loop turns again.
    """

    bursts: bool

    async def open(self) -> None:
        """Join the bus and announce this node.

        Raises:
            BusError: an endpoint is taken or invalid.
        """

    def publish(self, topic: Topic[Any], key: str, payload: bytes) -> None:
        """Send to all present subscribers of the key, without waiting for them."""

    def has_readers(self, key: str) -> bool:
        """Whether somebody hears a key now; True if that cannot be known."""

    def subscribe(self, topic: Topic[Any], key_expression: str, deliver: Deliver) -> None:
        """Have `deliver` called for each message on keys that match."""

    def watch(self, node: str, changed: PeerChange) -> None:
        """Have `changed` called now if the node is there, and whenever it appears or vanishes."""

    async def close(self) -> None:
        """Leave the bus. Closing twice is harmless."""
