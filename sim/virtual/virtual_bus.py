"""A bus inside one process, for virtual time and tests: no sockets, no threads.

What lies between two nodes is up to their `Link`: it says when each copy of a message arrives,
which takes a virtual loop. Without one everything arrives at once, on any loop.
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
"""Sees each message as it is sent: when by the loop's clock, source, key, payload."""

Link = Callable[[float], Sequence[float]]
"""Way from one node to another: returns when the copies of a message sent now arrive, if any."""


PeerChange = Callable[[str, int, bool], None]
"""Called with a node, its incarnation, and whether it is there."""

Route = tuple[Link | None, Deliver, Callable[[Deliver, str, bytes], None]]
"""The link to a reader, what there takes the message, and its bus's `arrive`, for other loops."""


def _pattern(expression: str) -> re.Pattern[str]:
    return re.compile(re.escape(expression).replace(r"\*", "[^/]+"))


class Hub:
    """What the buses of one virtual system share: subscriptions and running nodes.

    Args:
        link: returns the one link from a node to another; None if everything arrives at once.
        several_hosts: the nodes are on several hosts, and so nothing is posted.
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
        """Have messages on keys that match delivered to a bus."""
        self._subscriptions.append((_pattern(expression), deliver, bus))
        self._forget_routes()

    def add(self, bus: VirtualBus) -> None:
        """Know a bus that has been opened."""
        self._buses.append(bus)

    def latest(self, expression: str, deliver: Deliver, reader: VirtualBus) -> None:
        """Send a bus the newest message of each other one on each key that matches."""
        pattern = _pattern(expression)
        for bus in self._buses:
            if bus is not reader:
                route = self._link(bus.node, reader.node), deliver, reader.arrive
                for key in filter(pattern.fullmatch, bus.latest_sent):
                    bus.answer(route, key)

    def watch(self, node: str, changed: PeerChange, bus: VirtualBus) -> None:
        """Have the coming and going of a node told to a bus."""
        self._watchers.append((node, changed, bus))

    def remove(self, bus: VirtualBus) -> None:
        """Forget a bus."""
        self._buses = [b for b in self._buses if b is not bus]
        self._subscriptions = [s for s in self._subscriptions if s[2] is not bus]
        self._watchers = [w for w in self._watchers if w[2] is not bus]
        self._forget_routes()

    def routes_from(self, source: str) -> dict[str, list[Route]]:
        """Return the table of a node's routes by key: always the same object, filled by `route`."""
        return self._routes.setdefault(source, {})

    def route(self, source: str, key: str) -> list[Route]:
        """Return the ways from a node to all who hear a key, in the order of subscription."""
        found = self.routes_from(source)[key] = [
            (self._link(source, bus.node), deliver, bus.arrive)
            for pattern, deliver, bus in self._subscriptions if pattern.fullmatch(key)]
        return found

    def _forget_routes(self) -> None:
        for table in self._routes.values():
            table.clear()

    def announce(self, node: str, incarnation: int, *, alive: bool) -> None:
        """Tell the watchers that a node appeared or vanished."""
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
        latest_sent: By key, except commands.
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
        """Join the hub."""
        self._hub.add(self)
        self._loop = loop = asyncio.get_running_loop()
        self._virtual = loop if isinstance(loop, VirtualLoop) else None
        self._open = True
        self._hub.announce(self.node, self._incarnation, alive=True)

    @property
    def is_open(self) -> bool:
        """Whether it has joined, and not been cut off."""
        return self._open

    def soon(self, call: Callable[[], None]) -> None:
        """Run a call on the event loop after the present one, if this bus is open then."""
        asyncio.get_running_loop().call_soon(lambda: call() if self._open else None)

    def publish(self, topic: Topic[Any], key: str, payload: bytes) -> None:
        """Send to all present subscribers of the key."""
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
        """Put a message where the other nodes look; False if not all nodes are on this host."""
        if self._hub.several_hosts:
            return False
        if self._open:
            self.latest_sent[key] = payload
            self._hub.postings[key] = payload
        return True

    def record(self, key: str, payload: bytes) -> None:
        """Nothing: a virtual run is recorded from what is sent."""

    def posted(self, key: str) -> bytes | None:
        """Return the newest message that was posted on a key."""
        return self._hub.postings.get(key)

    def answer(self, route: Route, key: str) -> None:
        """Send what was published last on a key by one route, past the taps."""
        link, deliver, arrive = route
        payload, virtual = self.latest_sent[key], self._virtual
        if virtual is None:
            asyncio.get_running_loop().call_soon(arrive, deliver, key, payload)
        else:
            for at_s in (virtual.now_s,) if link is None else link(virtual.now_s):
                virtual.post_at(at_s, deliver, key, payload)

    def arrive(self, deliver: Deliver, key: str, payload: bytes) -> None:
        """Hand a message over, if this bus is still open.

        On a virtual loop that is not asked: `cut` takes back what is posted.
        """
        if self._open:
            deliver(key, payload)

    def has_readers(self, key: str) -> bool:
        """Whether any node hears a key now."""
        routes = self._routes.get(key)
        return bool(self._hub.route(self.node, key) if routes is None else routes)

    def subscribe(self, key_expression: str, deliver: Deliver) -> None:
        """Have `deliver` called for each message on keys that match; no other bus may have it."""
        self._readers.append(deliver)
        self._hub.subscribe(key_expression, deliver, self)

    def latest(self, key_expression: str, deliver: Deliver, answered: Callable[[], None]) -> None:
        """Have `deliver` called with the newest message of each node that is there.

        The question takes no time, an answer as long as any message; that there will be no more is
        known after `_ANSWER_S`.
        """
        self._readers.append(deliver)
        self._hub.latest(key_expression, deliver, self)
        loop = asyncio.get_running_loop()
        loop.call_later(_ANSWER_S, lambda: answered() if self._open else None)

    def watch(self, node: str, changed: PeerChange) -> None:
        """Have `changed` called now if the node is there, and whenever it appears or vanishes."""
        self._hub.watch(node, changed, self)
        for incarnation in sorted(self._hub.alive.get(node, ())):
            self.soon(lambda i=incarnation: changed(node, i, True))  # type: ignore[misc]

    def moved(self) -> bool:
        """Never: there are no routers."""
        return False

    def cut(self) -> None:
        """Send and receive nothing any more, as when the process is killed; none is told yet."""
        self._open = False
        self._hub.remove(self)
        if self._virtual is not None:
            self._virtual.withdraw(self._readers)
        self._readers = []

    async def close(self) -> None:
        """Leave the hub."""
        if not self._open:
            return
        self.cut()
        self._hub.announce(self.node, self._incarnation, alive=False)
