"""The network of ROS 2 in virtual time, over the virtual bus.

Actors stand in for the nodes of ROS 2 (`rampart.actors.ros2.stand_in`). As with a real session, a
token goes when the process ends that declared it.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from itertools import count
from typing import Any, Protocol

import msgspec
import xxhash

from rampart.actors.bus import topic as bus_topic
from rampart.actors.bus.bus import Bus
from rampart.actors.bus.topic import ROS_SIDE, Topic
from rampart.actors.ros2.side import (
    NO_ANSWER,
    Answered,
    Deliver,
    Reply,
    chunk_of,
    packed,
    recorded_key,
)
from rampart.actors.ros2.wire import Qos

_KEPT = Topic("", msgspec.Struct, bus_topic.Qos.STATE, 0.0, "", "Kept for new subscribers.")
_PASSING = Topic("", msgspec.Struct, bus_topic.Qos.COMMAND, 0.0, "", "Not kept.")

_pack, _unpack = msgspec.msgpack.encode, msgspec.msgpack.decode


class WatchedBus(Bus, Protocol):
    """A bus that knows which nodes are there, as the virtual bus does."""

    @property
    def is_open(self) -> bool:
        """Whether it has joined, and not been cut off."""

    def watch(self, node: str, changed: Callable[[str, int, bool], None]) -> None:
        """Call `changed` now if the node is there, and whenever it appears or vanishes."""


class BusSide:
    """The network of ROS 2 over the bus of an actor; the methods are those of `Side`.

    Args:
        bus: of the actor, open.
        name: of the actor.
        incarnation: of its process.
    """

    def __init__(self, bus: WatchedBus, name: str, incarnation: int) -> None:
        self.id = xxhash.xxh3_64_hexdigest(f"{name} {incarnation}".encode())
        self._bus, self._name, self._incarnation = bus, name, incarnation
        self._tokens: list[str] = []
        self._seen: dict[str, tuple[int, set[str]]] = {}
        self._numbers = count(1)
        self._asked: dict[int, Answered] = {}
        bus.subscribe(f"{ROS_SIDE}/answer/{self.id}", self._answer)

    def token(self, key: str) -> None:
        """See `Side.token`."""
        self._tokens.append(key)
        self._bus.publish(_KEPT, f"{ROS_SIDE}/tokens/{self._name}",
                          _pack((self._name, self._incarnation, self._tokens)))

    def tokens(self, pattern: str, changed: Callable[[str, bool], None]) -> None:
        """See `Side.tokens`; the pattern has to end in `**`."""
        above = pattern.removesuffix("**")

        def declared(_key: str, payload: bytes) -> None:
            name, incarnation, tokens = _unpack(payload)
            before, there = self._seen.get(name, (0, set()))
            if incarnation < before:
                return
            if not before:
                self._bus.watch(name, lambda *what: gone(name, *what[1:]))
            if incarnation > before:
                report(there, alive=False)
                there = set()
            new = {token for token in tokens if token.startswith(above)}
            report(new - there, alive=True)
            self._seen[name] = incarnation, new

        def gone(name: str, incarnation: int, alive: bool) -> None:
            before, there = self._seen[name]
            if not alive and incarnation == before:
                report(there, alive=False)
                self._seen[name] = before, set()

        def report(tokens: set[str], *, alive: bool) -> None:
            for token in sorted(tokens):
                changed(token, alive)

        where = f"{ROS_SIDE}/tokens/*"
        self._bus.subscribe(where, declared)
        self._bus.latest(where, declared, lambda: None)
        report({token for token in self._tokens if token.startswith(above)}, alive=True)

    def publisher(self, key: str, qos: Qos) -> Callable[[bytes, bytes], None]:
        """See `Side.publisher`."""
        topic = _KEPT if qos.transient_local else _PASSING
        where = recorded_key(key)
        return lambda payload, attachment: self._bus.publish(
            topic, where, packed(payload, attachment))

    def subscribe(self, key: str, qos: Qos, deliver: Deliver) -> None:
        """See `Side.subscribe`."""
        where = recorded_key(key)
        self._bus.subscribe(where, lambda _key, whole: deliver(*_unpack(whole)))
        if qos.transient_local:
            self._bus.latest(
                where, lambda _key, whole: deliver(*_unpack(whole)), lambda: None)

    def serve(self, key: str, asked: Callable[[bytes, bytes | None, Reply], None]) -> None:
        """See `Side.serve`."""

        def arrived(_key: str, whole: bytes) -> None:
            client, number, payload, attachment = _unpack(whole)
            asked(payload, attachment, lambda answer, attached: self._bus.publish(
                _PASSING, f"{ROS_SIDE}/answer/{client}", _pack((number, answer, attached))))

        self._bus.subscribe(f"{ROS_SIDE}/ask/{chunk_of(key)}", arrived)

    def ask(self, key: str, payload: bytes, attachment: bytes, timeout_s: float,
            answered: Answered) -> None:
        """See `Side.ask`."""
        number = next(self._numbers)
        self._asked[number] = answered

        def over() -> None:
            late = self._asked.pop(number, None)
            if late is not None and self._bus.is_open:
                late(None, None, NO_ANSWER)

        asyncio.get_running_loop().call_later(timeout_s, over)
        self._bus.publish(_PASSING, f"{ROS_SIDE}/ask/{chunk_of(key)}",
                          _pack((self.id, number, payload, attachment)))

    def _answer(self, _key: str, whole: bytes) -> None:
        number, payload, attachment = _unpack(whole)
        waiting: Any = self._asked.pop(number, None)
        if waiting is not None:
            waiting(payload, attachment, "")

    def is_linked(self) -> bool:
        """See `Side.is_linked`."""
        return True

    def close(self) -> None:
        """See `Side.close`; the bus is the actor's to close."""
