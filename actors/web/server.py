"""A web server on an actor's event loop: uvicorn's protocols and limits, asyncio's connections.

Uvicorn's `Server` takes over signals and wakes up ten times a second, so it is not used. Bounded
are the number of connections (beyond `ROOM` uvicorn answers 503), the length of a message, idle
connections, and WebSockets that do not answer a ping. On an untrusted network the server belongs
behind a reverse proxy (docs/explanation/security.md).
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import ssl
from collections.abc import Callable
from typing import Any

import uvicorn
from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn._types import ASGISendEvent
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.utils import ClientDisconnected
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from uvicorn.server import ServerState
from websockets.exceptions import InvalidState

from rampart.files.plain_text import one_line
from rampart.files.streams import complain as to_stderr

ROOM = 64
"""Most connections at the same time."""

KEEP_ALIVE_S = 3
PING_S = 5.0
"""Real seconds without answer to a ping after which a WebSocket is closed."""

_HANDSHAKE_S = 5.0
_GOODBYE_S = 1.0


class _WebSocket(WebSocketsSansIOProtocol):
    """Uvicorn's WebSocket, without its assertion that a client waits for the handshake."""

    async def send(self, message: ASGISendEvent) -> None:
        if self.transport.is_closing() and not self.handshake_complete:
            raise ClientDisconnected
        await super().send(message)


class WebServer:
    """Serves an ASGI application on a bound socket.

    Args:
        app: the application.
        listening: bound socket; `stop` closes it.
        tls: context of encrypted connections; None for plain HTTP.
        complain: called with one line for each error of the application, which answers 500 or
            closes.
        settings: of `uvicorn.Config`.
    """

    def __init__(self, app: ASGIApp, listening: socket.socket, *,
                 tls: ssl.SSLContext | None = None, complain: Callable[[str], None] = to_stderr,
                 **settings: Any) -> None:
        self._listening = listening
        self._tls = tls
        self._config = uvicorn.Config(
            _complaining(app, complain), log_config=None, log_level="critical", access_log=False,
            lifespan="off", server_header=False, date_header=False, http=H11Protocol,
            ws=_WebSocket, limit_concurrency=ROOM, timeout_keep_alive=KEEP_ALIVE_S,
            ws_ping_interval=PING_S, ws_ping_timeout=PING_S, ws_per_message_deflate=False,
            **{"proxy_headers": False, **settings})
        self._config.load()
        self._state = ServerState()
        self._opening: asyncio.Task[asyncio.Server] | None = None

    def start(self) -> None:
        """Serve on the running loop."""
        loop = asyncio.get_running_loop()
        self._opening = loop.create_task(loop.create_server(
            lambda: H11Protocol(self._config, self._state, {}), sock=self._listening,
            ssl=self._tls, ssl_handshake_timeout=_HANDSHAKE_S if self._tls else None,
            ssl_shutdown_timeout=_GOODBYE_S if self._tls else None))

    def stop(self) -> None:
        """Stop listening and close all connections; does nothing before `start`."""
        if self._opening is not None and self._opening.done():
            self._opening.result().close()
        elif self._opening is not None:
            self._opening.cancel()
        self._listening.close()
        for connection in list(self._state.connections):
            with contextlib.suppress(InvalidState):  # closing already
                connection.shutdown()


def _complaining(app: ASGIApp, complain: Callable[[str], None]) -> ASGIApp:
    """Return an application that reports its errors; uvicorn's log is off."""

    async def answer(scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await app(scope, receive, send)
        except ClientDisconnected:
            raise
        except Exception as error:
            complain(one_line(f"{scope.get('path', '')}: {type(error).__name__}: {error}"))
            raise

    return answer
