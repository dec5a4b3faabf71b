"""A web server on an actor's event loop: uvicorn's protocols and limits, asyncio's connections.

Uvicorn's own `Server` takes over signals and wakes up ten times a second, so it is not used. What
is bounded: connections (beyond `ROOM` uvicorn answers 503), the length of a message, idle
connections, WebSockets that do not answer a ping. On a network with strangers the server stands
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
from rampart.files.streams import complain

ROOM = 64
"""Connections at once."""

KEEP_ALIVE_S = 3
PING_S = 5.0
"""A WebSocket that does not answer a ping for so long is closed."""

_HANDSHAKE_S = 5.0
_GOODBYE_S = 1.0


class _WebSocket(WebSocketsSansIOProtocol):
    """Uvicorn's, which asserts that a client is still there when it is accepted or refused."""

    async def send(self, message: ASGISendEvent) -> None:
        if self.transport.is_closing() and not self.handshake_complete:
            raise ClientDisconnected
        await super().send(message)


class WebServer:
    """Serves an ASGI application on a socket that is bound.

    Args:
        app: what is served.
        listening: bound; it is closed by `stop`.
        tls: what connections are encrypted with; None for plain HTTP.
        tell: called with one line for each error of the application, which answers 500 or closes.
        settings: of `uvicorn.Config`.
    """

    def __init__(self, app: ASGIApp, listening: socket.socket, *,
                 tls: ssl.SSLContext | None = None, tell: Callable[[str], None] = complain,
                 **settings: Any) -> None:
        self._listening = listening
        self._tls = tls
        self._config = uvicorn.Config(
            _telling(app, tell), log_config=None, log_level="critical", access_log=False,
            lifespan="off", server_header=False, date_header=False, http=H11Protocol,
            ws=_WebSocket, limit_concurrency=ROOM, timeout_keep_alive=KEEP_ALIVE_S,
            ws_ping_interval=PING_S, ws_ping_timeout=PING_S, ws_per_message_deflate=False,
            **{"proxy_headers": False, **settings})
        self._config.load()
        self._state = ServerState()
        self._opening: asyncio.Task[asyncio.Server] | None = None

    def start(self) -> None:
        """Begin to serve, on the running loop."""
        loop = asyncio.get_running_loop()
        self._opening = loop.create_task(loop.create_server(
            lambda: H11Protocol(self._config, self._state, {}), sock=self._listening,
            ssl=self._tls, ssl_handshake_timeout=_HANDSHAKE_S if self._tls else None,
            ssl_shutdown_timeout=_GOODBYE_S if self._tls else None))

    def stop(self) -> None:
        """Stop listening and say goodbye; harmless when not started."""
        if self._opening is not None and self._opening.done():
            self._opening.result().close()
        elif self._opening is not None:
            self._opening.cancel()
        self._listening.close()
        for connection in list(self._state.connections):
            with contextlib.suppress(InvalidState):  # it is closing already
                connection.shutdown()


def _telling(app: ASGIApp, tell: Callable[[str], None]) -> ASGIApp:
    """Return an application whose errors are reported; uvicorn's own log is silent."""

    async def answer(scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await app(scope, receive, send)
        except ClientDisconnected:
            raise
        except Exception as error:
            tell(one_line(f"{scope.get('path', '')}: {type(error).__name__}: {error}"))
            raise

    return answer
