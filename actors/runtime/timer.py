"""Timers of an actor: single calls that can be cancelled, and periodic calls.

All calls are items of the actor's mailbox.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.mailbox import Dispatcher


class Timer:
    """A pending `call_later`; `cancel` is harmless after it has run."""

    __slots__ = ("_call", "_pending", "handle")

    def __init__(self, call: Callable[[], None], pending: set[Timer]) -> None:
        self._call: Callable[[], None] | None = call
        self._pending = pending
        self.handle: asyncio.TimerHandle | None = None

    def cancel(self) -> None:
        """Prevent the call."""
        self._call = None
        self._pending.discard(self)
        if self.handle is not None:
            self.handle.cancel()

    def fire(self) -> None:
        """Make the call, unless it was cancelled while it waited in the mailbox."""
        call, self._call = self._call, None
        if call is not None:
            call()


class Timers:
    """The timers of one actor; `len` counts the pending calls, without the periodic ones.

    Args:
        clock: simulated time.
        dispatcher: handles the calls.
    """

    def __init__(self, clock: Clock, dispatcher: Dispatcher) -> None:
        self._clock = clock
        self._dispatcher = dispatcher
        self._count = 0
        self._pending: set[Timer] = set()
        self._ended = False
        self._late_s = 0.0

    def __len__(self) -> int:
        return len(self._pending)

    def later(self, delay_s: float, call: Callable[[], None]) -> Timer:
        """Call `call` after `delay_s` simulated seconds."""
        timer = Timer(call, self._pending)
        self._pending.add(timer)
        self._count += 1
        slot = f"later {self._count}"

        def due() -> None:
            self._pending.discard(timer)
            self._dispatcher.put(slot, timer.fire)

        timer.handle = asyncio.get_running_loop().call_at(
            self._clock.source_time(self._clock.now() + delay_s), due)
        return timer

    def every(self, period_s: float, name: str, call: Callable[[], None], *,
              at_once: bool = False) -> None:
        """Call `call` every `period_s` simulated seconds, first after one period or at once.

        Missed calls are skipped.
        """
        loop, clock, slot = asyncio.get_running_loop(), self._clock, f"timer {name}"
        post_at = getattr(loop, "post_at", loop.call_at)  # cheaper, on a virtual loop
        due_s = clock.now() + (0.0 if at_once else period_s)

        def tick(*_: None) -> None:
            nonlocal due_s
            if not self._ended:
                now_s, next_s = clock.now(), due_s + period_s
                self._late_s = max(self._late_s, now_s - due_s)
                due_s = next_s if next_s > now_s else now_s + period_s
                post_at(clock.source_time(due_s), tick, None, None)
                self._dispatcher.put(slot, call)

        post_at(clock.source_time(due_s), tick, None, None)

    def lateness_s(self) -> float:
        """Return the largest delay of a periodic call since the last question, simulated s."""
        late_s, self._late_s = self._late_s, 0.0
        return late_s

    def cancel(self) -> None:
        """Prevent all further calls."""
        self._ended = True
        for timer in list(self._pending):
            timer.cancel()
