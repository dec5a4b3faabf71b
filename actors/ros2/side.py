"""The side of ROS 2: a session of its own among those of `rmw_zenoh`, beside that of the system.

It dials the router that the robot's own nodes have, in the background and again and again, so that
neither has to be there first; nothing of the system's own bus is reachable by it. What arrives
is handed over to the event loop.

As a *client* it exchanges everything through the router, from any machine. As a *peer* it needs a
direct link to each node: the nodes of ROS 2 listen on their own machine alone, and a router passes
nothing on between two peers. There it goes on without the router.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import secrets
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Literal, Protocol

import msgspec
import zenoh
from zenoh import ext
from zenoh.handlers import Callback

from rampart.actors.bus.topic import ROS_SIDE
from rampart.actors.ros2.wire import Qos

Mode = Literal["client", "peer"]
"""What a session of Zenoh is beside the router."""

_AGAIN_S = 1.0

Deliver = Callable[[bytes, bytes | None], None]
"""Called with payload and attachment of a message."""

Reply = Callable[[bytes, bytes], None]
"""Answers a request, with payload and attachment."""

Answered = Callable[[bytes | None, bytes | None, str], None]
"""Called with payload and attachment of an answer, or with None, None, and why there is none."""


Record = Callable[[str, bytes], None]
"""Takes key and payload of what a recording is to have."""


class Side(Protocol):
    """What a node of ROS 2 needs of the network.

    Attributes:
        id: of the session, hexadecimal.
    """

    id: str

    def token(self, key: str) -> None:
        """Declare a liveliness token, which is there as long as the session."""

    def tokens(self, pattern: str, changed: Callable[[str, bool], None]) -> None:
        """Have the tokens told that match, those that are there first."""

    def publisher(self, key: str, qos: Qos) -> Callable[[bytes, bytes], None]:
        """Return what publishes a payload and its attachment on a key."""

    def subscribe(self, key: str, qos: Qos, deliver: Deliver) -> None:
        """Have all messages on a key delivered."""

    def serve(self, key: str, asked: Callable[[bytes, bytes | None, Reply], None]) -> None:
        """Have requests on a key delivered, each with what answers it."""

    def ask(self, key: str, payload: bytes, attachment: bytes, timeout_s: float,
            answered: Answered) -> None:
        """Send a request, and have each answer told; `timeout_s` in real seconds."""

    def is_linked(self) -> bool:
        """Whether there is a router, or another session."""

    def close(self) -> None:
        """Leave the network."""


class NoSide:
    """A network with nobody in it, which hears nothing: for what is only to be checked."""

    id = "0"

    def token(self, key: str) -> None:
        """See `Side.token`."""

    def tokens(self, pattern: str, changed: Callable[[str, bool], None]) -> None:
        """See `Side.tokens`."""

    def publisher(self, key: str, qos: Qos) -> Callable[[bytes, bytes], None]:  # noqa: ARG002
        """See `Side.publisher`."""
        return lambda _payload, _attachment: None

    def subscribe(self, key: str, qos: Qos, deliver: Deliver) -> None:
        """See `Side.subscribe`."""

    def serve(self, key: str, asked: Callable[[bytes, bytes | None, Reply], None]) -> None:
        """See `Side.serve`."""

    def ask(self, key: str, payload: bytes, attachment: bytes, timeout_s: float,
            answered: Answered) -> None:
        """See `Side.ask`."""

    def is_linked(self) -> bool:
        """See `Side.is_linked`."""
        return False

    def close(self) -> None:
        """See `Side.close`."""


class ZenohSide:
    """A session of Zenoh beside those of ROS 2 nodes.

    Args:
        dial: endpoints of the routers of ROS 2, e.g. "tcp/localhost:7447".
        loop: on which everything is told.
        record: takes each message that is published or heard; None for no one.
        mode: "client", by which everything passes the router, or "peer", with direct links.

    Raises:
        ValueError: an endpoint makes no sense; one line.
    """

    def __init__(self, dial: Sequence[str], loop: asyncio.AbstractEventLoop,
                 record: Record | None = None, *, mode: Mode = "client") -> None:
        self.id = f"{1 << 127 | secrets.randbits(127):032x}"
        try:
            config = _configured(dial, mode, self.id)
        except zenoh.ZError as error:
            raise ValueError(f"connect = {list(dial)}: {' '.join(str(error).split())}") from None
        self._loop = loop
        self._record = record
        self._session: zenoh.Session | None = None
        self._is_closed = False
        self._waiting: list[Callable[[zenoh.Session], Any]] = []
        self._held: list[Any] = []
        # A client's session opens when its router is there, which the loop does not wait for.
        threading.Thread(target=self._open, args=(config,), daemon=True).start()

    def _open(self, config: zenoh.Config) -> None:
        while not self._is_closed:
            try:
                session = zenoh.open(config)
            except zenoh.ZError:  # a host without address, say, which may get one
                time.sleep(_AGAIN_S)
                continue
            self._tell(self._opened, session)
            return

    def _opened(self, session: zenoh.Session) -> None:
        if self._is_closed:
            session.close()  # type: ignore[no-untyped-call]
            return
        self._session = session
        for declare in self._waiting:
            self._held.append(declare(session))
        self._waiting.clear()

    def _declare(self, declare: Callable[[zenoh.Session], Any]) -> None:
        """Declare something now, or when the session is open."""
        if self._session is None:
            self._waiting.append(declare)
        else:
            self._held.append(declare(self._session))

    def token(self, key: str) -> None:
        """See `Side.token`."""
        self._declare(lambda session: session.liveliness().declare_token(key))

    def tokens(self, pattern: str, changed: Callable[[str, bool], None]) -> None:
        """See `Side.tokens`."""

        def arrived(sample: zenoh.Sample) -> None:  # runs on a Zenoh thread
            key, there = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT
            self._tell(changed, key, there)

        self._declare(lambda session: session.liveliness().declare_subscriber(
            pattern, _direct(arrived), history=True))

    def publisher(self, key: str, qos: Qos) -> Callable[[bytes, bytes], None]:
        """See `Side.publisher`."""
        # Of all that is to be reliable `rmw_zenoh` waits with keep-all only.
        waits = qos.reliable and qos.keep_all
        control = zenoh.CongestionControl.BLOCK if waits else zenoh.CongestionControl.DROP
        reliability = (zenoh.Reliability.RELIABLE if qos.reliable
                       else zenoh.Reliability.BEST_EFFORT)
        made: Any = None

        def declare(session: zenoh.Session) -> Any:
            nonlocal made
            if qos.transient_local:
                misses = ext.MissDetectionConfig(
                    heartbeat=None, sporadic_heartbeat=0.5) if qos.reliable else None
                made = ext.declare_advanced_publisher(
                    session, key, congestion_control=control, reliability=reliability,
                    cache=ext.CacheConfig(max_samples=qos.depth), publisher_detection=True,
                    sample_miss_detection=misses)
                for payload, attachment in kept:
                    made.put(payload, attachment=attachment)
            else:
                made = session.declare_publisher(
                    key, congestion_control=control, reliability=reliability, express=True)
            return made

        kept: deque[tuple[bytes, bytes]] = deque(maxlen=qos.depth)
        self._declare(declare)

        where = recorded_key(key)

        def publish(payload: bytes, attachment: bytes) -> None:
            if made is not None:
                made.put(payload, attachment=attachment)
            elif qos.transient_local:
                kept.append((payload, attachment))
            if self._record is not None:
                self._record(where, packed(payload, attachment))

        return publish

    def subscribe(self, key: str, qos: Qos, deliver: Deliver) -> None:
        """See `Side.subscribe`."""

        def arrived(sample: zenoh.Sample) -> None:  # runs on a Zenoh thread
            payload, attached = sample.payload.to_bytes(), sample.attachment
            self._tell(heard, payload, None if attached is None else attached.to_bytes())

        where = recorded_key(key)

        def heard(payload: bytes, attachment: bytes | None) -> None:
            deliver(payload, attachment)
            if self._record is not None:
                self._record(where, packed(payload, attachment))

        if qos.transient_local:
            recovery = ext.RecoveryConfig(
                periodic_queries=None, heartbeat=True) if qos.reliable else None
            self._declare(lambda session: ext.declare_advanced_subscriber(
                session, key, _direct(arrived), subscriber_detection=True, recovery=recovery,
                history=ext.HistoryConfig(detect_late_publishers=True, max_samples=qos.depth)))
        else:
            self._declare(lambda session: session.declare_subscriber(key, _direct(arrived)))

    def serve(self, key: str, asked: Callable[[bytes, bytes | None, Reply], None]) -> None:
        """See `Side.serve`."""

        def arrived(query: zenoh.Query) -> None:  # runs on a Zenoh thread
            payload, attached = query.payload, query.attachment

            def reply(answer: bytes, attachment: bytes) -> None:
                query.reply(key, answer, attachment=attachment)
                query.drop()  # type: ignore[no-untyped-call]

            self._tell(asked, b"" if payload is None else payload.to_bytes(),
                       None if attached is None else attached.to_bytes(), reply)

        self._declare(lambda session: session.declare_queryable(
            key, _direct(arrived), complete=True))

    def ask(self, key: str, payload: bytes, attachment: bytes, timeout_s: float,
            answered: Answered) -> None:
        """See `Side.ask`."""
        if self._session is None:
            self._loop.call_soon(answered, None, None, "no router")
            return
        heard = False

        def arrived(reply: zenoh.Reply) -> None:  # runs on a Zenoh thread
            nonlocal heard
            heard = True
            if reply.ok is not None:
                attached = reply.ok.attachment
                self._tell(answered, reply.ok.payload.to_bytes(),
                           None if attached is None else attached.to_bytes(), "")
            elif reply.err is not None:
                text = reply.err.payload.to_bytes()[:200].decode("utf-8", "replace")
                self._tell(answered, None, None, text or "an error")

        def over() -> None:
            if not heard:
                self._tell(answered, None, None, "nobody answers")

        self._session.get(
            key, Callback(arrived, over, indirect=False), payload=payload, attachment=attachment,
            target=zenoh.QueryTarget.ALL_COMPLETE, consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout_s)

    def is_linked(self) -> bool:
        """See `Side.is_linked`."""
        return bool(self.links())

    def links(self) -> set[str]:
        """Return the ids of the sessions with a direct link, routers among them."""
        if self._session is None:
            return set()
        info = self._session.info
        return {str(zid) for zid in (*info.routers_zid(), *info.peers_zid())}

    def close(self) -> None:
        """See `Side.close`."""
        self._is_closed = True
        self._held.clear()
        if self._session is not None:
            self._session.close()  # type: ignore[no-untyped-call]

    def _tell(self, call: Callable[..., None], *what: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(call, *what)


def chunk_of(key: str) -> str:
    """Return a key of ROS 2 as one chunk of another."""
    return key.replace("/", "|")


def recorded_key(key: str) -> str:
    """Return the key under which messages on a key of ROS 2 stand in a recording."""
    return f"{ROS_SIDE}/data/{chunk_of(key)}"


def packed(payload: bytes, attachment: bytes | None) -> bytes:
    """Return a message of ROS 2 as it stands there."""
    return msgspec.msgpack.encode((payload, attachment))


def _direct(call: Callable[[Any], None]) -> Callback[Any]:
    """Return a handler that is called on the thread that reads."""
    return Callback(call, indirect=False)


def _configured(dial: Sequence[str], mode: Mode, own_id: str) -> zenoh.Config:
    """Return what `rmw_zenoh` sets by default, with routers that need not be there yet."""
    config = zenoh.Config()
    for name, value in {
            "mode": mode, "id": own_id, "connect/endpoints": list(dial), "connect/timeout_ms": -1,
            "connect/exit_on_failure": False,
            "listen/endpoints": ["tcp/127.0.0.1:0"] if mode == "peer" else [],
            "scouting/multicast/enabled": False, "scouting/gossip/enabled": True,
            "scouting/delay": 0, "timestamping/enabled": True,
            "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000,
                              "period_increase_factor": 2}}.items():
        config.insert_json5(name, json.dumps(value))
    return config
