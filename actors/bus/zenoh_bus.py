"""The bus over Zenoh: two linked routers on unix sockets, and every actor a client of one of them.

The routers are processes of the run like others (`rampart.actors.supervision.router`); they listen
in its folder, which only its user can enter. A client knows both: one that starts goes to the
one that has been there longer, so that a message passes one router as a rule; when that one dies
Zenoh goes over to the other within some milliseconds, with all that was declared. What is sent
meanwhile is lost, as on any network.

**In that moment the liveliness tokens of all clients vanish and come back.** So a token that
vanishes says that a node is gone only if it has not come back after `SETTLE_S`. What the kernel
knows is told at once: `gone`.

Zenoh calls back on threads of its own. They only append to a deque and wake the event loop once
per burst; everything else happens on the loop.
"""

from __future__ import annotations

import asyncio
import json
import os
import socket
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import zenoh

from rampart.actors.bus.bus import BusError, Deliver, PeerChange
from rampart.actors.bus.recorder_connection import RecorderConnection
from rampart.actors.bus.run_folder import socket_path
from rampart.actors.bus.topic import ROOT, Qos, Topic
from rampart.actors.bus.topics import HELLO
from rampart.actors.bus.unix_peer import peer, process_state

ROUTERS = ("router_a", "router_b")

LEASE_MS = 2000
"""A link that is silent for so long is closed; a stopped process is found sooner by heartbeat."""

PATIENCE_S = 10.0
"""Real seconds that a client looks for a router when it starts."""

SETTLE_S = 0.2
"""Real seconds within which the tokens of nodes are back whose router has died."""

HANDSHAKE_MS = 300
"""A handshake that takes longer is given up on either side: what connects and says nothing holds
one of the hundred places that Zenoh has for handshakes no longer than this."""

_HELLOS_PER_S = 200
"""From one node, which publishes one when it starts. A router leaves out what is above: for each
hello all others repeat their states, so such a flood is worst."""

_RUNTIME = "ZENOH_RUNTIME"
_THREADS = ("(app: (worker_threads: 1), tx: (worker_threads: 1), rx: (handover: app), "
            "acc: (handover: app), net: (handover: app))")
"""Of Zenoh in a client: one that reads and one that writes. By default a thread that waits for
sockets wakes one of two others for each message that has come, which reads it. Reading and writing
on one thread is no choice: most nodes were never heard then. Routers keep a thread
for each task: many links come and go there, and Zenoh holds locks while it waits for other tasks.
"""

_REDIAL_MS = {"period_init_ms": 10, "period_max_ms": 40, "period_increase_factor": 1.5}
_LOOK_S = 0.002

_PROTOCOL = "unixsock-stream"
_ALIVE, _GONE = f"{ROOT}/alive", f"{ROOT}/gone"
_DELIVERY = {
    Qos.SENSOR: (zenoh.Priority.DATA, zenoh.CongestionControl.DROP),
    Qos.STATE: (zenoh.Priority.INTERACTIVE_HIGH, zenoh.CongestionControl.DROP),
    Qos.COMMAND: (zenoh.Priority.INTERACTIVE_HIGH, zenoh.CongestionControl.BLOCK)}


def endpoint(folder: str, name: str) -> str:
    """Return the Zenoh endpoint of a node in the folder of a run."""
    return f"{_PROTOCOL}/{socket_path(folder, name)}"


def endpoints(folder: str) -> list[str]:
    """Return the endpoints of the routers in the folder of a run."""
    return [endpoint(folder, name) for name in ROUTERS]


def session_config(listen: str | None, dial: Sequence[str]) -> zenoh.Config:
    """Return the configuration of a session that finds others only where it is told.

    Args:
        listen: where a router listens; None for a client.
        dial: a client goes to the first of these that answers, a router to all, again and again.
    """
    config = zenoh.Config()
    settings: dict[str, Any] = {
        "mode": "router" if listen else "client",
        "listen/endpoints": [listen] if listen else [],
        "listen/exit_on_failure": True,
        "connect/endpoints": list(dial),
        "connect/timeout_ms": -1 if listen else 0,  # in the background, or each once
        "connect/retry": _REDIAL_MS,
        "connect/exit_on_failure": False,
        "open/return_conditions": {"connect_scouted": False, "declares": False},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "transport/shared_memory/enabled": False,  # a SIGKILL would leave its segment behind
        "transport/unicast/open_timeout": HANDSHAKE_MS,
        "transport/unicast/accept_timeout": HANDSHAKE_MS,
        "transport/link/tx/lease": LEASE_MS}
    if listen:
        settings["downsampling"] = [{"messages": ["put"], "flows": ["ingress"], "rules": [
            {"key_expr": HELLO.pattern, "freq": _HELLOS_PER_S}]}]
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _answering(where: Sequence[str]) -> list[str]:
    """Return the endpoints at which there is a process that is not stopped, the oldest first."""
    found = []
    for one in where:
        path = one.removeprefix(f"{_PROTOCOL}/")
        with socket.socket(socket.AF_UNIX) as probe:
            probe.setblocking(False)
            try:
                probe.connect(path)
                if process_state(peer(probe)[0]) not in "TtX":
                    found.append((Path(path).stat().st_mtime_ns, one))
            except OSError:  # none, or so many wait to be let in that none is
                continue
    return [one for _, one in sorted(found)]


def _open_client(dial: Sequence[str]) -> zenoh.Session:
    if _RUNTIME in os.environ:
        return zenoh.open(session_config(None, dial))
    os.environ[_RUNTIME] = _THREADS  # read when a process opens its first session
    try:
        return zenoh.open(session_config(None, dial))
    finally:
        del os.environ[_RUNTIME]  # commands that this process starts have their own


