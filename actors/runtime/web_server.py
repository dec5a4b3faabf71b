"""A web server that strangers cannot fill: uvicorn's protocols, and who may stay at them.

Uvicorn bounds how many connections there are by answering 503 to all alike, and waits without
end for a request that is not finished. Here `web_guests` decides who goes, and uvicorn's two
protocols tell it who comes, who is answered and who leaves. What uvicorn can do is left to it: to
close an idle connection, to ping a WebSocket, to bound a message.

It runs on the caller's event loop, without uvicorn's main loop (ten wake-ups a second) and without
its signal handlers. It costs nothing while nobody is connected.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
from collections.abc import Iterator
from typing import Any, cast

import uvicorn
from starlette.types import ASGIApp, Scope
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from uvicorn.server import ServerState

from actors.runtime.tcp_peer import plain_address, user_of_peer
from actors.runtime.web_guests import Guest, Guests

AT_ONCE = 16
"""Connections that are taken in one turn of the loop; those that there are have their turn then."""

QUEUE = 256
"""Connections that the kernel keeps until then. Beyond, one is lost and tried again in a second."""

RECEIVE_BUFFER = 16_384
"""Bytes that the kernel keeps of a connection: what it can send that is handled in one turn."""

UNREAD_BYTES = 2_000_000
"""So much may wait for a client that does not read what it is answered."""

KEEP_ALIVE_S = 3
PING_S = 5.0
"""A WebSocket that does not answer a ping for so long is closed."""

_SWEEP_S = 1.0
_GUEST = "guest"
_RECEPTION = "reception"

_NOT_YOURS = (
    b"HTTP/1.1 403 Forbidden\r\ncontent-type: text/plain; charset=utf-8\r\nconnection: close\r\n"
    b"x-content-type-options: nosniff\r\ncontent-length: %d\r\n\r\n%b")


class Reception:
    """Lets connections in and sees them out.

    Args:
        refusal: what users of this machine are told who are not this process's; "" lets them in.
        known: whether all who are let in are known to be meant.
    """

    def __init__(self, refusal: str, *, known: bool) -> None:
        self._refusal = refusal.encode() + b"\n" if refusal else b""
        self._known = known
        self._guests: Guests[asyncio.Transport] = Guests()
        self._sweeper: asyncio.TimerHandle | None = None

    def __len__(self) -> int:
        return len(self._guests)

    def came(self, transport: asyncio.Transport) -> Guest | None:
        """Let a connection in, at the cost of another if need be; None if it is refused."""
        loop = asyncio.get_running_loop()
        user, source = _whose(transport)
        if self._refusal and user != os.getuid():
            transport.write(_NOT_YOURS % (len(self._refusal), self._refusal))
            transport.close()
            return None
        guest, go = self._guests.came(transport, source, known=self._known, now_s=loop.time())
        for one in go:
            one.abort()
        if self._sweeper is None:
            self._sweeper = loop.call_later(_SWEEP_S, self._sweep)
        return guest

    def left(self, transport: asyncio.Transport) -> None:
        """Forget a connection that is closed."""
        self._guests.left(transport)

    def close(self) -> None:
        """Look after nobody any more."""
        if self._sweeper is not None:
            self._sweeper.cancel()

    def _sweep(self) -> None:
        loop = asyncio.get_running_loop()
        for one in self._guests.overdue(loop.time()):
            one.abort()
        self._sweeper = loop.call_later(_SWEEP_S, self._sweep) if len(self._guests) else None


def _whose(transport: asyncio.Transport) -> tuple[int | None, str]:
    """Return the user at the other end, None if it is another machine or unknown, and the source.

    A machine has as many addresses of IPv6 as it likes; those of one network are one source.
    """
    peer, local = transport.get_extra_info("peername"), transport.get_extra_info("sockname")
    if not (peer and local):  # it has gone again
        return None, "gone"
    address = plain_address(peer[0])
    if address.is_loopback:
        user = user_of_peer(local[:2], peer[:2])
        return user, f"user {user}"
    return None, str(address) if address.version == 4 else address.packed[:8].hex()


def is_known(scope: Scope) -> None:
    """Take note that whoever makes this request has shown that it may."""
    guest = scope.get("state", {}).get(_GUEST)
    if guest is not None:
        guest.known = True


@contextlib.contextmanager
def served(scope: Scope) -> Iterator[None]:
    """See to it that a connection is not made to go meanwhile. Only for who is meant."""
    guest: Guest | None = scope.get("state", {}).get(_GUEST)
    if guest is None:  # outside of this server, in a test
        yield
        return
    guest.served += 1
    try:
        yield
    finally:
        guest.served -= 1
        guest.since_s = asyncio.get_running_loop().time()


class _Http(H11Protocol):
    """A connection that makes requests, until it becomes a WebSocket."""

    _guest: Guest | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._guest = self._reception.came(transport)
        self.app_state = {**self.app_state, _GUEST: self._guest}

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._reception.left(self.transport)

    def data_received(self, data: bytes) -> None:
        if _may(self._guest, data, self.transport):
            super().data_received(data)

    def on_response_complete(self) -> None:
        if self._guest is not None:
            self._guest.since_s = self.loop.time()
        super().on_response_complete()

    @property
    def _reception(self) -> Reception:
        return cast("Reception", self.app_state[_RECEPTION])


class _WebSocket(WebSocketsSansIOProtocol):
    """A connection that has become a WebSocket."""

    def __init__(self, config: uvicorn.Config, server_state: ServerState, app_state: dict[str, Any],
                 _loop: asyncio.AbstractEventLoop | None = None) -> None:
        super().__init__(config, server_state, app_state, _loop)
        self._after_goodbye = 0

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self.app_state[_RECEPTION].left(self.transport)

    def data_received(self, data: bytes) -> None:
        if self.close_sent:  # all that is still of interest is its goodbye
            self._after_goodbye += len(data)
        if self._after_goodbye > RECEIVE_BUFFER:
            self.transport.abort()
        elif _may(self.app_state[_GUEST], data, self.transport):
            super().data_received(data)


def _may(guest: Guest | None, data: bytes, transport: asyncio.Transport) -> bool:
    """Tell whether a connection may go on; if it floods or does not read, end it."""
    if guest is None or not guest.sends(len(data), asyncio.get_running_loop().time()) or (
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
        settings: of `uvicorn.Config`.
    """

    def __init__(self, app: ASGIApp, listening: socket.socket, *, refusal: str = "",
                 known: bool = False, **settings: Any) -> None:
        self.reception = Reception(refusal, known=known)
        self._listening = listening
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)  # inherited
        config = uvicorn.Config(
            app, log_config=None, log_level="critical", access_log=False, lifespan="off",
            server_header=False, date_header=False, http=_Http, ws=_WebSocket, backlog=AT_ONCE,
            timeout_keep_alive=KEEP_ALIVE_S, ws_ping_interval=PING_S, ws_ping_timeout=PING_S,
            ws_per_message_deflate=False, **settings)
        config.load()
        self._server = uvicorn.Server(config)
        self._server.lifespan = config.lifespan_class(config)
        self._server.lifespan.state[_RECEPTION] = self.reception

    async def start(self) -> None:
        """Begin to serve, on the running loop."""
        await self._server.startup(sockets=[self._listening])
        self._listening.listen(QUEUE)  # asyncio has one number for both

    def stop(self) -> None:
        """Stop listening and say goodbye; harmless when not started."""
        self.reception.close()
        for server in getattr(self._server, "servers", []):
            server.close()
        self._listening.close()
        for connection in list(self._server.server_state.connections):
            connection.shutdown()
