"""One mailbox per actor, and the dispatcher that handles its items, one at a time.

Of sensors and states the latest wins; commands wait in a bounded queue. So a slow actor never works
through a backlog of old samples, and never loses a command silently: each message that is refused
is counted and reported. `Dispatcher.work` handles every item, in real and in virtual time.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from typing import Any

COMMAND_CAPACITY = 256
"""Commands that may wait per actor."""

MESSAGE_SLOTS = 1024
"""Keys of sensors and states with a waiting message, per actor."""

_OPEN_SHARE = 0.5
"""Share of both that senders outside the system may fill; its nodes may fill all."""

# States of a dispatcher. Plain numbers, because each item compares and sets them.
RESTING = 0
"""Not handling an item; the next one goes through the mailbox."""
IDLE = 1
"""Not handling an item; the next one may be given to `Dispatcher.work` at once."""
AWAKE = 2
"""Handling an item or about to; also before the start and after the end."""


class Dispatcher:
    """Holds an actor's items in order of first arrival, and handles one after the other.

    A newer item takes the place of an older one of the same slot. Messages of a burst wait until
    the burst is over, since later ones may replace them. A single message is handled at once. All
    methods run on the actor's event loop.

    Args:
        bursts: whether messages arrive in bursts, see `Bus`.
        on_overflow: called when a message is refused because too many wait.

    Attributes:
        stance: `RESTING`, `IDLE` or `AWAKE`.
        progress: number of items handled.
        stopping: whether `stop` was handled.
        overflowed: number of messages refused because too many waited.
    """

    def __init__(self, bursts: bool, on_overflow: Callable[[], None]) -> None:
        self.stance = AWAKE
        self.progress = 0
        self.stopping = False
        self.overflowed = 0
        self._on_overflow = on_overflow
        self._waiting: deque[tuple[str | None, Any]] = deque()
        self._latest: dict[str, Callable[[], None]] = {}
        self._commands = 0
        self._bursts = bursts
        self._held = False
        self._pace_s = 0.0
        self._at_rest = RESTING if bursts else IDLE
        self._ended: asyncio.Future[None] | None = None

    def __len__(self) -> int:
        return len(self._waiting)

    # -- the mailbox ----------------------------------------------------------------------------

    def put(self, slot: str, item: Callable[[], None]) -> None:
        """Handle an item of the actor itself; a waiting item of the same slot is replaced."""
        if self.stance == AWAKE or self._held:
            self._put_latest(slot, item)
        else:
            self.work(item)

    def put_message(self, slot: str | None, item: Callable[[], None], *,
                    reserved: bool = True) -> None:
        """Handle a message, unless too many others wait.

        Args:
            slot: key, if only the latest message counts; None for a command.
            item: handles the message.
            reserved: whether the sender may use the room that is reserved for the system's nodes.
        """
        share = 1.0 if reserved else _OPEN_SHARE
        if slot is None:
            fits = self._commands < COMMAND_CAPACITY * share
        else:
            fits = slot in self._latest or len(self._latest) < MESSAGE_SLOTS * share
        if not fits:
            self.overflowed += 1
            self._on_overflow()
        elif slot is None:
            self._commands += 1
            self._waiting.append((None, item))
            self._wake()
        else:
            self._put_latest(slot, item)

    def _put_latest(self, slot: str, item: Callable[[], None]) -> None:
        if slot not in self._latest:
            self._waiting.append((slot, None))
        self._latest[slot] = item
        self._wake()

    def _take(self) -> Any:
        slot, item = self._waiting.popleft()
        if slot is None:
            self._commands -= 1
            return item
        return self._latest.pop(slot)

    # -- handling -------------------------------------------------------------------------------

    async def run(self) -> None:
        """Handle items until `stop` is handled.

        Raises:
            Exception: raised by an item.
        """
        self._ended = asyncio.get_running_loop().create_future()
        self.stance = RESTING
        self._wake()
        await self._ended

    def stop(self) -> None:
        """End after the items that are waiting."""
        self._put_latest("stop", self._stop)

    def abandon(self) -> None:
        """Handle nothing more, not even waiting items."""
        self.stance = AWAKE

    def hold(self, held: bool) -> None:
        """Handle nothing while held."""
        self._held = held
        self._change_rest()
        self._wake()

    def slow_down(self, pace_s: float) -> None:
        """Take `pace_s` seconds of the loop's clock for each item."""
        self._pace_s = pace_s
        self._change_rest()

    def _wake(self) -> None:
        if self.stance != AWAKE and self._ended is not None:
            self.stance = AWAKE
            if self._bursts:
                asyncio.get_running_loop().call_soon(self.work)  # after the burst
            else:
                self.work()

    def work(self, item: Callable[[], None] | None = None) -> None:
        """Handle an item, given only while `IDLE`, and then all that wait."""
        self.stance = AWAKE
        waiting = self._waiting
        if item is None:
            if self._ended is None or self._ended.done():
                return
            if self._held or not waiting:
                self.stance = RESTING if self._held else self._at_rest
                return
            item = self._take()
        try:
            while True:
                item()
                self.progress += 1
                if self._pace_s:
                    asyncio.get_running_loop().call_later(self._pace_s, self.work)
                    return  # still awake: whatever arrives meanwhile waits
                if not waiting or self.stopping:
                    break
                item = self._take()
        except Exception as error:
            self._end(error)
            return
        if self.stopping:
            self._end(None)
        else:
            self.stance = self._at_rest

    def _end(self, error: Exception | None) -> None:
        if self._ended is None or self._ended.done():
            return
        if error is None:
            self._ended.set_result(None)
        else:
            self._ended.set_exception(error)

    def _stop(self) -> None:
        self.stopping = True

    def _change_rest(self) -> None:
        direct = not (self._bursts or self._held or self._pace_s)
        self._at_rest = IDLE if direct else RESTING
        if self.stance == IDLE:
            self.stance = self._at_rest
