"""A bus inside one process, for tests and virtual time: no sockets, no threads, no delay."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable
from typing import Any

from actors.runtime.bus import Deliver, PeerChange
from actors.runtime.topic import Topic


class Hub:
    """What the buses of one virtual system share: subscriptions and living nodes."""

    def __init__(self) -> None:
        self.subscriptions: list[tuple[re.Pattern[str], Deliver, VirtualBus]] = []
        self.alive: dict[str, set[int]] = {}
        self.watchers: list[tuple[str, PeerChange, VirtualBus]] = []

    def announce(self, node: str, incarnation: int, *, alive: bool) -> None:
        """Tell the watchers that a node appeared or vanished."""
        lives = self.alive.setdefault(node, set())
        if alive:
            lives.add(incarnation)
        else:
            lives.discard(incarnation)
        for watched, changed, bus in list(self.watchers):
            if watched == node:
                bus.soon(lambda c=changed: c(node, incarnation, alive))  # type: ignore[misc]


class VirtualBus:
    """One node's access to a `Hub`."""

    def __init__(self, hub: Hub, node: str, incarnation: int = 1) -> None:
        self._hub = hub
        self._node = node
        self._incarnation = incarnation
        self._open = False

    async def open(self) -> None:
        """Join the hub."""
        self._open = True
        self._hub.announce(self._node, self._incarnation, alive=True)

    def soon(self, call: Callable[[], None]) -> None:
        """Run a call on the event loop after the present one, if this bus is open then."""
        asyncio.get_running_loop().call_soon(lambda: call() if self._open else None)

    def publish(self, topic: Topic[Any], key: str, payload: bytes) -> None:  # noqa: ARG002
        """Send to all present subscribers of the key."""
        for pattern, deliver, bus in self._hub.subscriptions:
            if pattern.fullmatch(key):
                bus.soon(lambda d=deliver: d(key, payload))  # type: ignore[misc]

    def subscribe(self, topic: Topic[Any], key_expression: str, deliver: Deliver) -> None:  # noqa: ARG002
        """Have `deliver` called for each message on keys that match."""
        pattern = re.compile(re.escape(key_expression).replace(r"\*", "[^/]+"))
        self._hub.subscriptions.append((pattern, deliver, self))

    def watch(self, node: str, changed: PeerChange) -> None:
        """Have `changed` called now if the node lives, and whenever it appears or vanishes."""
        self._hub.watchers.append((node, changed, self))
        for incarnation in sorted(self._hub.alive.get(node, ())):
            self.soon(lambda i=incarnation: changed(node, i, True))  # type: ignore[misc]

    async def close(self) -> None:
        """Leave the hub."""
        if not self._open:
            return
        self._open = False
        self._hub.subscriptions = [s for s in self._hub.subscriptions if s[2] is not self]
        self._hub.watchers = [w for w in self._hub.watchers if w[2] is not self]
        self._hub.announce(self._node, self._incarnation, alive=False)
