"""One mailbox per actor: latest wins for sensors and states, a bounded queue for commands.

A slow actor thus never works through a backlog of old samples, and never loses a command
silently: a full queue is counted and handed to `on_overflow`.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from typing import Any

COMMAND_CAPACITY = 256
"""Commands that may wait per actor; a node that is this far behind is not keeping up."""


class Mailbox:
    """Items in order of first arrival; a newer item with the same `slot` takes the old one's place.

    All methods run on the actor's event loop.

    Attributes:
        overflowed: Commands refused because too many waited.
        pace_s: Virtual seconds that each item takes; 0, except for a process that is slow.
    """

    def __init__(
        self, capacity: int = COMMAND_CAPACITY, on_overflow: Callable[[Any], None] | None = None
    ) -> None:
        self._capacity = capacity
        self._on_overflow = on_overflow
        self._order: deque[tuple[str | None, Any]] = deque()
        self._latest: dict[str, Any] = {}
        self._commands = 0
        self._waiter: asyncio.Future[None] | None = None
        self._held = False
        self.overflowed = 0
        self.pace_s = 0.0

    def __len__(self) -> int:
        return len(self._order)

    def put_latest(self, slot: str, item: Any) -> None:
        """Add an item, or replace the one that waits in the same slot."""
        if slot not in self._latest:
            self._order.append((slot, None))
        self._latest[slot] = item
        self._wake()

    def put(self, item: Any) -> bool:
        """Add an item that must be handled; False if the queue is full."""
        if self._commands >= self._capacity:
            self.overflowed += 1
            if self._on_overflow:
                self._on_overflow(item)
            return False
        self._commands += 1
        self._order.append((None, item))
        self._wake()
        return True

    def take(self) -> Any:
        """Remove and return the oldest item.

        Raises:
            IndexError: the mailbox is empty.
        """
        slot, item = self._order.popleft()
        if slot is None:
            self._commands -= 1
            return item
        return self._latest.pop(slot)

    async def get(self) -> Any:
        """Wait for an item, remove and return it."""
        if self.pace_s:
            await asyncio.sleep(self.pace_s)
        while not self._order or self._held:
            self._waiter = asyncio.get_running_loop().create_future()
            try:
                await self._waiter
            finally:
                self._waiter = None
        return self.take()

    def hold(self, held: bool) -> None:
        """Give out nothing while held: in virtual time a process that is stopped or wedged."""
        self._held = held
        if self._order:
            self._wake()

    def _wake(self) -> None:
        if self._waiter is not None and not self._held and not self._waiter.done():
            self._waiter.set_result(None)
