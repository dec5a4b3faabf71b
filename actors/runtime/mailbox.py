"""One mailbox per actor: latest wins for sensors and states, a bounded queue for commands.

A slow actor thus never works through a backlog of old samples, and never loses a command
silently: a full queue is counted and handed to `on_overflow`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

COMMAND_CAPACITY = 256
"""Commands that may wait per actor; a node that is this far behind is not keeping up."""

MESSAGE_SLOTS = 1024
"""Keys of sensors and states of which a message may wait per actor."""

_OPEN_SHARE = 0.5
"""Of either, for senders that are no nodes of the system; the rest is reserved for its nodes."""


class Mailbox:
    """Items in order of first arrival; a newer item with the same `slot` takes the old one's place.

    All methods run on the actor's event loop.

    Args:
        capacity: Commands that may wait.
        slots: Keys of which a message may wait.
        on_overflow: Called with a message that is refused because too many wait.
        on_item: Called whenever something was put in.

    Attributes:
        waiting: Slots of the items that wait, oldest first; empty if nothing does.
        overflowed: Messages refused because too many waited.
    """

    def __init__(
        self, capacity: int = COMMAND_CAPACITY, on_overflow: Callable[[Any], None] | None = None,
        on_item: Callable[[], None] = lambda: None, slots: int = MESSAGE_SLOTS,
    ) -> None:
        self._capacity = capacity
        self._slots = slots
        self._on_overflow = on_overflow
        self._on_item = on_item
        self.waiting: deque[tuple[str | None, Any]] = deque()
        self._latest: dict[str, Any] = {}
        self._commands = 0
        self.overflowed = 0

    def __len__(self) -> int:
        return len(self.waiting)

    def put_latest(self, slot: str, item: Any) -> None:
        """Add an item of the actor's own, or replace the one that waits in the same slot."""
        if slot not in self._latest:
            self.waiting.append((slot, None))
        self._latest[slot] = item
        self._on_item()

    def put_message(self, slot: str, item: Any, *, reserved: bool = True) -> bool:
        """Add a message of which the latest counts; False if too many others wait.

        Args:
            slot: of its key.
            item: the message.
            reserved: the sender may use all of the room, not only what is open to everybody.
        """
        if slot not in self._latest and len(self._latest) >= self._room(self._slots, reserved):
            return self._refuse(item)
        self.put_latest(slot, item)
        return True

    def put(self, item: Any, *, reserved: bool = True) -> bool:
        """Add a message that must be handled; False if the queue is full.

        Args:
            item: the message.
            reserved: the sender may use all of the room, not only what is open to everybody.
        """
        if self._commands >= self._room(self._capacity, reserved):
            return self._refuse(item)
        self._commands += 1
        self.waiting.append((None, item))
        self._on_item()
        return True

    @staticmethod
    def _room(most: int, reserved: bool) -> int:
        return most if reserved else int(most * _OPEN_SHARE)

    def _refuse(self, item: Any) -> bool:
        self.overflowed += 1
        if self._on_overflow:
            self._on_overflow(item)
        return False

    def take(self) -> Any:
        """Remove and return the oldest item.

        Raises:
            IndexError: the mailbox is empty.
        """
        slot, item = self.waiting.popleft()
        if slot is None:
            self._commands -= 1
            return item
        return self._latest.pop(slot)
