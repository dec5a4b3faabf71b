"""The bus over Zenoh: two linked routers on unix sockets, and every actor a client of one of them.

The routers (`rampart.actors.supervision.router`) are processes of the run and listen in its folder,
which only its user can enter. A client knows both. It connects to the one that has been there
longer, so that a message usually passes one router. When that router dies, Zenoh changes to the
other one within some milliseconds and repeats all declarations. Messages sent meanwhile are lost.

Zenoh calls back on the thread that reads the socket (`indirect=False`). By default each subscriber
has a thread, which costs a millisecond to declare, as much to end, and a wake-up for each message.
A callback only appends to a deque and wakes the event loop once per burst, or answers a query with
the last published message. Everything else happens on the loop.
"""

from __future__ import annotations

import asyncio
import ctypes
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import zenoh
from zenoh.handlers import Callback

from rampart.actors.bus.board import FileBoard
from rampart.actors.bus.bus import BusError, Deliver
from rampart.actors.bus.limits import RateLimit
from rampart.actors.bus.recorder_connection import RecorderConnection
from rampart.actors.bus.topic import Qos, Topic
from rampart.actors.bus.zenoh_session import Credentials, answering_first, open_session

PATIENCE_S = 10.0
"""Real seconds that a client looks for a router when it starts."""

_ANSWERS_PER_S = 500
"""Answers to queries. A new subscriber queries each of its topics once; more is a flood."""

_ANSWER_S = 1.0
"""Real seconds until a query ends. Nothing else waits for it."""

_LOOK_S = 0.002

_BURST = 256
"""Messages delivered before timers get their turn, so that a flood does not delay them."""

_DELIVERY = {Qos.SENSOR: zenoh.Priority.DATA, Qos.STATE: zenoh.Priority.INTERACTIVE_HIGH,
             Qos.COMMAND: zenoh.Priority.INTERACTIVE_HIGH}
_DROP = zenoh.CongestionControl.DROP
"""For all messages, commands too. With BLOCK a router waits for a reader that is stopped or behind
a slow link, by default for 5 s, and serves no other client meanwhile. A message is dropped if it
finds no room in the queue of a link, which `session_config` makes long enough for a burst.
"""


_thread = threading.local()


def _direct(call: Callable[[Any], None], end: Callable[[], None] = lambda: None) -> Callback[Any]:
    """Return a handler that runs on the reading thread; `end` is called after the last sample.

    Python makes a thread state for each call from a foreign thread and discards it on return, which
    takes a quarter of the time of an arrival. The first call keeps the state for all later ones.
    """

    def called(sample: Any) -> None:
        if not hasattr(_thread, "has_state"):
            _thread.has_state = True
            ctypes.pythonapi.PyGILState_Ensure()  # without PyGILState_Release: the state is kept
        call(sample)

    return Callback(called, end, indirect=False)


class _Bell:
    """Wakes the event loop from a Zenoh thread.

    It is closed with its last user, so never while a thread rings it.
    """

    def __init__(self) -> None:
        self.descriptor = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)

    def ring(self) -> None:
        os.eventfd_write(self.descriptor, 1)  # cheaper than `call_soon_threadsafe`

    def __del__(self) -> None:
        os.close(self.descriptor)


