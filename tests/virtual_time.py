"""Tests in virtual time, each within a world of its own."""

import functools
import inspect
from collections.abc import Awaitable, Callable
from contextlib import AbstractAsyncContextManager
from typing import Any

from rampart.testing import run

Test = Callable[..., Awaitable[None]]


def within(opened: Callable[[], AbstractAsyncContextManager[Any]]) -> Callable[[Test], Test]:
    """Run a test in virtual time within what `opened` opens, which is its first argument."""
    def of(test: Test) -> Any:
        @functools.wraps(test)
        def lived(**fixtures: Any) -> None:
            async def scenario() -> None:
                async with opened() as world:
                    await test(world, **fixtures)

            run(scenario)

        own = inspect.signature(test)
        lived.__signature__ = own.replace(  # type: ignore[attr-defined]
            parameters=[*own.parameters.values()][1:])
        return lived

    return of
