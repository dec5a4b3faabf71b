"""Virtual time: an event loop that does not wait but moves its clock to the next timer.

A run on this loop is deterministic, because nothing depends on the speed of the machine, and takes
only the time of its computations. Actors read a `Clock`, and the clock reads `loop.time`.

Calls and timers are leaner objects than asyncio's, because a mission makes a quarter of a million
of them. Messages and ticks need no object: they are posted with two arguments and stay in the heap.
"""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Callable, Iterable
from contextvars import Context
from heapq import heapify, heappop, heappush
from typing import Any

from rampart.actors.runtime.clock import Clock

Posted = Callable[[Any, Any], object]
"""A call that is posted with both its arguments."""


class _Call:
    """A pending call that can be cancelled; the part of asyncio's handles that asyncio uses."""

    __slots__ = ("_args", "_callback", "_cancelled", "_context", "_when")

    def __init__(self, callback: Callable[..., object], args: tuple[Any, ...],
                 context: Context | None, when: float) -> None:
        self._callback = callback
        self._args = args
        self._context = context
        self._when = when
        self._cancelled = False

    def cancel(self) -> None:
        self._cancelled = True

    def cancelled(self) -> bool:
        return self._cancelled

    def when(self) -> float:
        return self._when


class VirtualLoop(asyncio.SelectorEventLoop):
    """A loop whose time stands still during callbacks and jumps where it would wait.

    Callbacks run in the order of their times, and for equal times in the order of scheduling.

    Attributes:
        now_s: The value of `time`, for frequent callers.
    """

    def __init__(self) -> None:
        self._files = selectors.DefaultSelector()
        super().__init__(self._files)
        self._watched = self._files.get_map()
        self.now_s = 0.0
        self._count = 0
        # When, count, a posted callback and its arguments; or instead of these None, a `_Call`.
        self._timers: list[tuple[float, int, Posted | None, Any, Any]] = []

    def time(self) -> float:
        """Return virtual seconds since the loop was made."""
        return self.now_s

    def jump(self, seconds: float) -> None:
        """Advance time without running timers, as if the machine was suspended."""
        self.now_s += seconds

    def call_soon(self, callback: Any, *args: Any,  # type: ignore[override]
                  context: Context | None = None) -> Any:
        """As asyncio's; the result has the methods of a Handle."""
        call = _Call(callback, args, context, self.now_s)
        self._ready.append(call)  # type: ignore[attr-defined]
        return call

    def call_soon_threadsafe(self, callback: Any, *args: Any,  # type: ignore[override]
                             context: Context | None = None) -> Any:
        """As asyncio's."""
        call = self.call_soon(callback, *args, context=context)
        self._write_to_self()  # type: ignore[attr-defined]
        return call

    def call_later(self, delay: float, callback: Any, *args: Any,  # type: ignore[override]
                   context: Context | None = None) -> Any:
        """As asyncio's."""
        return self.call_at(self.now_s + delay, callback, *args, context=context)

    def call_at(self, when: float, callback: Any, *args: Any,  # type: ignore[override]
                context: Context | None = None) -> Any:
        """As asyncio's."""
        call = _Call(callback, args, context, when)
        self._count = count = self._count + 1
        heappush(self._timers, (when, count, None, call, None))
        return call

    def post_at(self, when: float, callback: Posted, first: Any, second: Any) -> None:
        """As `call_at` with two arguments, for a call that is not taken back alone: cheaper."""
        self._count = count = self._count + 1
        heappush(self._timers, (when, count, callback, first, second))

    def withdraw(self, callbacks: Iterable[Posted]) -> None:
        """Take back all posted calls of some callbacks, the very objects that were posted."""
        gone = {id(callback) for callback in callbacks}
        self._timers[:] = [timer for timer in self._timers if id(timer[2]) not in gone]
        heapify(self._timers)

    def _run_once(self) -> None:
        # asyncio's own step, called by `run_forever`, with the waiting left out.
        ready, files = self._ready, self._files  # type: ignore[attr-defined]
        if len(self._watched) > 1:  # one is the loop's own wake-up pipe
            self._process_events(files.select(0))  # type: ignore[attr-defined]
        if ready:
            for _ in range(len(ready)):
                self._make(ready.popleft())
        elif self._timers:
            self._let_time_pass()
        else:
            # All that is left to come is from a file or another thread.
            self._process_events(files.select(0 if self._stopping else None))  # type: ignore[attr-defined]

    def _let_time_pass(self) -> None:
        """Move the clock from timer to timer and make all calls due, while nothing else is."""
        timers, ready = self._timers, self._ready  # type: ignore[attr-defined]
        while timers:
            when, _, callback, first, second = heappop(timers)
            if callback is None and first._cancelled:
                continue  # and no time passes
            now_s = self.now_s = when if when > self.now_s else self.now_s
            last = self._count  # what these calls schedule for now waits until those ready are made
            while True:
                if callback is None:
                    self._make(first)
                else:
                    try:
                        callback(first, second)
                    except (SystemExit, KeyboardInterrupt):
                        raise
                    except BaseException as error:
                        self._report(callback, error)
                if not timers or timers[0][0] > now_s or timers[0][1] > last:
                    break
                _, _, callback, first, second = heappop(timers)
            if ready or self._stopping or len(self._watched) > 1:  # type: ignore[attr-defined]
                return

    def _make(self, call: _Call) -> None:
        if call._cancelled:
            return
        try:
            if call._context is None:
                call._callback(*call._args)
            else:
                call._context.run(call._callback, *call._args)
        except (SystemExit, KeyboardInterrupt):
            raise
        except BaseException as error:
            self._report(call._callback, error)

    def _report(self, callback: Any, error: BaseException) -> None:
        self.call_exception_handler({
            "message": f"Exception in callback {callback!r}", "exception": error})


class VirtualClock(Clock):
    """The clock of a virtual loop, optimised for frequent reads.

    Args:
        loop: whose time it shows.
        origin_s: the loop's time at simulated time 0.
    """

    __slots__ = ("_loop",)

    def __init__(self, loop: VirtualLoop, origin_s: float) -> None:
        super().__init__(origin_s, 1.0, loop.time)
        self._loop = loop

    def now(self) -> float:
        """Return simulated seconds since the start of the run."""
        return self._loop.now_s - self._origin_s

    def source_time(self, simulated_s: float) -> float:
        """Return the loop's time at a simulated time."""
        return self._origin_s + simulated_s
