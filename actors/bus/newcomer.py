"""Latest-value queries of a joining node."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rampart.actors.bus.bus import Bus
from rampart.actors.bus.envelope import Header
from rampart.actors.bus.topic import Topic

PATIENCE_S = 0.02
"""Simulated seconds that one that replaces another waits at most for what was published before."""

_OFTEN_HZ = 7.0
_PERIODS = 3
"""What is published so often at least is of no use to a newcomer when it is so many periods old:
its publisher is silent, and only the next message shows that it is not."""

Handler = Callable[[Any, Header], None]


def unless_silent(topic: Topic[Any], now: Callable[[], float], handler: Handler) -> Handler:
    """Return a handler that is given no message whose publisher has been silent since."""
    if topic.rate_hz < _OFTEN_HZ:
        return handler

    def take(message: Any, header: Header) -> None:
        if now() - header.stamp <= _PERIODS / topic.rate_hz:
            handler(message, header)

    return take


class Questions:
    """What a newcomer has asked: the newest message of each topic that it hears.

    Args:
        bus: by which.
        answered: called when there is an answer to all of them, or none will come.
    """

    def __init__(self, bus: Bus, answered: Callable[[], None]) -> None:
        self._bus = bus
        self._then = answered
        self.open = 0

    def ask(self, key_expression: str, deliver: Callable[[str, bytes], None]) -> None:
        """Ask for the newest message on each key that matches."""
        self.open += 1
        self._bus.latest(key_expression, deliver, self._answered)

    def _answered(self) -> None:
        self.open -= 1
        if self.open == 0:
            self._then()
