"""The bus over Zenoh: two linked routers on unix sockets, and every actor a client of one of them.

The routers are processes of the run like others (`rampart.actors.supervision.router`); they listen
in its folder, which only its user can enter. A client knows both: one that starts goes to the
one that has been there longer, so that a message passes one router as a rule; when that one dies
Zenoh goes over to the other within some milliseconds, with all that was declared. What is sent
meanwhile is lost, as on any network.

Zenoh calls back on the thread that reads the socket (`indirect=False`): by default each subscriber
has a thread of its own, which costs a millisecond to declare, as much again when the process ends,
and a wake-up for each message. What is called only appends to a deque and wakes the event loop once
per burst, or answers with what was published last; everything else happens on the loop.
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

from rampart.actors.bus.board import Board
from rampart.actors.bus.bus import BusError, Deliver
from rampart.actors.bus.limits import RateLimit
from rampart.actors.bus.recorder_connection import RecorderConnection
from rampart.actors.bus.topic import Qos, Topic
from rampart.actors.bus.zenoh_session import (
    Credentials,
    answering,
    open_alone,
    open_client,
    open_router,
)

PATIENCE_S = 10.0
"""Real seconds that a client looks for a router when it starts."""

_ANSWERS_PER_S = 500
"""To newcomers, which ask once for each topic that they hear. Who asks more often floods."""

_ANSWER_S = 1.0
"""Real seconds that the newest message of a topic is waited for; nothing else waits meanwhile."""

_LOOK_S = 0.002

_BURST = 256
"""Messages that are delivered one after the other before something else gets its turn: who floods
an actor does not keep it from its timers."""

_DELIVERY = {Qos.SENSOR: zenoh.Priority.DATA, Qos.STATE: zenoh.Priority.INTERACTIVE_HIGH,
             Qos.COMMAND: zenoh.Priority.INTERACTIVE_HIGH}
_DROP = zenoh.CongestionControl.DROP
"""Of all that is sent, commands too. With BLOCK a router waits for a reader that is stopped, or
behind a slow link, before it hands anything on to anybody: for 5 s by default. What is left out is
what finds no room in the queue of a link, which `session_config` makes long enough for a burst."""


_thread = threading.local()


def _direct(call: Callable[[Any], None], end: Callable[[], None] = lambda: None) -> Callback[Any]:
    """Return a handler that is called on the thread that reads; `end` when no more will come.

    Python makes a thread state for each call from a thread of another's, and discards it on return,
    which takes a quarter of the time of an arrival. The first call keeps it for those that follow.
    """

    def called(sample: Any) -> None:
        if not hasattr(_thread, "is_kept"):
            _thread.is_kept = True
            ctypes.pythonapi.PyGILState_Ensure()  # without PyGILState_Release: it is kept
        call(sample)

    return Callback(called, end, indirect=False)


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
        node: whose session this is; "" for a tool.
        dial: endpoints of the routers; to a router, of the other one. None, where nothing listens
            either: it is alone.
        listen: endpoints of a router, that in the folder first; none for a client.
        recorder: connection to a recorder of the run; None for none.
        credentials: by which it shows who it is; None in a run without keys.
        access: what a router lets through; None for everything.
        board: of the host; None if not all nodes of the system are on it.
    """

    bursts = True

    def __init__(self, node: str, dial: Sequence[str],
                 listen: Sequence[str] = (), recorder: RecorderConnection | None = None, *,
                 credentials: Credentials | None = None,
                 access: Mapping[str, Any] | None = None,
                 board: Board | None = None) -> None:
        self._node = node
        self._listen = listen
        self._dial = dial
        self._recorder = recorder
        self._credentials = credentials
        self._access = access
        self._board = board
        self._session: zenoh.Session | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._arrived: deque[Callable[[], None]] = deque()
        self._woken = False
        self._bell = _Bell()
        self._after_burst: list[Callable[[], None]] | None = None
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._latest: dict[str, bytes] = {}
        self._answers = RateLimit(_ANSWERS_PER_S)
        self._held: list[Any] = []
        self._routers: list[str] = []

    def take_name(self, node: str, recorder: RecorderConnection | None,
                  board: Board | None) -> None:
        """Be the bus of this node from now on; the session may be open already."""
        self._node, self._recorder, self._board = node, recorder, board

    async def open(self) -> None:
        """Open the session, unless it is open.

        Raises:
            BusError: the endpoint is in use or invalid, or there is no router.
        """
        if self._session is not None:
            return
        self._loop = asyncio.get_running_loop()
        try:
            if self._listen:
                self._session = open_router(
                    self._listen, self._dial, self._credentials, self._access)
            elif self._dial:
                self._session = await self._joined(self._loop)
            else:
                self._session = open_alone(self._credentials)
        except zenoh.ZError as error:
            text = " ".join(str(error).split())
            node = f"(node {self._node})"
            where = [*self._listen, *self._dial, "the bus"][0]
            raise BusError(f"{where} is in use by another process {node}"
                           if "acquire lock" in text
                           else f"cannot open {where} {node}: {text}") from None
        self._routers = self._linked()
        self._loop.add_reader(self._bell.number, self._drain)

    async def _joined(self, loop: asyncio.AbstractEventLoop) -> zenoh.Session:
        """Return the session of a client, as soon as there is a router."""
        until_s = loop.time() + PATIENCE_S
        while True:
            found = answering(self._dial)
            try:
                if found:
                    both = [*found, *(one for one in self._dial if one not in found)]
                    return open_client(both, self._credentials)
            except zenoh.ZError:  # it ended in this moment
                pass
            if loop.time() > until_s:
                shown = self._credentials
                taking = f" that takes the certificate in {shown.own}" if shown and found else ""
                raise BusError(f"no router at {' or '.join(self._dial)}{taking} "
                               f"({f'node {self._node}' if self._node else 'tool'})")
            await asyncio.sleep(_LOOK_S)

    @property
    def is_open(self) -> bool:
        """Whether there is a session."""
        return self._session is not None

    def publish(self, topic: Topic[Any], key: str, payload: bytes) -> None:
        """Send to all present subscribers of the key."""
        publisher = self._publishers.get(key)
        is_new = publisher is None
        if publisher is None:
            publisher = self._publishers[key] = self._require().declare_publisher(
                key, priority=_DELIVERY[topic.qos], express=True, congestion_control=_DROP)
        publisher.put(payload)
        if topic.qos is not Qos.COMMAND:
            self._latest[key] = payload
            if is_new:
                self._held.append(self._require().declare_queryable(
                    key, _direct(lambda query: self._answer(query, key))))
        if self._recorder is not None:
            self._recorder.take(key, payload)

    def post(self, key: str, payload: bytes) -> bool:
        """Post a message for the nodes of this host; False if it has to be sent instead.

        A process without a router posts nothing. It receives nothing either, so its postings would
        hide that it is deaf: for example, that the routers refuse its expired certificate.
        """
        if self._board is None or (self._dial and not self._linked()) or (
                not self._board.post(key, payload)):
            return False
        self._latest[key] = payload
        return True

    def record(self, key: str, payload: bytes) -> None:
        """Have a message that was posted and is not sent recorded: a recording has no gaps."""
        if self._recorder is not None:
            self._recorder.take(key, payload)

    def posted(self, key: str) -> bytes | None:
        """Return the newest message that was posted by a node of this host."""
        return None if self._board is None else self._board.read(key)

    def has_readers(self, key: str) -> bool:  # noqa: ARG002
        """Not asked of the network: somebody may be listening."""
        return True

    def subscribe(self, topic: Topic[Any], key_expression: str, deliver: Deliver) -> None:  # noqa: ARG002
        """Have `deliver` called on the event loop for each message on keys that match."""

        def arrived(sample: zenoh.Sample) -> None:  # runs on a Zenoh thread
            key, payload = str(sample.key_expr), sample.payload.to_bytes()
            self._hand_over(lambda: deliver(key, payload))

        self._held.append(self._require().declare_subscriber(key_expression, _direct(arrived)))

    def latest(self, key_expression: str, deliver: Deliver, answered: Callable[[], None]) -> None:
        """Have `deliver` called on the event loop with the newest message of each living publisher.

        Whoever is stopped does not answer; whose loop hangs does, for Zenoh's threads do it.
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
        """Whether it has lost its router since this was last asked; less than a microsecond."""
        before, self._routers = self._routers, self._linked()
        return not self._routers or self._routers != before

    def _linked(self) -> list[str]:
        return [str(router) for router in self._require().info.routers_zid()]

    async def close(self) -> None:
        """Close the session."""
        session, self._session = self._session, None
        self._clear()
        if self._recorder is not None:
            self._recorder.close()
        if session is not None:
            await asyncio.to_thread(session.close)
            asyncio.get_running_loop().remove_reader(self._bell.number)

    def _clear(self) -> None:
        self._held.clear()
        self._publishers.clear()
        self._latest.clear()
        self._arrived.clear()

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
        for _ in range(_BURST):
            if self._session is None or not self._arrived:
                break
            self._try(self._arrived.popleft())
        else:
            os.eventfd_write(self._bell.number, 1)  # the rest after what else is due
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
