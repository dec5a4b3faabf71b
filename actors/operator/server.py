"""The web side of the page: static files and a WebSocket, on loopback unless asked otherwise.

It runs on the actor's own event loop and costs nothing while no page is open
(`rampart.actors.web.server`, where connections are also let in and seen out).

Who may do what is decided in `rampart.actors.web.access`, how much one may say in `limits`, and
what may be said in `requests`. The files are the same for everybody; everything else needs the
token where there is one. Where there is none, only this process's user is let in at all.
"""

from __future__ import annotations

import asyncio
import contextlib
import html
import socket
from collections.abc import Callable, Coroutine, Sequence
from pathlib import Path
from typing import Any

import msgspec
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import HTTPConnection
from starlette.requests import Request as HttpRequest
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from rampart.actors.operator.camera_eye import CameraError, CameraEye
from rampart.actors.operator.feed import SEND_TIMEOUT_S, Feed, PageFeed
from rampart.actors.operator.limits import MessageBudget, Verdict
from rampart.actors.operator.requests import RefusedError, Request, RequestError, RequestReader
from rampart.actors.web.access import SUBPROTOCOL, Access, is_loopback, shown_token
from rampart.actors.web.server import WebServer, is_known, served

NO_TOKEN = 4401
"""Close code of a WebSocket without the token; its page asks for it."""

MAX_PAGES = 16
MAX_MESSAGE_BYTES = 4096
CLOSE_TIMEOUT_S = 1.0
"""Real seconds for a goodbye to get into the socket."""

_PAGE = Path(__file__).with_name("page")
_TYPES = {".css": "text/css", ".js": "text/javascript"}
_INDEX = "/"
ROBOT = "/robot/"
"""Below it are the files of the robot's own panels."""
_LINKS = "<!-- links -->\n"
_CAMERA = "/camera.jpg"
_REFUSAL = ("This page is for the user who runs the robot; you are another one of this machine. "
            "With a token others get in too: launch.py --hmi-token-file FILE.")
_HEADERS = {
    "cache-control": "no-cache",
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
        "img-src 'self' data:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'; "
        "require-trusted-types-for 'script'; trusted-types 'none'"),  # no text becomes HTML
    "x-content-type-options": "nosniff", "referrer-policy": "no-referrer"}


class PortError(OSError):
    """The page's port cannot be bound."""


class Handlers(msgspec.Struct, frozen=True):
    """What deals with the pages. A page is known by its number in this incarnation of the node.

    Attributes:
        requests: what pages may ask for.
        came: returns what a new page is told first.
        fulfil: acts on a page's request and returns what to tell it; raises RefusedError.
        left: hears of a page that was closed.
    """

    requests: Sequence[type[Request]]
    came: Callable[[int], dict[str, Any]]
    fulfil: Callable[[Request, int], str | dict[str, Any]]
    left: Callable[[int], None]


class _File(msgspec.Struct, frozen=True):
    content: bytes
    kind: str


def page_files(robot: Path | None) -> dict[str, _File]:
    """Return the page's files by path, those of the robot's own panels among them."""
    found = {f"{head}{file.name}": _File(file.read_bytes(), _TYPES[file.suffix])
             for head, folder in (("/", _PAGE), (ROBOT, robot)) if folder is not None
             for file in sorted(folder.iterdir()) if file.suffix in _TYPES}
    links = "".join(
        f'<link rel="{"stylesheet" if file.kind.endswith("css") else "modulepreload"}" '
        f'href="{html.escape(path[1:])}">\n' for path, file in found.items())
    index = (_PAGE / "index.html").read_text(encoding="utf-8").replace(_LINKS, links)
    return {_INDEX: _File(index.encode(), "text/html"), **found}


