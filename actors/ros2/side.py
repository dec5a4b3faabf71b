"""The network of ROS 2: a Zenoh session among those of `rmw_zenoh`, separate from the system's bus.

It dials the router of the robot's nodes in the background until it answers, so either may start
first. Messages are handed to the event loop.

A *client* exchanges everything through the router, from any machine. A *peer* needs a direct link
to each node, because a router passes nothing on between two peers. The nodes of ROS 2 listen on
their own machine only; there a peer goes on without the router.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import secrets
import ssl
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from itertools import count
from typing import Any, Literal, Protocol

import msgspec
import xxhash
import zenoh
from zenoh import ext
from zenoh.handlers import Callback

from rampart.actors.bus.bus import Bus
from rampart.actors.bus.topic import ROS_SIDE, Topic
from rampart.actors.bus.topic import Qos as BusQos
from rampart.actors.ros2.wire import Qos

Mode = Literal["client", "peer"]
"""Mode of a session of Zenoh that is not a router."""


class Tls(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """PEM files for TLS with the routers of ROS 2.

    Attributes:
        ca: certificate of the authority that has issued the routers' certificates.
        certificate: of this session, for routers that require one; "" for none.
        key: private key of that certificate.
    """

    ca: str
    certificate: str = ""
    key: str = ""

    def __post_init__(self) -> None:
        """Refuse a certificate without a key, and a key without a certificate."""
        if bool(self.certificate) != bool(self.key):
            raise ValueError("certificate and key: expected both or neither")

    def context(self) -> ssl.SSLContext:
        """Return a context of TLS with the files.

        Raises:
            ValueError: a file cannot be read, or is not a certificate or key in PEM.
        """
        files = f"ca = {self.ca!r}"
        try:
            context = ssl.create_default_context(cafile=self.ca)
            if self.key:
                files = f"certificate = {self.certificate!r}, key = {self.key!r}"
                context.load_cert_chain(self.certificate, self.key, password="")  # never asked for
        except OSError as error:
            why = getattr(error, "reason", None) or error.strerror or error
            raise ValueError(f"tls: {files}: {why}") from None
        return context

    def settings(self) -> dict[str, Any]:
        """Return the settings of Zenoh; raises as `context`."""
        self.context()
        own = {"connect_certificate": self.certificate, "connect_private_key": self.key}
        return {f"transport/link/tls/{name}": value for name, value in {
            "root_ca_certificate": self.ca, **(own if self.key else {}),
            "enable_mtls": bool(self.key)}.items()}


NO_ANSWER = "no server answers"
_AGAIN_S = 1.0
_LOOKS, _LOOK_S = 20, 0.05

Deliver = Callable[[bytes, bytes | None], None]
"""Called with payload and attachment of a message."""

Reply = Callable[[bytes, bytes], None]
"""Answers a request, with payload and attachment."""

Answered = Callable[[bytes | None, bytes | None, str], None]
"""Called with payload and attachment of an answer, or with None, None and the reason."""

class Side(Protocol):
    """The network as a node of ROS 2 uses it.

    Attributes:
        id: of the session, hexadecimal.
    """

    id: str

    def token(self, key: str) -> None:
        """Declare a liveliness token, which lasts as long as the session."""

    def tokens(self, pattern: str, changed: Callable[[str, bool], None]) -> None:
        """Call `changed` with each matching token, present ones first, and whether it is there."""

    def publisher(self, key: str, qos: Qos) -> Callable[[bytes, bytes], None]:
        """Return a function that publishes a payload and its attachment on a key."""

    def subscribe(self, key: str, qos: Qos, deliver: Deliver) -> None:
        """Deliver all messages on a key."""

    def serve(self, key: str, asked: Callable[[bytes, bytes | None, Reply], None]) -> None:
        """Deliver requests on a key, each with a function that answers it."""

    def ask(self, key: str, payload: bytes, attachment: bytes, timeout_s: float,
            answered: Answered) -> None:
        """Send a request and call `answered` for each answer; `timeout_s` in real seconds."""

    def is_linked(self) -> bool:
        """Return whether a router or another session is connected."""

    def close(self) -> None:
        """Leave the network."""


class ZenohSide:
    """A session of Zenoh among those of ROS 2 nodes; the methods are those of `Side`.

    Args:
        dial: endpoints of the routers of ROS 2, e.g. "tcp/localhost:7447".
        loop: runs all callbacks.
        mode: "client", with everything through the router, or "peer", with direct links.
        tls: files for endpoints "tls/…".

    Raises:
        ValueError: an endpoint is not valid, or a file cannot be read; one line.
    """

    def __init__(self, dial: Sequence[str], loop: asyncio.AbstractEventLoop, *,
                 mode: Mode = "client", tls: Tls | None = None) -> None:
        self.id = f"{1 << 127 | secrets.randbits(127):032x}"
        try:
            config = _configured(dial, mode, self.id, tls)
        except zenoh.ZError as error:
            raise ValueError(f"connect = {list(dial)}: {' '.join(str(error).split())}") from None
        self._loop = loop
        self._session: zenoh.Session | None = None
        self._is_closed = False
        self._waiting: list[Callable[[zenoh.Session], Any]] = []
        self._held: list[Any] = []
        # A client's session opens when its router is there; the loop must not wait for that.
        threading.Thread(target=self._open, args=(config,), daemon=True).start()

    def _open(self, config: zenoh.Config) -> None:
        while not self._is_closed:
            try:
                session = zenoh.open(config)
            except zenoh.ZError:  # e.g. a host without address, which may get one
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
        """Declare something as soon as the session is open."""
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
        # Even with reliable topics, `rmw_zenoh` waits for slow readers with keep-all only.
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

        def publish(payload: bytes, attachment: bytes) -> None:
            if made is not None:
                made.put(payload, attachment=attachment)
            elif qos.transient_local:
                kept.append((payload, attachment))

        return publish

    def subscribe(self, key: str, qos: Qos, deliver: Deliver) -> None:
        """See `Side.subscribe`."""

        def arrived(sample: zenoh.Sample) -> None:  # runs on a Zenoh thread
            payload, attached = sample.payload.to_bytes(), sample.attachment
            self._tell(deliver, payload, None if attached is None else attached.to_bytes())

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
        has_reply = False

        def arrived(reply: zenoh.Reply) -> None:  # runs on a Zenoh thread
            nonlocal has_reply
            has_reply = True
            if reply.ok is not None:
                attached = reply.ok.attachment
                self._tell(answered, reply.ok.payload.to_bytes(),
                           None if attached is None else attached.to_bytes(), "")
            elif reply.err is not None:
                text = reply.err.payload.to_bytes()[:200].decode("utf-8", "replace")
                self._tell(answered, None, None, text or "an error")

        def over() -> None:
            if not has_reply:
                self._tell(answered, None, None, NO_ANSWER)

        self._session.get(
            key, Callback(arrived, over, indirect=False), payload=payload, attachment=attachment,
            target=zenoh.QueryTarget.ALL_COMPLETE, consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout_s)

    async def finds(self, key: str, *, service: bool = False) -> bool:
        """Return whether a subscription to a key, or a server, is known here within a moment."""
        if self._session is None:
            return False
        own: Any  # its `matching_status` is not what the stubs of Zenoh show
        with (self._session.declare_querier(key, target=zenoh.QueryTarget.ALL_COMPLETE) if service
              else self._session.declare_publisher(key)) as own:
            for _ in range(_LOOKS):
                if own.matching_status.matching:
                    return True
                await asyncio.sleep(_LOOK_S)
        return False

    def is_linked(self) -> bool:
        """See `Side.is_linked`."""
        return bool(self.links())

    def links(self) -> set[str]:
        """Return the ids of the sessions and routers with a direct link."""
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
    """Return a key of ROS 2 as one chunk of another key."""
    return key.replace("/", "|")


def recorded_key(key: str) -> str:
    """Return the key that messages on a key of ROS 2 have in a recording."""
    return f"{ROS_SIDE}/data/{chunk_of(key)}"


def packed(payload: bytes, attachment: bytes | None) -> bytes:
    """Return a message of ROS 2 in the form of a recording."""
    return msgspec.msgpack.encode((payload, attachment))


def _direct(call: Callable[[Any], None]) -> Callback[Any]:
    """Return a handler that Zenoh calls on the thread that reads."""
    return Callback(call, indirect=False)


def _configured(dial: Sequence[str], mode: Mode, own_id: str, tls: Tls | None) -> zenoh.Config:
    """Return the default configuration of `rmw_zenoh`, except that routers may start later."""
    config = zenoh.Config()
    for name, value in {
            "mode": mode, "id": own_id, "connect/endpoints": list(dial), "connect/timeout_ms": -1,
            "connect/exit_on_failure": False,
            "listen/endpoints": ["tcp/127.0.0.1:0"] if mode == "peer" else [],
            "scouting/multicast/enabled": False, "scouting/gossip/enabled": True,
            "scouting/delay": 0, "timestamping/enabled": True, **(tls.settings() if tls else {}),
            "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000,
                              "period_increase_factor": 2}}.items():
        config.insert_json5(name, json.dumps(value))
    return config


# -- in virtual time -------------------------------------------------------------------------------

_KEPT = Topic("", msgspec.Struct, BusQos.STATE, 0.0, "", "Kept for new subscribers.")
_PASSING = Topic("", msgspec.Struct, BusQos.COMMAND, 0.0, "", "Not kept.")

_pack, _unpack = msgspec.msgpack.encode, msgspec.msgpack.decode


class WatchedBus(Bus, Protocol):
    """A bus that knows which nodes are there, as the virtual bus does."""

    @property
    def is_open(self) -> bool:
        """Whether it has joined, and not been cut off."""

    def watch(self, node: str, changed: Callable[[str, int, bool], None]) -> None:
        """Call `changed` now if the node is there, and whenever it appears or vanishes."""


class BusSide:
    """The network of ROS 2 in virtual time, over the bus; the methods are those of `Side`.

    Actors stand in for the nodes of ROS 2 (`rampart.actors.ros2.stand_in`). As with a real session,
    a token goes when the process ends that declared it.

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
