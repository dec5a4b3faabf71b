"""A web server that strangers cannot fill: uvicorn's protocols, and who may stay at them.

Uvicorn bounds how many connections there are by answering 503 to all alike, and waits without
end for a request that is not finished. Here `web_guests` decides who goes, and uvicorn's two
protocols tell it who comes, who is answered and who leaves. What uvicorn can do is left to it: to
close an idle connection, to ping a WebSocket, to bound a message.

It runs on the caller's event loop, of uvicorn there are but the two protocols: its server wakes up
ten times a second, handles signals, and takes as many connections in one turn of the loop as come.
Here it is one, so that those that are there have a turn after each; and a connection that is
refused costs a tenth of one that is let in. Nothing is done without connections.

Where it is encrypted, a connection counts from its first byte on, not from when hands are shaken:
who never does is closed as who never asks. One that speaks plain HTTP is told where the page is.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import ssl
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Protocol

import uvicorn
from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from uvicorn.server import ServerState
from websockets.exceptions import InvalidState

from rampart.actors.web import guests
from rampart.actors.web.guests import Bucket, Guest, Guests
from rampart.actors.web.tcp_peer import plain_address, user_of_peer
from rampart.files.plain_text import one_line
from rampart.files.streams import complain

QUEUE = 1024
"""Connections that wait in the kernel. Beyond, one is lost and tried again in a second."""

RECEIVE_BUFFER = 16_384
"""Bytes that the kernel keeps of a connection: what it can send that is handled in one turn."""

UNREAD_BYTES = 2_000_000
"""So much may wait for a client that does not read what it is answered."""

KEEP_ALIVE_S = 3
PING_S = 5.0
"""A WebSocket that does not answer a ping for so long is closed."""

TLS_COST = 4.0
"""What one that is encrypted counts among those that come: its handshake is some ms of work."""

_SWEEP_S = 1.0
_RETRY_S = 0.1
_GOODBYE_S = 1.0
_HANDSHAKE = 0x16
"""First byte of a connection that speaks TLS; of HTTP it is a letter."""

_CALLER = "caller"
_GUEST = "guest"
_RECEPTION = "reception"
_SOURCE = "source"

_NOT_YOURS = (
    b"HTTP/1.1 403 Forbidden\r\ncontent-type: text/plain; charset=utf-8\r\nconnection: close\r\n"
    b"x-content-type-options: nosniff\r\ncontent-length: %d\r\n\r\n%b")
_NOT_PLAIN = _NOT_YOURS.replace(b"403 Forbidden", b"400 Bad Request")


class Caller(Protocol):
    """A connection that can be made to go."""

    def abort(self) -> None:
        """Close it at once."""

    def __hash__(self) -> int: ...


class _Arrival:
    """A connection that is not encrypted yet, then is."""

    def __init__(self, task: asyncio.Task[Any] | None) -> None:
        self._task = task
        self.transport: asyncio.Transport | None = None

    def abort(self) -> None:
        if self.transport is not None:
            self.transport.abort()
        elif self._task is not None:
            self._task.cancel()


class Reception:
    """Lets connections in and sees them out.

    Args:
        refusal: what users of this machine are told who are not this process's; "" lets them in.
        known: whether all who are let in are known to be meant.
    """

    def __init__(self, refusal: str, *, known: bool) -> None:
        text = refusal.encode() + b"\n"
        self._refusal = _NOT_YOURS % (len(text), text) if refusal else b""
        self._known = known
        self._guests: Guests[Caller] = Guests()
        self._sweeper: asyncio.TimerHandle | None = None

    def __len__(self) -> int:
        return len(self._guests)

    def source(self, connection: socket.socket) -> str | None:
        """Return whom a connection is counted with; None if it was refused and is closed.

        A machine has as many addresses of IPv6 as it likes; those of one network are one source.
        """
        try:
            peer, local = connection.getpeername()[:2], connection.getsockname()[:2]
        except OSError:  # it has gone again
            connection.close()
            return None
        address = plain_address(peer[0])
        user = user_of_peer(local, peer) if address.is_loopback else None
        if self._refusal and user != os.getuid():
            with connection, contextlib.suppress(OSError):
                connection.send(self._refusal)
            return None
        if address.is_loopback:
            return f"user {user}"
        return str(address) if address.version == 4 else address.packed[:8].hex()

    def came(self, caller: Caller, source: str) -> Guest:
        """Let a connection in, at the cost of another if need be."""
        loop = asyncio.get_running_loop()
        guest, go = self._guests.came(caller, source, known=self._known, now_s=loop.time())
        for one in go:
            one.abort()
        if self._sweeper is None:
            self._sweeper = loop.call_later(_SWEEP_S, self._sweep)
        return guest

    def left(self, caller: Caller) -> None:
        """Forget a connection that is closed."""
        self._guests.left(caller)

    def close(self) -> None:
        """Stop looking for connections that have waited too long."""
        if self._sweeper is not None:
            self._sweeper.cancel()

    def _sweep(self) -> None:
        loop = asyncio.get_running_loop()
        for one in self._guests.overdue(loop.time()):
            one.abort()
        self._sweeper = loop.call_later(_SWEEP_S, self._sweep) if len(self._guests) else None


def source_of(scope: Scope) -> str:
    """Return whom the maker of a request is counted with."""
    return str(scope["state"][_SOURCE])


def is_known(scope: Scope) -> None:
    """Take note that the maker of this request has shown that it may."""
    scope["state"][_GUEST].known = True


@contextlib.contextmanager
def served(scope: Scope) -> Iterator[None]:
    """See to it that a connection is not made to go meanwhile. Only for who is meant."""
    guest: Guest = scope["state"][_GUEST]
    guest.served += 1
    try:
        yield
    finally:
        guest.served -= 1
        guest.since_s = asyncio.get_running_loop().time()


class _Http(H11Protocol):
    """A connection that makes requests, until it becomes a WebSocket."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        if _GUEST not in self.app_state:
            reception: Reception = self.app_state[_RECEPTION]
            guest = reception.came(transport, self.app_state[_SOURCE])
            self.app_state = {**self.app_state, _GUEST: guest, _CALLER: transport}

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self.app_state[_RECEPTION].left(self.app_state[_CALLER])

    def data_received(self, data: bytes) -> None:
        if _may(self.app_state[_GUEST], data, self.transport):
            super().data_received(data)

    def on_response_complete(self) -> None:
        if not self.app_state[_GUEST].answered(self.loop.time()):
            self.transport.close()
        super().on_response_complete()


