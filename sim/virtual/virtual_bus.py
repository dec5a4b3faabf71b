"""A bus inside one process, for virtual time and tests: no sockets, no threads.

A `Link` between two nodes decides when each copy of a message arrives; this needs a virtual loop.
Without a link messages arrive at once, on any loop.
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable, Sequence
from typing import Any

from rampart.actors.bus.bus import Deliver
from rampart.actors.bus.topic import Qos, Topic
from rampart.sim.virtual.virtual_loop import VirtualLoop

_ANSWER_S = 0.005

Tap = Callable[[float, str, str, bytes], None]
"""Called with each message that is sent: loop time, source, key, payload."""

Link = Callable[[float], Sequence[float]]
"""Returns the arrival times of the copies of a message that is sent now, if any arrive."""


PeerChange = Callable[[str, int, bool], None]
"""Called with a node, its incarnation, and whether it runs."""

Route = tuple[Link | None, Deliver, Callable[[Deliver, str, bytes], None]]
"""Link to a reader, its callback, and its bus's `arrive`, which other loops use."""


def _pattern(expression: str) -> re.Pattern[str]:
    return re.compile(re.escape(expression).replace(r"\*", "[^/]+"))


class Hub:
    """State shared by the buses of one virtual system: subscriptions and running nodes.

    Args:
        link: Returns the link from one node to another; None if messages arrive at once.
        several_hosts: The nodes are on several hosts, so nothing is posted.
    """

    def __init__(self, link: Callable[[str, str], Link | None] = lambda _source, _reader: None,
                 *, several_hosts: bool = False) -> None:
        self._link = link
        self.taps: list[Tap] = []
        self.several_hosts = several_hosts
        self.postings: dict[str, bytes] = {}
        self.alive: dict[str, set[int]] = {}
        self._subscriptions: list[tuple[re.Pattern[str], Deliver, VirtualBus]] = []
        self._routes: dict[str, dict[str, list[Route]]] = {}
        self._buses: list[VirtualBus] = []
        self._watchers: list[tuple[str, PeerChange, VirtualBus]] = []

    def subscribe(self, expression: str, deliver: Deliver, bus: VirtualBus) -> None:
        """Deliver messages on matching keys to a bus."""
        self._subscriptions.append((_pattern(expression), deliver, bus))
        self._forget_routes()

    def add(self, bus: VirtualBus) -> None:
        """Add a bus that was opened."""
        self._buses.append(bus)

    def latest(self, expression: str, deliver: Deliver, reader: VirtualBus) -> None:
        """Send a bus the latest message of each other bus on each matching key."""
        pattern = _pattern(expression)
        for bus in self._buses:
            if bus is not reader:
                route = self._link(bus.node, reader.node), deliver, reader.arrive
                for key in filter(pattern.fullmatch, bus.latest_sent):
                    bus.answer(route, key)

    def watch(self, node: str, changed: PeerChange, bus: VirtualBus) -> None:
        """Report starts and ends of a node to a bus."""
        self._watchers.append((node, changed, bus))

    def remove(self, bus: VirtualBus) -> None:
        """Remove a bus."""
        self._buses = [b for b in self._buses if b is not bus]
        self._subscriptions = [s for s in self._subscriptions if s[2] is not bus]
        self._watchers = [w for w in self._watchers if w[2] is not bus]
        self._forget_routes()

    def routes_from(self, source: str) -> dict[str, list[Route]]:
        """Return a node's routes by key: always the same dictionary, filled by `route`."""
        return self._routes.setdefault(source, {})

    def route(self, source: str, key: str) -> list[Route]:
        """Return the routes from a node to the subscribers of a key, in order of subscription."""
        found = self.routes_from(source)[key] = [
            (self._link(source, bus.node), deliver, bus.arrive)
            for pattern, deliver, bus in self._subscriptions if pattern.fullmatch(key)]
        return found

    def _forget_routes(self) -> None:
        for table in self._routes.values():
            table.clear()

    def announce(self, node: str, incarnation: int, *, alive: bool) -> None:
        """Report to the watchers that a node started or ended."""
        living = self.alive.setdefault(node, set())
        if alive:
            living.add(incarnation)
        else:
            living.discard(incarnation)
        for watched, changed, bus in list(self._watchers):
            if watched == node:
                bus.soon(lambda c=changed: c(node, incarnation, alive))  # type: ignore[misc]