class PageServer:
    """Serves the operator's page, from when it is made, on the running loop.

    Args:
        port: TCP port; 0 lets the system choose one.
        feed: what pages are shown.
        handlers: what deals with the pages.
        host: address to bind to.
        token: what everybody has to show; "" for nothing, on loopback only.
        camera: where pictures come from, or None.
        files: folder of the robot's own JavaScript and CSS, or None.

    Raises:
        PortError: the address cannot be bound.
        AccessError: it must not without a token.
    """

    def __init__(self, port: int, feed: Feed, handlers: Handlers, host: str, token: str, *,
                 camera: CameraEye | None, files: Path | None = None) -> None:
        self._feed = feed
        self._camera = camera
        self._handlers = handlers
        self._reader = RequestReader(handlers.requests)
        self._count = 0
        Access(host, port, token)  # refused before anything is bound
        listening = _listen(host, port)
        self.port: int = listening.getsockname()[1]
        names = () if is_loopback(host) else (socket.gethostname(),)
        self._access = Access(host, self.port, token, names)
        self.pages = 0
        public = page_files(files)

        async def file(request: HttpRequest) -> Response:
            asked = public[request.url.path]
            return Response(asked.content, media_type=asked.kind, headers=_HEADERS)

        routes = [*(Route(path, file) for path in public), Route(_CAMERA, self._picture),
                  WebSocketRoute("/ws", self._page)]
        self._server = WebServer(
            Starlette(routes=routes, middleware=[Middleware(
                _Door, access=self._access, public=frozenset(public))]),
            listening, refusal="" if token else _REFUSAL, known=not token,
            ws_max_size=MAX_MESSAGE_BYTES)
        self._server.start()

    def stop(self) -> None:
        """Stop listening and say goodbye to the pages."""
        self._server.stop()

    async def _picture(self, request: HttpRequest) -> Response:
        if request.headers.get("sec-fetch-site", "none") not in {"same-origin", "none"}:
            return PlainTextResponse("only for this page", 403)
        try:
            if self._camera is None:
                raise CameraError("this system has no camera")
            with served(request.scope):
                return Response(await self._camera.picture(), media_type="image/jpeg",
                                headers={"cache-control": "no-store"})
        except CameraError as error:
            return PlainTextResponse(str(error), 503)

    async def _page(self, socket_: WebSocket) -> None:
        offered = socket_.scope.get("subprotocols", ())
        await socket_.accept(SUBPROTOCOL if SUBPROTOCOL in offered else None)
        if not _has_token(socket_, self._access):
            await socket_.close(NO_TOKEN, "the token is missing or wrong")
            return
        if self.pages >= MAX_PAGES:
            await socket_.close(1013, f"more than {MAX_PAGES} pages")
            return
        self.pages += 1
        self._count = number = self._count + 1
        try:
            with served(socket_.scope), self._feed.page() as page:
                await _send(socket_, self._handlers.came(number))
                await _until_one_ends(self._talk(socket_, page, number), self._push(socket_, page))
        except (WebSocketDisconnect, RuntimeError, TimeoutError):
            return  # the page has gone while it was being answered
        finally:
            self.pages -= 1
            self._handlers.left(number)

    async def _talk(self, socket_: WebSocket, page: PageFeed, number: int) -> None:
        loop = asyncio.get_running_loop()
        budget = MessageBudget(loop.time())
        while True:
            message = await socket_.receive()
            if message["type"] == "websocket.disconnect":
                return
            verdict = budget.spend(loop.time())
            text = message.get("text") or message.get("bytes")
            if verdict is Verdict.READ:
                if not self._feed.heard(page, text):
                    await _send(socket_, self._answer(text, number))
            elif verdict is Verdict.TELL:
                await _send(socket_, {"type": "error", "text": "too many messages from this page; "
                                      "those beyond the limit are not read"})
            elif verdict is Verdict.CLOSE:
                await _close(socket_, 1008, "flooding: far too many messages")
                return

    async def _push(self, socket_: WebSocket, page: PageFeed) -> None:
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            try:
                await self._feed.push(page, socket_.send_text)
            except TimeoutError:
                await _close(socket_, 1013, "this page does not keep up")

    def _answer(self, text: str | bytes | None, number: int) -> dict[str, Any]:
        try:
            told = self._handlers.fulfil(self._reader.read(text), number)
        except (RequestError, RefusedError) as error:
            return {"type": "error", "text": str(error)}
        return {"type": "done", "text": told} if isinstance(told, str) else told


class _Door:
    """Turns away foreign hosts and origins, and requests without the token, before all else."""

    def __init__(self, app: ASGIApp, access: Access, public: frozenset[str]) -> None:
        self._app = app
        self._public = public
        self._access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        connection = HTTPConnection(scope)
        hosts = connection.headers.getlist("host")
        known = len(hosts) == 1 and self._access.own_host(hosts[0])
        if scope["type"] == "websocket":
            origin = connection.headers.get("origin")
            if not (known and self._access.own_origin(origin)):
                await send({"type": "websocket.close", "code": 1008})  # before it was accepted: 403
                return
        elif not known:
            await PlainTextResponse("Invalid host header", 400)(scope, receive, send)
            return
        elif scope["path"] not in self._public and not _has_token(connection, self._access):
            await PlainTextResponse("The token is missing or wrong", 401)(scope, receive, send)
            return
        await self._app(scope, receive, send)


def _has_token(connection: HTTPConnection, access: Access) -> bool:
    permitted = access.permits(shown_token(
        connection.headers.get("authorization"), connection.query_params.get("token"),
        connection.scope.get("subprotocols", ())))
    if permitted:
        is_known(connection.scope)
    return permitted


async def _until_one_ends(*parts: Coroutine[Any, Any, None]) -> None:
    """Run parts of a conversation side by side until one of them is over or raises."""
    tasks = [asyncio.ensure_future(part) for part in parts]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def _close(socket_: WebSocket, code: int, reason: str) -> None:
    """Say goodbye; a page that takes nothing does not hear it."""
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(socket_.close(code, reason), CLOSE_TIMEOUT_S)


async def _send(socket_: WebSocket, data: Any) -> None:
    text = msgspec.json.encode(data).decode()
    await asyncio.wait_for(socket_.send_text(text), SEND_TIMEOUT_S)


def _listen(host: str, port: int) -> socket.socket:
    listener: socket.socket | None = None
    try:
        family, kind, number, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM)[0]
        listener = socket.socket(family, kind, number)
        # A respawned HMI takes its predecessor's port although old connections linger.
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen(16)
        listener.setblocking(False)
    except (OSError, OverflowError, UnicodeError) as error:
        if listener is not None:
            listener.close()
        reason = getattr(error, "strerror", None) or str(error)
        raise PortError(f"cannot serve the page on {host}:{port}: {reason}; "
                        "choose another hmi_port") from None
    return listener