class _WebSocket(WebSocketsSansIOProtocol):
    """A connection that has become a WebSocket."""

    def __init__(self, config: uvicorn.Config, server_state: ServerState, app_state: dict[str, Any],
                 _loop: asyncio.AbstractEventLoop | None = None) -> None:
        super().__init__(config, server_state, app_state, _loop)
        self._after_goodbye = 0

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self.app_state[_RECEPTION].left(self.app_state[_CALLER])

    def data_received(self, data: bytes) -> None:
        if self.close_sent:  # all that is still of interest is its goodbye
            self._after_goodbye += len(data)
        if self._after_goodbye > RECEIVE_BUFFER:
            self.transport.abort()
        elif _may(self.app_state[_GUEST], data, self.transport):
            super().data_received(data)


def _may(guest: Guest, data: bytes, transport: asyncio.Transport) -> bool:
    """Tell whether a connection may go on; if it floods or does not read, end it."""
    if not guest.sends(len(data), asyncio.get_running_loop().time()) or (
            transport.get_write_buffer_size() > UNREAD_BYTES):
        transport.abort()
        return False
    return True


class WebServer:
    """Serves an ASGI application on a socket that is bound.

    Args:
        app: what is served.
        listening: bound; it is closed by `stop`.
        refusal: see `Reception`.
        known: see `Reception`.
        tls: returns what the next connection is encrypted with; None for plain HTTP.
        not_plain: what who speaks plain HTTP is told then.
        tell: called with one line for each error of the application, which answers 500 or closes.
        settings: of `uvicorn.Config`.
    """

    def __init__(self, app: ASGIApp, listening: socket.socket, *, refusal: str = "",
                 known: bool = False, tls: Callable[[], ssl.SSLContext] | None = None,
                 not_plain: str = "", tell: Callable[[str], None] = complain,
                 **settings: Any) -> None:
        self.reception = Reception(refusal, known=known)
        self._listening = listening
        self._tls = tls
        text = not_plain.encode() + b"\n"
        self._not_plain = _NOT_PLAIN % (len(text), text)
        self._arriving: set[asyncio.Task[None]] = set()
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)  # inherited
        self._config = uvicorn.Config(
            _telling(app, tell), log_config=None, log_level="critical", access_log=False,
            lifespan="off", server_header=False, date_header=False, http=_Http, ws=_WebSocket,
            timeout_keep_alive=KEEP_ALIVE_S, ws_ping_interval=PING_S, ws_ping_timeout=PING_S,
            ws_per_message_deflate=False, **settings)
        self._config.load()
        self._state = ServerState()
        self._accepting: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Begin to serve, on the running loop."""
        self._listening.setblocking(False)
        self._listening.listen(QUEUE)
        self._accepting = asyncio.get_running_loop().create_task(self._accept())

    def stop(self) -> None:
        """Stop listening and say goodbye; harmless when not started."""
        self.reception.close()
        if self._accepting is not None:
            asyncio.get_running_loop().remove_reader(self._listening)
            self._accepting.cancel()
        self._listening.close()
        for arriving in self._arriving:
            arriving.cancel()
        for connection in list(self._state.connections):
            with contextlib.suppress(InvalidState):  # it is closing already
                connection.shutdown()

    async def _accept(self) -> None:
        """Take one connection after the other, at the pace that leaves time for those there are."""
        loop = asyncio.get_running_loop()
        coming = Bucket(guests.COMING_AT_ONCE, guests.COMING_PER_S, loop.time())
        while True:
            cost = guests.REFUSED_COST
            try:
                connection, _ = await loop.sock_accept(self._listening)
                source = self.reception.source(connection)
                if source is not None and self._tls is not None:
                    cost = TLS_COST
                    arriving = loop.create_task(self._encrypt(connection, source, self._tls()))
                    self._arriving.add(arriving)
                    arriving.add_done_callback(self._arriving.discard)
                elif source is not None:
                    cost = 1.0
                    await loop.connect_accepted_socket(
                        partial(self._protocol, {_SOURCE: source}), connection)
            except OSError:  # no descriptor is left, for instance
                await asyncio.sleep(_RETRY_S)
            await asyncio.sleep(coming.take(cost, loop.time()))  # others have their turn

    async def _encrypt(self, connection: socket.socket, source: str, tls: ssl.SSLContext) -> None:
        """Shake hands with who has come, unless it speaks plain HTTP."""
        loop = asyncio.get_running_loop()
        arrival = _Arrival(asyncio.current_task())
        guest = self.reception.came(arrival, source)
        state = {_SOURCE: source, _GUEST: guest, _CALLER: arrival}
        try:
            if await _first_byte(connection) != _HANDSHAKE:
                await loop.sock_sendall(connection, self._not_plain)
                await loop.sock_recv(connection, RECEIVE_BUFFER)  # else the answer may be lost
                raise OSError("no TLS")
            arrival.transport, _ = await loop.connect_accepted_socket(
                partial(self._protocol, state), connection, ssl=tls,
                ssl_handshake_timeout=guests.PATIENCE_S, ssl_shutdown_timeout=_GOODBYE_S)
        except (OSError, asyncio.CancelledError):  # the latter is an abort: nobody waits for this
            self.reception.left(arrival)
            connection.close()

    def _protocol(self, state: dict[str, Any]) -> _Http:
        return _Http(self._config, self._state, {_RECEPTION: self.reception, **state})


def _telling(app: ASGIApp, tell: Callable[[str], None]) -> ASGIApp:
    """Return an application whose errors are told; uvicorn's own log is silent."""

    async def answer(scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await app(scope, receive, send)
        except Exception as error:
            tell(one_line(f"{scope.get('path', '')}: {type(error).__name__}: {error}"))
            raise

    return answer


async def _first_byte(connection: socket.socket) -> int:
    """Return the first byte that a connection sends, which stays there to be read; -1: none."""
    loop = asyncio.get_running_loop()
    readable = asyncio.Event()
    loop.add_reader(connection, readable.set)
    try:
        await readable.wait()
    finally:
        loop.remove_reader(connection)
    return next(iter(connection.recv(1, socket.MSG_PEEK)), -1)
