"""The web server of the page: static files and a WebSocket.

It runs on the actor's event loop (`rampart.actors.web.server`). `rampart.actors.web.door` finds the
visitor of each connection. Each type in `requests` names the role that it needs; this module
compares it with the visitor's role, and writes the result to the audit.
"""

from __future__ import annotations

import asyncio
import contextlib
import html
from collections.abc import Callable, Coroutine, Sequence
from pathlib import Path
from typing import Any

import msgspec
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request as HttpRequest
from starlette.responses import Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from rampart.actors.operator.feed import SEND_TIMEOUT_S, Feed, PageFeed
from rampart.actors.operator.requests import (
    RefusedError,
    Request,
    RequestReader,
    SeenRequest,
    StickRequest,
)
from rampart.actors.web.access import SUBPROTOCOL, Access
from rampart.actors.web.audit import AuditLog
from rampart.actors.web.door import Door, Gate, address_of, login_routes, visitor_of
from rampart.actors.web.listening import listen
from rampart.actors.web.server import WebServer
from rampart.actors.web.tls import Tls
from rampart.actors.web.visitors import Role, Visitor
from rampart.files.plain_text import one_line
from rampart.files.streams import complain as to_stderr

NOT_LOGGED_IN = 4401
"""Close code of a WebSocket without a valid visitor; the page then asks for a token."""

MAX_PAGES = 16
MAX_MESSAGE_BYTES = 4096
CLOSE_TIMEOUT_S = 1.0
"""Real seconds to send a close frame."""

_PAGE = Path(__file__).with_name("page")
_TYPES = {".css": "text/css", ".js": "text/javascript"}
_INDEX = "/"
ROBOT = "/robot/"
"""Path of the files of the robot's panels."""
_LINKS = "<!-- links -->\n"
_REFUSAL = ("This page is for the user who runs the robot, and you are another user of this "
            "machine. Other users need a token: launch.py --hmi-token-file FILE.")
_REVOKED = "your token was revoked, or your role has changed"
_LOOK_S = 1.0
"""Real seconds between two checks whether a page's visitor is still valid."""
_HEADERS = {
    "cache-control": "no-cache",
    "content-security-policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
        "img-src 'self' data:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'; "
        "require-trusted-types-for 'script'; trusted-types 'none'"),  # no text becomes HTML
    "x-content-type-options": "nosniff", "referrer-policy": "no-referrer"}


class Handlers(msgspec.Struct, frozen=True):
    """Callbacks for pages, which are numbered in each incarnation of the node.

    Attributes:
        requests: types of requests.
        came: returns the first message to a new page.
        fulfil: acts on a request of a page and returns the answer; raises RefusedError.
        left: called when a page was closed.
        refuses: why all requests are refused; "" if they are not.
        role: returns the least role for a request; by default that of its type.
    """

    requests: Sequence[type[Request]]
    came: Callable[[int], dict[str, Any]]
    fulfil: Callable[[Request, int], str | dict[str, Any]]
    left: Callable[[int], None]
    refuses: str = ""
    role: Callable[[Request], Role] = lambda request: request.role


class _File(msgspec.Struct, frozen=True):
    content: bytes
    kind: str


def page_files(robot: Path | None) -> dict[str, _File]:
    """Return the files of the page and of the robot's panels, by path."""
    found = {f"{head}{file.name}": _File(file.read_bytes(), _TYPES[file.suffix])
             for head, folder in (("/", _PAGE), (ROBOT, robot)) if folder is not None
             for file in sorted(folder.iterdir()) if file.suffix in _TYPES}
    links = "".join(
        f'<link rel="{"stylesheet" if file.kind.endswith("css") else "modulepreload"}" '
        f'href="{html.escape(path[1:])}">\n' for path, file in found.items()
        if not path.endswith(".min.js"))  # uPlot is a script and not a module
    index = (_PAGE / "index.html").read_text(encoding="utf-8").replace(_LINKS, links)
    return {_INDEX: _File(index.encode(), "text/html"), **found}


class _Page(msgspec.Struct, frozen=True):
    """An open page."""

    number: int
    visitor: Visitor
    address: str


