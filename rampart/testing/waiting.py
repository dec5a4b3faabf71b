"""Wait for a condition, within a time."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

NOT_IN_TIME = "it did not happen in time"


async def eventually(condition: Callable[[], bool], timeout_s: float = 10.0,
                     what: str = NOT_IN_TIME) -> None:
    """Wait until a condition holds, in the loop's time; a virtual loop does not really wait.

    Raises:
        AssertionError: It does not within `timeout_s`; the text is `what`.
    """
    loop = asyncio.get_running_loop()
    deadline = loop.time() + timeout_s
    while not condition():
        if loop.time() >= deadline:
            raise AssertionError(what)
        await asyncio.sleep(0.005)


def wait_until(condition: Callable[[], bool], timeout_s: float = 10.0,
               what: str | Callable[[], str] = NOT_IN_TIME) -> None:
    """Wait, outside of any event loop, until a condition holds.

    Raises:
        AssertionError: It does not within `timeout_s`; the text is `what`.
    """
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() >= deadline:
            raise AssertionError(what if isinstance(what, str) else what())
        time.sleep(0.01)
