"""Virtual time: an event loop that does not wait but moves its clock to the next timer.

Whatever runs on it is deterministic, since nothing depends on how fast the machine is, and takes
only the time that the work itself takes. The actors do not notice: they know a `Clock`, and the
clock reads `loop.time`.
"""

from __future__ import annotations

import asyncio
import heapq
import selectors
from typing import Any


class _Selector(selectors.DefaultSelector):
    """Asks the kernel only if there is more to ask about than the loop's own wake-up pipe."""

    def select(self, timeout: float | None = None) -> list[Any]:
        if timeout is not None and len(self.get_map()) <= 1:
            return []
        return super().select(timeout)


class VirtualLoop(asyncio.SelectorEventLoop):
    """A loop whose time stands still while it works, and jumps when it would wait."""

    def __init__(self) -> None:
        super().__init__(_Selector())
        self._now = 0.0

    def time(self) -> float:
        """Return virtual seconds since the loop was made."""
        return self._now

    def jump(self, seconds: float) -> None:
        """Let time pass unseen, as for a machine that was suspended."""
        self._now += seconds

    def _run_once(self) -> None:
        # The parent's step with the waiting left out. `_ready`, `_scheduled` and this method are
        # asyncio's own, and have been so in every version from 3.4 to 3.14.
        if not self._ready:  # type: ignore[attr-defined]
            scheduled = self._scheduled  # type: ignore[attr-defined]
            while scheduled and scheduled[0]._cancelled:
                self._timer_cancelled_count -= 1  # type: ignore[attr-defined]
                heapq.heappop(scheduled)._scheduled = False
            if scheduled:
                self._now = max(self._now, scheduled[0]._when)
        super()._run_once()  # type: ignore[misc]
