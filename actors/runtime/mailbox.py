"""One mailbox per actor, and the dispatcher that handles its items, one at a time.

Latest wins for sensors and states; commands wait in a bounded queue. A slow actor thus never works
through a backlog of old samples, and never loses a command silently: a full queue is counted and
handed to `on_overflow`.

Every item, whether message, tick or change of a peer, in real and in virtual time, is handled by
`Dispatcher.work` and nowhere else.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from typing import Any

COMMAND_CAPACITY = 256
"""Commands that may wait per actor; a node that is this far behind is not keeping up."""

MESSAGE_SLOTS = 1024
"""Keys of sensors and states of which a message may wait per actor."""

_OPEN_SHARE = 0.5
"""Of either, for senders that are no nodes of the system; the rest is reserved for its nodes."""

# What a dispatcher is doing. Numbers, because they are compared and set for each item.
RESTING = 0
"""Nothing, and what comes goes through the mailbox."""
IDLE = 1
"""Nothing, and what comes may be given to `Dispatcher.work` without a stay in the mailbox."""
AWAKE = 2
"""It handles an item, is about to, has not started yet, or has ended."""


class Dispatcher:
    """Holds an actor's items in order of first arrival, and handles one after the other.

    A newer item with the same slot takes the old one's place. Messages that arrive in bursts all
    wait until the burst is over: what is overtaken within one need not be handled. What arrives by
    itself is handled at once. All methods run on the actor's event loop.

    Args:
        bursts: Whether messages arrive in bursts, see `Bus`.
        on_overflow: Called with a message that is refused because too many wait.

    Attributes:
        stance: `RESTING`, `IDLE` or `AWAKE`.
        progress: Items handled so far.
        stopping: It was asked to end, and handles nothing more.
        overflowed: Messages refused because too many waited.
    """

    def __init__(self, bursts: bool, on_overflow: Callable[[Any], None]) -> None:
        self.stance = AWAKE
        self.progress = 0
        self.stopping = False
        self.overflowed = 0
        self._on_overflow = on_overflow
        self._waiting: deque[tuple[str | None, Any]] = deque()
        self._latest: dict[str, Any] = {}
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
        """Handle an item of the actor's own; one that waits is replaced by the next of its slot."""
        if self.stance == AWAKE or self._held:
            self._put_latest(slot, item)
        else:
            self.work(item)

    def put_message(self, slot: str | None, item: Any, *, reserved: bool = True) -> bool:
        """Have a message handled; False if too many others wait.

        Args:
            slot: of its key, if only the latest counts; None for a command, all of which count.
            item: the message.
            reserved: the sender may use all of the room, not only what is open to everybody.
        """
        share = 1.0 if reserved else _OPEN_SHARE
        if slot is None:
            fits = self._commands < COMMAND_CAPACITY * share
        else:
            fits = slot in self._latest or len(self._latest) < MESSAGE_SLOTS * share
        if not fits:
            self.overflowed += 1
            self._on_overflow(item)
        elif slot is None:
            self._commands += 1
            self._waiting.append((None, item))
            self._wake()
        else:
            self._put_latest(slot, item)
        return fits

    def _put_latest(self, slot: str, item: Any) -> None:
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
        """Handle items until `stop` was handled.

        Raises:
            Exception: whatever an item raised.
        """
        self._ended = asyncio.get_running_loop().create_future()
        self.stance = RESTING
        self._wake()
        await self._ended

    def stop(self) -> None:
        """End after the items that already wait."""
        self._put_latest("stop", self._stop)

    def abandon(self) -> None:
        """Handle nothing more, not even what waits."""
        self.stance = AWAKE

    def hold(self, held: bool) -> None:
        """Handle nothing while held."""
        self._held = held
        self._change_rest()
        self._wake()

    def slow_down(self, pace_s: float) -> None:
        """Take so many seconds of the loop's clock for each item."""
        self._pace_s = pace_s
        self._change_rest()

    def _wake(self) -> None:
        """See to it that the mailbox is worked off."""
        if self.stance != AWAKE and self._ended is not None:
            self.stance = AWAKE
            if self._bursts:
                asyncio.get_running_loop().call_soon(self.work)  # after the burst
            else:
                self.work()

    def work(self, item: Callable[[], None] | None = None) -> None:
        """Handle an item, which may be given while `IDLE` only, and then all that wait."""
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