class PageServer:
    """Serves the operator's page on the running loop until `stop`.

    Args:
        access: address and rules.
        feed: contents of the page.
        handlers: callbacks for pages.
        gate: knows the visitors.
        audit: of the page.
        tls: certificate, or None.
        files: folder with the robot's JavaScript and CSS, or None.
        complain: called with one line for each error of a handler.

    Raises:
        PortError: the address cannot be bound.
    """

    def __init__(self, access: Access, feed: Feed, handlers: Handlers,
                 gate: Gate, audit: AuditLog, *, tls: Tls | None = None,
                 files: Path | None = None, complain: Callable[[str], None] = to_stderr) -> None:
        self._feed = feed
        self._complain = complain
        self._handlers = handlers
        self._audit = audit
        self._reader = RequestReader(handlers.requests)
        self._count = 0
        self._open: dict[int, _Page] = {}
        self.port = access.port
        self._gate = gate
        public = page_files(files)

        async def file(request: HttpRequest) -> Response:
            asked = public[request.url.path]
            return Response(asked.content, media_type=asked.kind, headers=_HEADERS)

        asks = self._gate.asks
        routes = [*(Route(path, file) for path in public), *login_routes(self._gate, audit),
                  WebSocketRoute("/ws", self._page)]
        self._server = WebServer(
            Starlette(routes=routes, middleware=[Middleware(
                Door, access=access, gate=self._gate, public=frozenset(public),
                refusal="" if asks else _REFUSAL)]),
            listen(access.host, access.port), tls=tls.serving() if tls else None, complain=complain,
            proxy_headers=bool(access.behind), ws_max_size=MAX_MESSAGE_BYTES)
        self._server.start()

    @property
    def pages(self) -> int:
        """Number of open pages."""
        return len(self._open)

    def stop(self) -> None:
        """Stop listening and close the pages."""
        self._server.stop()

    def drove(self, number: int, panel: str, held: bool, why: str) -> None:
        """Write to the audit that a page has taken or released the stick of a panel."""
        self._note(self._open.get(number), "take the stick" if held else "let go",
                   asked={"panel": panel}, why=why)

    def _note(self, page: _Page | None, what: str, **more: Any) -> None:
        if page is not None:
            self._audit.write(what, who=page.visitor.name, role=page.visitor.role,
                              address=page.address, page=page.number, **more)

    async def _page(self, socket_: WebSocket) -> None:
        offered = socket_.scope.get("subprotocols", ())
        await socket_.accept(SUBPROTOCOL if SUBPROTOCOL in offered else None)
        visitor = visitor_of(socket_.scope)
        if visitor is None:
            await socket_.close(NOT_LOGGED_IN, "log in with your token")
            return
        if self.pages >= MAX_PAGES:
            await socket_.close(1013, f"more than {MAX_PAGES} pages")
            return
        self._count += 1
        page = self._open[self._count] = _Page(self._count, visitor, address_of(socket_.scope))
        self._note(page, "open")
        try:
            with self._feed.page() as fed:
                await _send(socket_, self._introduction(visitor))
                await _send(socket_, self._handlers.came(page.number))
                await _until_one_ends(self._talk(socket_, fed, page), self._push(socket_, fed),
                                      self._watch(socket_, page))
        except (WebSocketDisconnect, TimeoutError):
            return  # the page was closed
        except Exception as error:
            if WebSocketState.DISCONNECTED in {socket_.client_state, socket_.application_state}:
                return
            await _close(socket_, 1011, self._failed("this page", error))
        finally:
            self._handlers.left(page.number)
            self._note(self._open.pop(page.number), "close")

    def _failed(self, what: str, error: Exception) -> str:
        """Report an error of a handler, and return the text for the visitor."""
        self._complain(one_line(f"{what}: {type(error).__name__}: {error}"))
        return f"{what} failed; the log of the run has the reason"

    def _introduction(self, visitor: Visitor) -> dict[str, Any]:
        """Return the message that names the visitor, and the requests that are barred."""
        return {"type": "visitor", "name": visitor.name, "role": visitor.role,
                "logs_out": self._gate.asks,
                "barred": {str(kind.__struct_config__.tag): why
                           for kind in self._handlers.requests
                           if (why := self._bars(kind.role, visitor))}}

    def _bars(self, role: Role, visitor: Visitor) -> str:
        """Return why a visitor may not make a request that needs a role; "" if it may."""
        return self._handlers.refuses or ("" if visitor.role.may(role) else (
            f"Needs the role {role}; {visitor.name} has the role {visitor.role}"))

    async def _talk(self, socket_: WebSocket, fed: PageFeed, page: _Page) -> None:
        while (message := await socket_.receive())["type"] != "websocket.disconnect":
            text = message.get("text") or message.get("bytes")
            answer = self._answer(text, page, fed)
            if answer is not None:
                await _send(socket_, answer)

    async def _watch(self, socket_: WebSocket, page: _Page) -> None:
        """Close the page when its visitor is not valid any more."""
        while self._gate.still(page.visitor):  # noqa: ASYNC110 it is a file that changes
            await asyncio.sleep(_LOOK_S)
        await _close(socket_, NOT_LOGGED_IN, _REVOKED)

    async def _push(self, socket_: WebSocket, page: PageFeed) -> None:
        with contextlib.suppress(WebSocketDisconnect):
            try:
                await self._feed.push(page, socket_.send_text)
            except TimeoutError:
                await _close(socket_, 1013, "this page does not keep up")

    def _answer(self, text: str | bytes | None, page: _Page, fed: PageFeed
                ) -> dict[str, Any] | None:
        request: Request | None = None
        try:
            request = self._reader.read(text)
            if isinstance(request, SeenRequest):
                fed.seen(request.version)
                return None
            if not self._gate.still(page.visitor):
                raise RefusedError(_REVOKED)
            if why := self._bars(self._handlers.role(request), page.visitor):
                raise RefusedError(why)
            answer = self._handlers.fulfil(request, page.number)
        except RefusedError as error:
            self._note_request(page, request, why=str(error), refused=True)
            return {"type": "error", "text": str(error)}
        except Exception as error:  # e.g. of a robot's panel: the page goes on
            kind = "a message" if request is None else str(request.__struct_config__.tag)
            why = self._failed(kind, error)
            self._note_request(page, request, why=why)
            return {"type": "error", "text": why}
        if not isinstance(request, StickRequest):  # these come twenty times a second; see `drove`
            self._note_request(page, request, why=answer if isinstance(answer, str) else "")
        return {"type": "done", "text": answer} if isinstance(answer, str) else answer

    def _note_request(self, page: _Page, request: Request | None, **more: Any) -> None:
        asked = {} if request is None else msgspec.to_builtins(request)
        self._note(page, asked.pop("type", "message"), asked=asked, **more)


async def _until_one_ends(*parts: Coroutine[Any, Any, None]) -> None:
    """Run coroutines concurrently until one ends or raises, and cancel the others."""
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
    """Close a WebSocket, even if the page takes nothing."""
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(socket_.close(code, reason), CLOSE_TIMEOUT_S)


async def _send(socket_: WebSocket, data: Any) -> None:
    text = msgspec.json.encode(data).decode()
    await asyncio.wait_for(socket_.send_text(text), SEND_TIMEOUT_S)
