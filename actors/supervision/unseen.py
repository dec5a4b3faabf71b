"""Reports of failed tasks and callbacks of an event loop.

asyncio reports a failed task only when its result is read or when it is collected, which may be
never. It reports a failed callback to a log that is not shown. Here each failed callback makes one
line, and the end of a task that should last as long as the loop calls a function.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

_DISTINCT = 100
"""How many different failures of callbacks are reported, each once."""


def watch(task: asyncio.Task[Any], what: str, ended: Callable[[str], None]) -> None:
    """Call `ended` with one line when a task ends without having been cancelled."""

    def done(task: asyncio.Task[Any]) -> None:
        if not task.cancelled():
            error = task.exception()
            ended(f"{what} failed: {describe(error)}" if error else f"{what} ended by itself")

    task.add_done_callback(done)


def report_callbacks(loop: asyncio.AbstractEventLoop, report: Callable[[str], None]) -> None:
    """Call `report` with one line for each exception that a callback of the loop raises."""
    reported: set[str] = set()

    def handle(_loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        error = context.get("exception")
        line = str(context.get("message", "a callback failed")) + (
            f": {describe(error)}" if error else "")
        if line not in reported and len(reported) < _DISTINCT:
            reported.add(line)
            report(line)

    loop.set_exception_handler(handle)


def describe(error: BaseException) -> str:
    """Return an exception in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())
