"""The interface of a bus. `ZenohBus` and `VirtualBus` implement it; one suite tests both."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, cast

from rampart.actors.bus.topic import Topic

Deliver = Callable[[str, bytes], None]
"""Called on the event loop with the concrete key and the payload."""


class BusError(Exception):
    """The bus could not be opened or used; the text is one line for the user."""


class Bus(Protocol):
    """Publish and subscribe on keys.

    Attributes:
        bursts: Whether several messages may be delivered in one turn of the event loop.
    """

    bursts: bool

    async def open(self) -> None:
        """Join the bus; does nothing if it is open.

        Raises:
            BusError: An endpoint is taken or invalid.
        """

    def publish(self, topic: Topic[Any], key: str, payload: bytes) -> None:
        """Send to all present subscribers of the key without waiting."""

    def post(self, key: str, payload: bytes) -> bool:
        """Post a message for the nodes of this host; False if it has to be sent instead."""

    def record(self, key: str, payload: bytes) -> None:
        """Record a message that is posted and not sent, so that a recording has no gaps."""

    def posted(self, key: str) -> bytes | None:
        """Return the newest message posted by a node of this host; None if there is none."""

    def has_readers(self, key: str) -> bool:
        """Whether a key has subscribers now; True if that cannot be known."""

    def subscribe(self, key_expression: str, deliver: Deliver) -> None:
        """Call `deliver` for each message on matching keys."""

    def latest(self, key_expression: str, deliver: Deliver, answered: Callable[[], None]) -> None:
        """Call `deliver` once with the newest message of each matching key.

        Only living publishers answer, and commands are not kept. `answered` is called after the
        last answer or at a timeout.
        """

    def moved(self) -> bool:
        """Whether messages were lost since the last call because a router died.

        True as long as there is no router.
        """

    async def close(self) -> None:
        """Leave the bus. Closing twice is harmless."""


class _SharedBus:
    """Forwards everything but `close`."""

    def __init__(self, owner: Bus) -> None:
        self._owner = owner

    async def close(self) -> None:
        """Leave the session open."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._owner, name)


def shared(owner: Bus) -> Bus:
    """Return a second actor's access to the bus of an actor that ends later."""
    return cast("Bus", _SharedBus(owner))