class VirtualBus:
    """One node's access to a `Hub`.

    Attributes:
        latest_sent: Latest message by key, except commands.
    """

    bursts = False

    def __init__(self, hub: Hub, node: str, incarnation: int = 1) -> None:
        self.node = node
        self.latest_sent: dict[str, bytes] = {}
        self._hub = hub
        self._routes = hub.routes_from(node)
        self._incarnation = incarnation
        self._open = False
        self._readers: list[Deliver] = []
        self._loop: asyncio.AbstractEventLoop | None = None
        self._virtual: VirtualLoop | None = None

    async def open(self) -> None:
        """See `Bus`."""
        self._hub.add(self)
        self._loop = loop = asyncio.get_running_loop()
        self._virtual = loop if isinstance(loop, VirtualLoop) else None
        self._open = True
        self._hub.announce(self.node, self._incarnation, alive=True)

    @property
    def is_open(self) -> bool:
        """Whether it has joined and was not cut off."""
        return self._open

    def soon(self, call: Callable[[], None]) -> None:
        """Run a call in the loop's next turn, if this bus is still open."""
        asyncio.get_running_loop().call_soon(lambda: call() if self._open else None)

    def publish(self, topic: Topic[Any], key: str, payload: bytes) -> None:
        """See `Bus`."""
        loop, virtual, hub = self._loop, self._virtual, self._hub
        if not self._open or loop is None:
            return
        now_s = loop.time() if virtual is None else virtual.now_s
        for tap in hub.taps:
            tap(now_s, self.node, key, payload)
        routes = self._routes.get(key)
        if routes is None:
            routes = hub.route(self.node, key)
        for link, deliver, arrive in routes:
            if virtual is None:
                loop.call_soon(arrive, deliver, key, payload)
            elif link is None:
                virtual.post_at(now_s, deliver, key, payload)
            else:
                for at_s in link(now_s):
                    virtual.post_at(at_s, deliver, key, payload)
        if topic.qos is not Qos.COMMAND:
            self.latest_sent[key] = payload

    def post(self, key: str, payload: bytes) -> bool:
        """See `Bus`."""
        if self._hub.several_hosts:
            return False
        if self._open:
            self.latest_sent[key] = payload
            self._hub.postings[key] = payload
        return True

    def record(self, key: str, payload: bytes) -> None:
        """Do nothing: a virtual run is recorded by a tap."""

    def posted(self, key: str) -> bytes | None:
        """See `Bus`."""
        return self._hub.postings.get(key)

    def answer(self, route: Route, key: str) -> None:
        """Send the latest message on a key by one route; taps do not see it."""
        link, deliver, arrive = route
        payload, virtual = self.latest_sent[key], self._virtual
        if virtual is None:
            asyncio.get_running_loop().call_soon(arrive, deliver, key, payload)
        else:
            for at_s in (virtual.now_s,) if link is None else link(virtual.now_s):
                virtual.post_at(at_s, deliver, key, payload)

    def arrive(self, deliver: Deliver, key: str, payload: bytes) -> None:
        """Deliver a message if this bus is still open.

        A virtual loop delivers directly, because `cut` withdraws pending messages.
        """
        if self._open:
            deliver(key, payload)

    def has_readers(self, key: str) -> bool:
        """See `Bus`."""
        routes = self._routes.get(key)
        return bool(self._hub.route(self.node, key) if routes is None else routes)

    def subscribe(self, key_expression: str, deliver: Deliver) -> None:
        """See `Bus`; no other bus may use the same `deliver`."""
        self._readers.append(deliver)
        self._hub.subscribe(key_expression, deliver, self)

    def latest(self, key_expression: str, deliver: Deliver, answered: Callable[[], None]) -> None:
        """See `Bus`. A query takes no time, an answer the time of a message."""
        self._readers.append(deliver)
        self._hub.latest(key_expression, deliver, self)
        loop = asyncio.get_running_loop()
        loop.call_later(_ANSWER_S, lambda: answered() if self._open else None)

    def watch(self, node: str, changed: PeerChange) -> None:
        """Call `changed` now if the node runs, and at each start and end."""
        self._hub.watch(node, changed, self)
        for incarnation in sorted(self._hub.alive.get(node, ())):
            self.soon(lambda i=incarnation: changed(node, i, True))  # type: ignore[misc]

    def moved(self) -> bool:
        """See `Bus`; a virtual system has no routers."""
        return False

    def cut(self) -> None:
        """Stop sending and receiving, as at a SIGKILL; watchers are not notified yet."""
        self._open = False
        self._hub.remove(self)
        if self._virtual is not None:
            self._virtual.withdraw(self._readers)
        self._readers = []

    async def close(self) -> None:
        """See `Bus`."""
        if not self._open:
            return
        self.cut()
        self._hub.announce(self.node, self._incarnation, alive=False)
