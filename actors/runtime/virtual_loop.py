"""Virtual time: an event loop that does not wait but moves its clock to the next timer.

Whatever runs on it is deterministic, since nothing depends on how fast the machine is, and takes
only the time that the work itself takes. The actors do not notice: they know a `Clock`, and the
clock reads `loop.time`.

Calls and timers are kept in leaner objects than asyncio's, because a virtual run consists of
little else: a mission makes a quarter of a million of them. `post_at` does without any.
"""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Callable
from contextvars import Context
from heapq import heappop, heappush
from typing import Any

_STEPS = 100


class _Selector(selectors.DefaultSelector):
    """Counts the files it watches: the loop's own wake-up pipe is one, and need not be asked."""

    files = 0

    def register(self, fileobj: Any, events: int, data: Any = None) -> selectors.SelectorKey:
        self.files += 1
        return super().register(fileobj, events, data)

    def unregister(self, fileobj: Any) -> selectors.SelectorKey:
        self.files -= 1
        return super().unregister(fileobj)


class _Call:
    """A pending call that can be taken back; what asyncio uses of a `Handle`, `TimerHandle`."""

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
    """A loop whose time stands still while it works, and jumps when it would wait.

    Callbacks run in the order in which they become due, and in that of scheduling if at once.
    """

    def __init__(self) -> None:
        self._files = _Selector()
        super().__init__(self._files)
        self._now = 0.0
        self._count = 0
        # When, count, and what to call: a `_Call` without arguments, or a callback with its own.
        self._timers: list[tuple[float, int, Any, tuple[Any, ...] | None]] = []

    def time(self) -> float:
        """Return virtual seconds since the loop was made."""
        return self._now

    def jump(self, seconds: float) -> None:
        """Let time pass unseen, as for a machine that was suspended."""
        self._now += seconds

    def call_soon(  # type: ignore[override] # what comes back does what a Handle does
        self, callback: Any, *args: Any, context: Context | None = None
    ) -> Any:
        """As asyncio's."""
        call = _Call(callback, args, context, self._now)
        self._ready.append(call)  # type: ignore[attr-defined]
        return call

    def call_soon_threadsafe(  # type: ignore[override]
        self, callback: Any, *args: Any, context: Context | None = None
    ) -> Any:
        """As asyncio's."""
        call = self.call_soon(callback, *args, context=context)
        self._write_to_self()  # type: ignore[attr-defined]
        return call

    def call_later(  # type: ignore[override]
        self, delay: float, callback: Any, *args: Any, context: Context | None = None
    ) -> Any:
        """As asyncio's."""
        return self.call_at(self._now + delay, callback, *args, context=context)

    def call_at(  # type: ignore[override]
        self, when: float, callback: Any, *args: Any, context: Context | None = None
    ) -> Any:
        """As asyncio's."""
        call = _Call(callback, args, context, when)
        self._count = count = self._count + 1
        heappush(self._timers, (when, count, call, None))
        return call

    def post_at(self, when: float, callback: Callable[..., object], *args: Any) -> None:
        """As `call_at`, for a call that nobody will take back: cheaper."""
        self._count = count = self._count + 1
        heappush(self._timers, (when, count, callback, args))

    def _run_once(self) -> None:
        # asyncio's own step, called by `run_forever`, with the waiting left out; and many steps in
        # one, since a call of this method costs as much as a call of a callback.
        ready, files = self._ready, self._files  # type: ignore[attr-defined]
        for _ in range(_STEPS):
            if files.files > 1:
                self._process_events(files.select(0))  # type: ignore[attr-defined]
            if ready:
                for _ in range(len(ready)):
                    self._make(ready.popleft())
            elif not self._next_moment():
                # All that is left to come is from a file or another thread.
                self._process_events(files.select(0 if self._stopping else None))  # type: ignore[attr-defined]
            if self._stopping:  # type: ignore[attr-defined]
                return

    def _next_moment(self) -> bool:
        """Move the clock to the next timer and make all calls due then; False if there is none."""
        timers = self._timers
        while timers:
            when, _, callback, args = heappop(timers)
            if args is not None or not callback._cancelled:
                break
        else:
            return False
        now = self._now = when if when > self._now else self._now
        last = self._count  # what these calls schedule for now waits until those ready are made
        while True:
            if args is None:
                self._make(callback)
            else:
                try:
                    callback(*args)
                except (SystemExit, KeyboardInterrupt):
                    raise
                except BaseException as error:
                    self._report(callback, error)
            if not timers or timers[0][0] > now or timers[0][1] > last:
                return True
            _, _, callback, args = heappop(timers)

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