class ZenohBus:
    """One actor's Zenoh session.

    Args:
        node: Name of the actor; "" for a tool.
        dial: Endpoints of the routers; for a router, of the others. A session that neither dials
            nor listens has no links.
        listen: Endpoints of a router, the one in the run's folder first; none for a client.
        recorder: Connection to a recorder of the run; None for none.
        credentials: None in a run without credentials.
        access: Rules of a router; None allows everything.
        board: Postings of the host; None if the system has several hosts.
    """

    bursts = True

    def __init__(self, node: str, dial: Sequence[str],
                 listen: Sequence[str] = (), recorder: RecorderConnection | None = None, *,
                 credentials: Credentials | None = None,
                 access: Mapping[str, Any] | None = None,
                 board: FileBoard | None = None) -> None:
        self._node = node
        self._listen = listen
        self._dial = dial
        self._recorder = recorder
        self._credentials = credentials
        self._access = access
        self._board = board
        self._session: zenoh.Session | None = None
        self._opening = asyncio.Lock()
        self._arrived: deque[Callable[[], None]] = deque()
        self._is_rung = False
        self._bell = _Bell()
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._latest: dict[str, bytes] = {}
        self._answers = RateLimit(_ANSWERS_PER_S)
        self._declared: list[Any] = []
        self._routers: list[str] = []

    def take_name(self, node: str, recorder: RecorderConnection | None,
                  board: FileBoard | None) -> None:
        """Become the bus of this node; the session may be open already."""
        self._node, self._recorder, self._board = node, recorder, board

    async def open(self) -> None:
        """Open the session, unless it is open.

        Raises:
            BusError: The endpoint is in use or invalid, or there is no router.
        """
        async with self._opening:  # the actors of a process may share it
            if self._session is not None:
                return
            try:
                self._session = await self._join() if self._dial and not self._listen else (
                    open_session(self._dial, self._credentials, self._listen, self._access))
            except zenoh.ZError as error:
                text = " ".join(str(error).split())
                node = f"(node {self._node})"
                where = [*self._listen, *self._dial, "the bus"][0]
                raise BusError(f"{where} is in use by another process {node}"
                               if "acquire lock" in text
                               else f"cannot open {where} {node}: {text}") from None
            self._routers = self._linked()
            asyncio.get_running_loop().add_reader(self._bell.descriptor, self._drain)

    async def _join(self) -> zenoh.Session:
        """Return the session of a client, as soon as there is a router."""
        until_s = time.monotonic() + PATIENCE_S
        while True:
            dial = answering_first(self._dial)
            try:
                if dial:
                    return open_session(dial, self._credentials)
            except zenoh.ZError:  # the router ended at this moment
                pass
            if time.monotonic() > until_s:
                shown = self._credentials
                taking = f" that takes the certificate in {shown.own}" if shown and dial else ""
                raise BusError(f"no router at {' or '.join(self._dial)}{taking} "
                               f"({f'node {self._node}' if self._node else 'tool'})")
            await asyncio.sleep(_LOOK_S)

    def publish(self, topic: Topic[Any], key: str, payload: bytes) -> None:
        """See `Bus`."""
        publisher = self._publishers.get(key)
        is_new = publisher is None
        if publisher is None:
            publisher = self._publishers[key] = self._require().declare_publisher(
                key, priority=_DELIVERY[topic.qos], express=True, congestion_control=_DROP)
        publisher.put(payload)
        if topic.qos is not Qos.COMMAND:
            self._latest[key] = payload
            if is_new:
                self._declared.append(self._require().declare_queryable(
                    key, _direct(lambda query: self._answer(query, key))))
        if self._recorder is not None:
            self._recorder.take(key, payload)

    def post(self, key: str, payload: bytes) -> bool:
        """See `Bus`.

        A process without a router posts nothing. It receives nothing either, so its postings would
        hide that it is deaf: for example, that the routers refuse its expired certificate.
        """
        if self._board is None or (self._dial and not self._linked()) or (
                not self._board.post(key, payload)):
            return False
        self._latest[key] = payload
        return True

    def record(self, key: str, payload: bytes) -> None:
        """See `Bus`."""
        if self._recorder is not None:
            self._recorder.take(key, payload)

    def posted(self, key: str) -> bytes | None:
        """See `Bus`."""
        return None if self._board is None else self._board.read(key)

    def has_readers(self, key: str) -> bool:  # noqa: ARG002
        """See `Bus`."""
        return True

    def subscribe(self, key_expression: str, deliver: Deliver) -> None:
        """See `Bus`."""

        def arrived(sample: zenoh.Sample) -> None:  # runs on a Zenoh thread
            key, payload = str(sample.key_expr), sample.payload.to_bytes()
            self._hand_over(lambda: deliver(key, payload))

        self._declared.append(self._require().declare_subscriber(key_expression, _direct(arrived)))

    def latest(self, key_expression: str, deliver: Deliver, answered: Callable[[], None]) -> None:
        """See `Bus`.

        A stopped process does not answer. A process whose event loop hangs does, because Zenoh's
        threads answer.
        """

        def arrived(reply: zenoh.Reply) -> None:  # runs on a Zenoh thread
            sample = reply.ok
            if sample is not None:
                key, payload = str(sample.key_expr), sample.payload.to_bytes()
                self._hand_over(lambda: deliver(key, payload))

        self._require().get(
            key_expression, _direct(arrived, lambda: self._hand_over(answered)),
            target=zenoh.QueryTarget.ALL, consolidation=zenoh.ConsolidationMode.NONE,
            allowed_destination=zenoh.Locality.REMOTE, timeout=_ANSWER_S,
            priority=_DELIVERY[Qos.STATE],
            congestion_control=_DROP, express=True)

    def _answer(self, query: zenoh.Query, key: str) -> None:  # runs on a Zenoh thread
        payload = self._latest.get(key)
        if payload is not None and self._answers.allows(time.monotonic()):
            query.reply(key, payload, express=True)

    def moved(self) -> bool:
        """See `Bus`; takes less than a microsecond."""
        before, self._routers = self._routers, self._linked()
        return not self._routers or self._routers != before

    def _linked(self) -> list[str]:
        return [str(router) for router in self._require().info.routers_zid()]

    async def close(self) -> None:
        """See `Bus`."""
        session, self._session = self._session, None
        self._declared.clear()
        self._publishers.clear()
        self._latest.clear()
        self._arrived.clear()
        if self._recorder is not None:
            self._recorder.close()
        if session is not None:
            await asyncio.to_thread(session.close)
            asyncio.get_running_loop().remove_reader(self._bell.descriptor)

    def _require(self) -> zenoh.Session:
        if self._session is None:
            raise BusError(f"bus of {self._node or 'tool'} is not open")
        return self._session

    def _hand_over(self, call: Callable[[], None]) -> None:
        if self._session is None:  # the actor has ended
            return
        self._arrived.append(call)
        if not self._is_rung:
            self._is_rung = True  # a race here costs one extra wake-up, never a message
            self._bell.ring()

    def _drain(self) -> None:
        os.eventfd_read(self._bell.descriptor)
        self._is_rung = False  # after the reading: a later message rings again or is drained below
        try:
            for _ in range(_BURST):
                if self._session is None or not self._arrived:
                    break
                self._arrived.popleft()()
        finally:  # a delivery that raises does not delay the others
            if self._arrived:
                self._bell.ring()
