"""The bus over Zenoh: a partial mesh of peers on loopback, no router, no rendezvous.

Every actor listens on its own fixed port and at its start dials the actors that it shares a
topic with. Who starts later dials who is there already, so a respawned actor is connected to
all its partners by the time `open` returns, no process is a single point of failure, and the
opening costs about 1.3 ms per partner (a full mesh of 22 costs three times as much).

Zenoh calls back on threads of its own. They only append to a deque and wake the event loop once
per burst; everything else happens on the loop.
"""

from __future__ import annotations

import asyncio
import json
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import zenoh

from actors.runtime.bus import BusError, Deliver, PeerChange
from actors.runtime.tap import Tap
from actors.runtime.topic import ROOT, Qos, Topic

LEASE_MS = 2000
"""A link that is silent for so long is closed; a stopped process is found sooner by heartbeat."""

_ALIVE = f"{ROOT}/alive"
_PRIORITY = {
    Qos.SENSOR: zenoh.Priority.DATA,
    Qos.STATE: zenoh.Priority.INTERACTIVE_HIGH,
    Qos.COMMAND: zenoh.Priority.INTERACTIVE_HIGH,
}


def endpoint(port: int) -> str:
    """Return the Zenoh endpoint of a loopback port."""
    return f"tcp/127.0.0.1:{port}"


def session_config(listen: str | None, dial: Sequence[str]) -> zenoh.Config:
    """Return the configuration of a session that finds others only where it is told."""
    config = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": "peer",
        "listen/endpoints": [listen] if listen else [],
        "listen/exit_on_failure": True,
        "connect/endpoints": list(dial),
        "connect/timeout_ms": 0,  # one attempt: who is not there yet will dial us
        "connect/exit_on_failure": False,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "transport/shared_memory/enabled": False,  # a SIGKILL would leave its segment behind
        "transport/link/tx/lease": LEASE_MS,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


class ZenohBus:
    """One actor's Zenoh session.

    Args:
        node: name under which this session announces itself; "" announces nothing (a tool).
        incarnation: life of the node.
        listen: endpoint to listen on, or None.
        dial: endpoints of the partners.
        tap: for a recorder of the run; None for none.
    """

    bursts = True

    def __init__(
        self, node: str, incarnation: int, listen: str | None, dial: Iterable[str],
        tap: Tap | None = None,
    ) -> None:
        self._node = node
        self._incarnation = incarnation
        self._listen = listen
        self._dial = tuple(dial)
        self._tap = tap
        self._session: zenoh.Session | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._arrived: deque[Callable[[], None]] = deque()
        self._woken = False
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._held: list[Any] = []

    async def open(self) -> None:
        """Open the session and declare this node alive.

        Raises:
            BusError: the endpoint is in use or invalid.
        """
        self._loop = asyncio.get_running_loop()
        try:
            self._session = zenoh.open(session_config(self._listen, self._dial))
        except zenoh.ZError as error:
            text = " ".join(str(error).split())
            if "in use" in text:
                raise BusError(f"port in use: {self._listen} (node {self._node}); "
                               "another run is using it, choose another --port") from None
            raise BusError(f"cannot open {self._listen} (node {self._node}): {text}") from None
        if self._node:
            self._held.append(self._session.liveliness().declare_token(
                f"{_ALIVE}/{self._node}/{self._incarnation}"))

    def publish(self, topic: Topic[Any], key: str, payload: bytes) -> None:
        """Send to all present subscribers of the key."""
        publisher = self._publishers.get(key)
        if publisher is None:
            publisher = self._publishers[key] = self._require().declare_publisher(
                key,
                priority=_PRIORITY[topic.qos],
                express=True,
                congestion_control=zenoh.CongestionControl.BLOCK
                if topic.qos is Qos.COMMAND
                else zenoh.CongestionControl.DROP,
            )
        publisher.put(payload)
        if self._tap is not None:
            self._tap.take(key, payload)

    def has_readers(self, key: str) -> bool:  # noqa: ARG002
        """Not asked of the network: somebody may be listening."""
        return True

    def subscribe(self, topic: Topic[Any], key_expression: str, deliver: Deliver) -> None:  # noqa: ARG002
        """Have `deliver` called on the event loop for each message on keys that match."""

        def arrived(sample: zenoh.Sample) -> None:  # runs on a Zenoh thread
            key, payload = str(sample.key_expr), sample.payload.to_bytes()
            self._hand_over(lambda: deliver(key, payload))

        self._held.append(self._require().declare_subscriber(key_expression, arrived))

    def watch(self, node: str, changed: PeerChange) -> None:
        """Have `changed` called now if the node lives, and whenever it appears or vanishes."""

        def arrived(sample: zenoh.Sample) -> None:  # runs on a Zenoh thread
            incarnation = str(sample.key_expr).rsplit("/", 1)[1]
            alive = sample.kind == zenoh.SampleKind.PUT
            if incarnation.isdecimal():
                self._hand_over(lambda: changed(node, int(incarnation), alive))

        self._held.append(self._require().liveliness().declare_subscriber(
            f"{_ALIVE}/{node}/*", arrived, history=True))

    async def close(self) -> None:
        """Close the session."""
        session, self._session = self._session, None
        self._held.clear()
        self._publishers.clear()
        self._arrived.clear()
        if self._tap is not None:
            self._tap.close()
        if session is not None:
            await asyncio.to_thread(session.close)

    def _require(self) -> zenoh.Session:
        if self._session is None:
            raise BusError(f"bus of {self._node or 'tool'} is not open")
        return self._session

    def _hand_over(self, call: Callable[[], None]) -> None:
        self._arrived.append(call)
        if not self._woken and self._loop is not None:
            self._woken = True  # a race here costs one extra wake-up, never a message
            try:
                self._loop.call_soon_threadsafe(self._drain)
            except RuntimeError:  # the loop has closed: the actor is gone, so is its mail
                self._arrived.clear()

    def _drain(self) -> None:
        self._woken = False
        while self._arrived:
            try:
                call = self._arrived.popleft()
            except IndexError:
                return
            if self._session is None:
                continue
            try:
                call()
            except Exception as error:  # what else has arrived is not to wait for the next message
                asyncio.get_running_loop().call_exception_handler({
                    "message": f"{self._node or 'tool'}: a message could not be handed over",
                    "exception": error})
