"""What one that joins asks for, and what one that waits to be a node holds back."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rampart.actors.bus.bus import Bus
from rampart.actors.bus.envelope import Header
from rampart.actors.bus.limits import Remembered
from rampart.actors.bus.topic import Qos, Topic

PATIENCE_S = 0.02
"""Simulated seconds that one that replaces another waits at most for what was published before."""

_OFTEN_HZ = 7.0
_PERIODS = 3
"""What is published so often at least is of no use to a newcomer when it is so many periods old:
its publisher is silent, and only the next message shows that it is not."""

_UNSENT = 256

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


class HeldBack:
    """What one that waits to be a node would have kept and sent: see `Actor.promote`.

    Bounded: the newest message of each topic, and of commands the last.

    Args:
        kind: "warm" if the node's process has ended before; "hot" if there is one, which gives the
            commands itself.
    """

    def __init__(self, kind: str) -> None:
        self._kind = kind
        self._unsent: Remembered[tuple[str, int], tuple[Topic[Any], bytes]] = Remembered(_UNSENT)
        self.keep: Callable[[], None] = lambda: None

    def send(self, topic: Topic[Any], key: str, sequence: int, payload: bytes) -> None:
        """Hold a message back."""
        is_command = topic.qos is Qos.COMMAND
        if not (is_command and self._kind == "hot"):
            self._unsent[key, sequence if is_command else 0] = topic, payload

    def let_go(self, bus: Bus) -> None:
        """Keep the state, and send everything."""
        self.keep()
        if bus.is_open:  # else it announces itself when that is so, or has ended already
            bus.announce()
            for (key, _), (topic, payload) in self._unsent.items():
                bus.publish(topic, key, payload)
