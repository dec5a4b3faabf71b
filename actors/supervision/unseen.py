"""Nothing that runs on an event loop ends unseen: neither a task nor a callback.

asyncio tells of a task's failure when its result is asked for or when it is collected, which
may be never, and of a callback's on a log that is not shown. Here a failed callback is told in one
line, and the end of a task that is to run as long as the loop is given to those who can act on it.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

_DISTINCT = 100
"""So many different failures of callbacks are told, each once; a flood of them is not."""


def watch(task: asyncio.Task[Any], what: str, ended: Callable[[str], None]) -> None:
    """Have `ended` called with one line when a task ends that was not cancelled."""

    def done(task: asyncio.Task[Any]) -> None:
        if not task.cancelled():
            error = task.exception()
            ended(f"{what} failed: {describe(error)}" if error else f"{what} ended by itself")

    task.add_done_callback(done)


def tell_of_callbacks(loop: asyncio.AbstractEventLoop, tell: Callable[[str], None]) -> None:
    """Have `tell` called with one line for what a callback of the loop raises."""
    told: set[str] = set()

    def handle(_loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        error = context.get("exception")
        line = str(context.get("message", "a callback failed")) + (
            f": {describe(error)}" if error else "")
        if line not in told and len(told) < _DISTINCT:
            told.add(line)
            tell(line)

    loop.set_exception_handler(handle)


def describe(error: BaseException) -> str:
    """Return an exception in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())
