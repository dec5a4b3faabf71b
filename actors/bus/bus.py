"""What an actor needs of a bus. `ZenohBus` and `VirtualBus` fulfil it; one suite tests both.

`SharedBus` is a second actor's access to a session that another actor of the same process opened.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, Protocol

from rampart.actors.bus.topic import Topic

Deliver = Callable[[str, bytes], None]
"""Called on the event loop with the concrete key and the payload."""

"""Called on the event loop with node, incarnation, and whether it is there."""


_LOOK_S = 0.005


class BusError(Exception):
    """The bus could not be opened or used; the text is one line for the user."""


class Bus(Protocol):
    """Publish and subscribe on keys, and know who is there.

    Attributes:
        bursts: Whether several messages may be delivered one after the other before the event
            loop turns again.
    """

    bursts: bool

    @property
    def is_open(self) -> bool:
        """Whether it has been opened, and not closed since."""

    async def open(self) -> None:
        """Join the bus, if that has not been done.

        Raises:
            BusError: an endpoint is taken or invalid.
        """

    def publish(self, topic: Topic[Any], key: str, payload: bytes) -> None:
        """Send to all present subscribers of the key, without waiting for them."""

    def post(self, key: str, payload: bytes) -> bool:
        """Put a message where the nodes of this host look; False if it has to be sent instead."""

    def record(self, key: str, payload: bytes) -> None:
        """Have a message that was posted and is not sent recorded: a recording has no gaps."""

    def posted(self, key: str) -> bytes | None:
        """Return the newest message that was posted by a node of this host; None if none was."""

    def has_readers(self, key: str) -> bool:
        """Whether somebody hears a key now; True if that cannot be known."""

    def subscribe(self, topic: Topic[Any], key_expression: str, deliver: Deliver) -> None:
        """Have `deliver` called for each message on keys that match."""

    def latest(self, key_expression: str, deliver: Deliver, answered: Callable[[], None]) -> None:
        """Have `deliver` called once with the newest message on each key that matches.

        As far as it was published and its publisher is there; commands are not kept. `answered` is
        called after the last of them, or when no answer is waited for any more.
        """

    def after_burst(self, call: Callable[[], None]) -> None:
        """Have `call` made when what has arrived together was delivered; soon if nothing has."""

    def moved(self) -> bool:
        """Whether, since this was last asked, messages were lost because a router has died.

        Also as long as there is none.
        """

    async def close(self) -> None:
        """Leave the bus. Closing twice is harmless."""


class SharedBus:
    """Passes everything on to a bus that another actor opens and closes.

    Args:
        owner: The bus; it is opened by somebody else, perhaps later.
    """

    bursts = True

    def __init__(self, owner: Bus) -> None:
        self._owner = owner
        self._open = False

    async def open(self) -> None:
        """Wait until the owner has opened it."""
        while not self._owner.is_open:  # noqa: ASYNC110 polled, some milliseconds at most
            await asyncio.sleep(_LOOK_S)
        self._open = True

    @property
    def is_open(self) -> bool:
        """Whether it is open."""
        return self._open

    def publish(self, topic: Topic[Any], key: str, payload: bytes) -> None:
        """Send over the owner's session."""
        if self._open:
            self._owner.publish(topic, key, payload)

    def post(self, key: str, payload: bytes) -> bool:
        """Post by the owner."""
        return self._open and self._owner.post(key, payload)

    def record(self, key: str, payload: bytes) -> None:
        """Record by the owner."""
        self._owner.record(key, payload)

    def posted(self, key: str) -> bytes | None:
        """Return what is posted."""
        return self._owner.posted(key)

    def has_readers(self, key: str) -> bool:
        """Whether somebody hears a key, as far as the owner knows."""
        return self._owner.has_readers(key)

    def subscribe(self, topic: Topic[Any], key_expression: str, deliver: Deliver) -> None:
        """Subscribe in the owner's session."""
        self._owner.subscribe(
            topic, key_expression,
            lambda key, payload: deliver(key, payload) if self._open else None)

    def latest(self, key_expression: str, deliver: Deliver, answered: Callable[[], None]) -> None:
        """Ask in the owner's session."""
        self._owner.latest(
            key_expression, lambda key, payload: deliver(key, payload) if self._open else None,
            lambda: answered() if self._open else None)

    def after_burst(self, call: Callable[[], None]) -> None:
        """Have it made after what has arrived in the owner's session."""
        self._owner.after_burst(call)

    def moved(self) -> bool:
        """Whether the owner's session has gone over to another router."""
        return self._owner.moved()

    async def close(self) -> None:
        """Hear and say nothing more; the session stays open."""
        self._open = False
