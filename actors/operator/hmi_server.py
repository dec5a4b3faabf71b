"""The web side of the HMI: four static files and a WebSocket, on loopback only.

It runs on the actor's own event loop and costs nothing while no page is open: uvicorn is used
for its protocols, without its main loop (ten wake-ups a second) and without its signal handlers
(a node's signals are its process's business).

Whoever can reach the port can reset an emergency stop or send the robot home, so other people's
web pages must not: the `Host` header must name loopback (against DNS rebinding) and a WebSocket's
`Origin` must be this page's own. Programs that are no browsers send no Origin and are let in.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import urlsplit

import msgspec
import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from actors.messages import MissionAction

HOST = "127.0.0.1"
PUSH_PERIOD_S = 0.2
"""Real seconds between two states pushed to a page."""

MAX_PAGES = 8
MAX_MESSAGE_BYTES = 4096
SEND_TIMEOUT_S = 5.0
"""A page that does not take a state for so long is disconnected (it may be suspended)."""

_PAGE = Path(__file__).with_name("page")
_FILES = {
    "/": ("index.html", "text/html"),
    "/style.css": ("style.css", "text/css"),
    "/map.js": ("map.js", "text/javascript"),
    "/app.js": ("app.js", "text/javascript"),
}
_HEADERS = {
    "cache-control": "no-cache",
    "content-security-policy": (
        "default-src 'self'; img-src 'self' data:; frame-ancestors 'none'; base-uri 'none'"),
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
}
_LOOPBACK = ("127.0.0.1", "localhost")


class ResetWish(msgspec.Struct, tag="reset", forbid_unknown_fields=True):
    """The operator wants a latched recovery released."""

    recovery: str


class MissionWish(msgspec.Struct, tag="mission", forbid_unknown_fields=True):
    """The operator wants a mission of the airport started."""

    name: str


class OrderWish(msgspec.Struct, tag="order", forbid_unknown_fields=True):
    """The operator wants something of the mission under way."""

    action: MissionAction
    reason: Annotated[str, msgspec.Meta(max_length=200)] = ""


Wish = ResetWish | MissionWish | OrderWish
_wishes = msgspec.json.Decoder(Wish)


class RefusedError(ValueError):
    """A wish that cannot be fulfilled; the text is shown on the page."""


class PortError(OSError):
    """The page's port cannot be bound."""


class PageServer:
    """Serves the operator's page.

    Args:
        port: TCP port on loopback; 0 lets the system choose one.
        hello: returns what a page gets once: the map, the track so far.
        state: returns what a page gets five times a second.
        fulfil: acts on a wish and returns what to tell the operator; raises RefusedError.
    """

    def __init__(
        self, port: int, hello: Callable[[], Any], state: Callable[[], Any],
        fulfil: Callable[[Wish], str],
    ) -> None:
        self._hello = hello
        self._state = state
        self._fulfil = fulfil
        self._socket = _listen(port)
        self.port: int = self._socket.getsockname()[1]
        self.pages = 0
        self._server: uvicorn.Server | None = None

    async def start(self) -> None:
        """Begin to serve; to be awaited on the actor's loop."""
        files = {path: (_PAGE / name).read_bytes() for path, (name, _) in _FILES.items()}

        async def file(request: Request) -> Response:
            path = request.url.path
            return Response(files[path], media_type=_FILES[path][1], headers=_HEADERS)

        app = Starlette(
            routes=[*(Route(path, file) for path in _FILES),
                    WebSocketRoute("/ws", self._page)],
            middleware=[Middleware(TrustedHostMiddleware, allowed_hosts=list(_LOOPBACK),
                                   www_redirect=False)],
        )
        config = uvicorn.Config(
            app, log_config=None, log_level="critical", access_log=False, lifespan="off",
            server_header=False, date_header=False, ws="websockets-sansio", http="h11",
            ws_max_size=MAX_MESSAGE_BYTES, ws_per_message_deflate=False, limit_concurrency=64,
        )
        config.load()
        self._server = uvicorn.Server(config)
        self._server.lifespan = config.lifespan_class(config)
        await self._server.startup(sockets=[self._socket])

    def stop(self) -> None:
        """Stop listening and say goodbye to the pages; harmless when not started."""
        listening = getattr(self._server, "servers", [])
        if self._server is None or not listening:
            self._socket.close()
            return
        for server in listening:
            server.close()  # closes the socket too
        for connection in list(self._server.server_state.connections):
            connection.shutdown()

    async def _page(self, socket_: WebSocket) -> None:
        if not own_origin(socket_.headers.get("origin"), self.port):
            await socket_.close(1008, "foreign origin")
            return
        await socket_.accept()
        if self.pages >= MAX_PAGES:
            await socket_.close(1013, f"more than {MAX_PAGES} pages")
            return
        self.pages += 1
        push = asyncio.ensure_future(self._push(socket_))
        try:
            while True:
                message = await socket_.receive()
                if message["type"] == "websocket.disconnect":
                    return
                await _send(socket_, self._answer(message.get("text") or message.get("bytes")))
        except (WebSocketDisconnect, RuntimeError, TimeoutError):
            return  # the page has gone while it was being answered
        finally:
            self.pages -= 1
            push.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await push

    async def _push(self, socket_: WebSocket) -> None:
        with contextlib.suppress(WebSocketDisconnect, RuntimeError, TimeoutError):
            await _send(socket_, self._hello())
            while True:
                await _send(socket_, self._state())
                await asyncio.sleep(PUSH_PERIOD_S)

    def _answer(self, text: str | bytes | None) -> dict[str, str]:
        try:
            wish = _wishes.decode(text or b"")
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
            return {"type": "error", "text": f"message not understood: {error}"}
        try:
            return {"type": "done", "text": self._fulfil(wish)}
        except RefusedError as error:
            return {"type": "error", "text": str(error)}


def own_origin(origin: str | None, port: int) -> bool:
    """Tell whether a WebSocket with this Origin header may talk to the page's port."""
    if origin is None:
        return True
    try:
        parts = urlsplit(origin)
        return (parts.scheme == "http" and parts.hostname in _LOOPBACK
                and (parts.port or 80) == port)
    except ValueError:
        return False


async def _send(socket_: WebSocket, data: Any) -> None:
    text = msgspec.json.encode(data).decode()
    await asyncio.wait_for(socket_.send_text(text), SEND_TIMEOUT_S)


def _listen(port: int) -> socket.socket:
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        # A respawned HMI takes its predecessor's port although old connections linger.
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((HOST, port))
        listener.listen(16)
        listener.setblocking(False)
    except (OSError, OverflowError) as error:
        listener.close()
        reason = getattr(error, "strerror", None) or str(error)
        raise PortError(f"cannot serve the page on {HOST}:{port}: {reason}; "
                        "choose another hmi_port") from None
    return listener
