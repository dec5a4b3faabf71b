"""What an actor needs of a bus. `ZenohBus` and `VirtualBus` fulfil it; one suite tests both."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any, Protocol, cast

from rampart.actors.bus.topic import Topic

Deliver = Callable[[str, bytes], None]
"""Called on the event loop with the concrete key and the payload."""

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


class _SharedBus:
    """Passes everything on to a bus that another actor opens and closes."""

    def __init__(self, owner: Bus) -> None:
        self._owner = owner

    async def open(self) -> None:
        """Wait until the owner has opened it."""
        while not self._owner.is_open:  # noqa: ASYNC110 polled, some milliseconds at most
            await asyncio.sleep(_LOOK_S)

    async def close(self) -> None:
        """Leave the session open."""

    def __getattr__(self, name: str) -> Any:
        return getattr(self._owner, name)


def shared(owner: Bus) -> Bus:
    """Return the access of a second actor to the session that another one opens, perhaps later.

    The second one ends first.
    """
    return cast("Bus", _SharedBus(owner))
