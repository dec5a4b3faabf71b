"""The bus over Zenoh: a partial mesh of peers on unix sockets, no router, no rendezvous.

Every actor listens on a socket of its own in the folder of the run, which only the run's user can
enter, and at its start dials the actors that it shares a topic with. The later node dials those
that are there already, so a respawned actor is connected to all its partners by the time `open`
returns, and no process is a single point of failure.

**No start waits for a partner that does not answer.** Zenoh dials all partners in the
background and goes on trying; `open` waits until those that are there are linked, and not for one
that is dead or stopped, nor for one that is slower than `PATIENCE_S`. Such a link comes later, so a
stopped process that goes on finds its partners again.

Zenoh calls back on threads of its own. They only append to a deque and wake the event loop once
per burst; everything else happens on the loop.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import secrets
import socket
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import zenoh

from rampart.actors.bus.bus import BusError, Deliver, PeerChange
from rampart.actors.bus.recorder_connection import RecorderConnection
from rampart.actors.bus.run_folder import socket_path
from rampart.actors.bus.topic import ROOT, Qos, Topic
from rampart.actors.bus.topics import HELLO
from rampart.actors.bus.unix_peer import peer, process_state

LEASE_MS = 2000
"""A link that is silent for so long is closed; a stopped process is found sooner by heartbeat."""

PATIENCE_S = 0.25
"""Real seconds that a newcomer waits for a partner that runs; the link may come later."""

HANDSHAKE_MS = 300
"""A handshake that takes longer is given up on either side: what connects and says nothing holds
one of the hundred places that Zenoh has for handshakes no longer than this."""

_HELLOS_PER_S = 200
"""From one partner, which publishes one when it starts. Zenoh leaves out what is above, before it
costs a node anything: for each hello all partners repeat their states, so such a flood is worst."""

# Not sooner: a second handshake by each partner would meet the one of a node that is coming back.
_REDIAL_MS = {"period_init_ms": 1000, "period_max_ms": 2000, "period_increase_factor": 2.0}
_LOOK_S = 0.001
_FIRST_LOOKS = 5
"""So many looks, a millisecond each, before a partner that is missing is looked at more closely."""

_PROTOCOL = "unixsock-stream"
_ALIVE = f"{ROOT}/alive"
_DELIVERY = {
    Qos.SENSOR: (zenoh.Priority.DATA, zenoh.CongestionControl.DROP),
    Qos.STATE: (zenoh.Priority.INTERACTIVE_HIGH, zenoh.CongestionControl.DROP),
    Qos.COMMAND: (zenoh.Priority.INTERACTIVE_HIGH, zenoh.CongestionControl.BLOCK)}


def endpoint(folder: str, name: str) -> str:
    """Return the Zenoh endpoint of a node in the folder of a run."""
    return f"{_PROTOCOL}/{socket_path(folder, name)}"


def session_config(listen: str | None, dial: Sequence[str]) -> zenoh.Config:
    """Return the configuration of a session that finds others only where it is told."""
    config = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": "peer",
        "listen/endpoints": [listen] if listen else [],
        "listen/exit_on_failure": True,
        "connect/endpoints": list(dial),
        "connect/timeout_ms": -1,  # in the background; `open` knows whom to wait for
        "connect/retry": _REDIAL_MS,
        "connect/exit_on_failure": False,
        "open/return_conditions": {"connect_scouted": False, "declares": False},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "transport/shared_memory/enabled": False,  # a SIGKILL would leave its segment behind
        "transport/unicast/open_timeout": HANDSHAKE_MS,
        "transport/unicast/accept_timeout": HANDSHAKE_MS,
        "transport/link/tx/lease": LEASE_MS,
        "downsampling": [{"messages": ["put"], "flows": ["ingress"], "rules": [
            {"key_expr": HELLO.pattern, "freq": _HELLOS_PER_S}]}]}
    if listen:
        settings["id"] = _mark(listen) + secrets.token_hex(8)
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _mark(where: str) -> str:
    """Return how the Zenoh id of the node that listens at an endpoint begins."""
    return "1" + hashlib.blake2b(where.encode(), digest_size=8).hexdigest()[1:]


def _answers(where: str) -> bool:
    """Whether there is a process at an endpoint, and it is not stopped."""
    with socket.socket(socket.AF_UNIX) as probe:
        probe.setblocking(False)
        try:
            probe.connect(where.removeprefix(f"{_PROTOCOL}/"))
            return process_state(peer(probe)[0]) not in "TtX"
        except OSError:  # none, or so many wait to be let in that none is
            return False


class ZenohBus:
    """One actor's Zenoh session.

    Args:
        node: name under which this session announces itself; "" announces nothing (a tool).
        incarnation: of the node.
        listen: endpoint to listen on, or None.
        dial: endpoints of the partners.
        recorder: connection to a recorder of the run; None for none.
    """

    bursts = True

    def __init__(self, node: str, incarnation: int, listen: str | None, dial: Iterable[str],
                 recorder: RecorderConnection | None = None) -> None:
        self._node = node
        self._incarnation = incarnation
        self._listen = listen
        self._dial = tuple(dial)
        self._recorder = recorder
        self._session: zenoh.Session | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._arrived: deque[Callable[[], None]] = deque()
        self._woken = False
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._held: list[Any] = []

    async def open(self) -> None:
        """Open the session, link it with the partners that are there, and announce this node.

        Raises:
            BusError: the endpoint is in use or invalid.
        """
        self._loop = asyncio.get_running_loop()
        try:
            self._session = zenoh.open(session_config(self._listen, self._dial))
        except zenoh.ZError as error:
            text = " ".join(str(error).split())
            node = f"(node {self._node})"
            raise BusError(f"{self._listen} is in use by another process {node}"
                           if "acquire lock" in text
                           else f"cannot open {self._listen} {node}: {text}") from None
        await self._linked(self._session)
        if self._node:
            self._held.append(self._session.liveliness().declare_token(
                f"{_ALIVE}/{self._node}/{self._incarnation}"))

    async def _linked(self, session: zenoh.Session) -> None:
        """Wait until all partners that answer are linked, `PATIENCE_S` at most."""
        loop = asyncio.get_running_loop()
        missing = {_mark(where): where for where in self._dial}
        deadline_s, looks = loop.time() + PATIENCE_S, 0
        while True:
            for zid in session.info.peers_zid():
                missing.pop(str(zid)[:len(_mark(""))], None)
            if looks == _FIRST_LOOKS:
                missing = {mark: where for mark, where in missing.items() if _answers(where)}
            if not missing or loop.time() > deadline_s:
                return
            looks += 1
            await asyncio.sleep(_LOOK_S)

    def publish(self, topic: Topic[Any], key: str, payload: bytes) -> None:
        """Send to all present subscribers of the key."""
        publisher = self._publishers.get(key)
        if publisher is None:
            priority, congestion_control = _DELIVERY[topic.qos]
            publisher = self._publishers[key] = self._require().declare_publisher(
                key, priority=priority, express=True, congestion_control=congestion_control)
        publisher.put(payload)
        if self._recorder is not None:
            self._recorder.take(key, payload)

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
        """Have `changed` called now if the node is there, and whenever it appears or vanishes."""

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
        if self._recorder is not None:
            self._recorder.close()
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
        while self._session is not None and self._arrived:
            try:
                self._arrived.popleft()()
            except Exception as error:  # what else has arrived is not to wait for the next message
                asyncio.get_running_loop().call_exception_handler({
                    "message": f"{self._node or 'tool'}: a message could not be handed over",
                    "exception": error})