class _Bell:
    """What a Zenoh thread rings; closed with the last one that could, so never while one does.

    Attributes:
        number: of its descriptor.
    """

    def __init__(self) -> None:
        self.number = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    def __del__(self) -> None:
        os.close(self.number)


class ZenohBus:
    """One actor's Zenoh session.

    Args:
        node: name under which this session announces itself; "" announces nothing (a tool).
        incarnation: of the node.
        dial: endpoints of the routers; to a router, of the other one.
        listen: endpoint of a router; None for a client.
        recorder: connection to a recorder of the run; None for none.
    """

    bursts = True

    def __init__(self, node: str, incarnation: int, dial: Sequence[str],
                 listen: str | None = None, recorder: RecorderConnection | None = None) -> None:
        self._node = node
        self._incarnation = incarnation
        self._listen = listen
        self._dial = dial
        self._recorder = recorder
        self._session: zenoh.Session | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._arrived: deque[Callable[[], None]] = deque()
        self._woken = False
        self._bell = _Bell()
        self._after_burst: list[Callable[[], None]] | None = None
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._held: list[Any] = []
        self._leaving: dict[tuple[str, int, PeerChange], asyncio.TimerHandle] = {}

    async def open(self) -> None:
        """Open the session, and announce this node.

        Raises:
            BusError: the endpoint is in use or invalid, or there is no router.
        """
        self._loop = asyncio.get_running_loop()
        try:
            self._session = (await self._joined(self._loop) if self._listen is None
                             else zenoh.open(session_config(self._listen, self._dial)))
        except zenoh.ZError as error:
            text = " ".join(str(error).split())
            node = f"(node {self._node})"
            raise BusError(f"{self._listen} is in use by another process {node}"
                           if "acquire lock" in text
                           else f"cannot open {self._listen} {node}: {text}") from None
        self._loop.add_reader(self._bell.number, self._drain)
        if self._node:
            self._held.append(self._session.liveliness().declare_token(
                f"{_ALIVE}/{self._node}/{self._incarnation}"))

    async def _joined(self, loop: asyncio.AbstractEventLoop) -> zenoh.Session:
        """Return the session of a client, as soon as there is a router."""
        until_s = loop.time() + PATIENCE_S
        while True:
            found = _answering(self._dial)
            try:
                if found:
                    both = [*found, *(one for one in self._dial if one not in found)]
                    return _open_client(both)
            except zenoh.ZError:  # it ended in this moment
                pass
            if loop.time() > until_s:
                raise BusError(f"no router at {' or '.join(self._dial)} "
                               f"({f'node {self._node}' if self._node else 'tool'})")
            await asyncio.sleep(_LOOK_S)

    @property
    def is_open(self) -> bool:
        """Whether there is a session."""
        return self._session is not None

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
            place, _, incarnation = str(sample.key_expr).rsplit("/", 2)
            if not incarnation.isdecimal():
                return
            if place == _GONE:
                self._hand_over(lambda: changed(node, int(incarnation), False))
                return
            alive = sample.kind == zenoh.SampleKind.PUT
            self._hand_over(lambda: self._token(node, int(incarnation), alive, changed))

        session = self._require()
        self._held.append(session.liveliness().declare_subscriber(
            f"{_ALIVE}/{node}/*", arrived, history=True))
        self._held.append(session.declare_subscriber(f"{_GONE}/{node}/*", arrived))

    def _token(self, node: str, incarnation: int, alive: bool, changed: PeerChange) -> None:
        assert self._loop is not None  # noqa: S101 for the type checker
        which = node, incarnation, changed
        leaving = self._leaving.pop(which, None)
        if leaving is not None:
            leaving.cancel()
        if alive:
            changed(node, incarnation, True)
        else:
            self._leaving[which] = self._loop.call_later(SETTLE_S, self._left, which)

    def _left(self, which: tuple[str, int, PeerChange]) -> None:
        node, incarnation, changed = which
        del self._leaving[which]
        if self._session is not None:
            changed(node, incarnation, False)

    def gone(self, node: str, incarnation: int) -> None:
        """Tell those who watch a node that a process of it has ended."""
        self._require().put(
            f"{_GONE}/{node}/{incarnation}", b"", priority=zenoh.Priority.INTERACTIVE_HIGH,
            congestion_control=zenoh.CongestionControl.BLOCK, express=True)

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
            asyncio.get_running_loop().remove_reader(self._bell.number)

    def _require(self) -> zenoh.Session:
        if self._session is None:
            raise BusError(f"bus of {self._node or 'tool'} is not open")
        return self._session

    def _hand_over(self, call: Callable[[], None]) -> None:
        if self._session is None:  # the actor is gone, so is its mail
            return
        self._arrived.append(call)
        if not self._woken:
            self._woken = True  # a race here costs one extra wake-up, never a message
            os.eventfd_write(self._bell.number, 1)  # costs less than `call_soon_threadsafe`

    def _drain(self) -> None:
        os.eventfd_read(self._bell.number)
        self._woken = False  # after the reading: who finds it set still rings, or is drained below
        after: list[Callable[[], None]] = []
        self._after_burst = after
        while self._session is not None and self._arrived:
            self._try(self._arrived.popleft())
        self._after_burst = None
        for call in after:
            self._try(call)

    def _try(self, call: Callable[[], None]) -> None:
        try:
            call()
        except Exception as error:  # what else has arrived is not to wait for the next message
            asyncio.get_running_loop().call_exception_handler({
                "message": f"{self._node or 'tool'}: a message could not be handed over",
                "exception": error})

    def after_burst(self, call: Callable[[], None]) -> None:
        """Have `call` made when all that has arrived was delivered; soon if nothing has."""
        if self._after_burst is not None:
            self._after_burst.append(call)
        else:
            asyncio.get_running_loop().call_soon(call)
