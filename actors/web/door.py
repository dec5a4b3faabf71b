"""Middleware that finds the visitor of a request and refuses what must not reach the page.

Requests with a foreign host or origin are refused first, and, on a page without tokens, those of
other users of this machine. Everybody may read the page's files and log in. Everything else needs a
visitor.
"""

from __future__ import annotations

import os

import msgspec
from starlette.requests import HTTPConnection, Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from rampart.actors.web.access import Access
from rampart.actors.web.audit import AuditLog
from rampart.actors.web.gate import Gate
from rampart.actors.web.tcp_peer import plain_address, user_of_peer
from rampart.actors.web.visitors import Visitor

LOGIN = "/login"
LOGOUT = "/logout"

_MOST_BYTES = 1000
_VISITOR = "visitor"
_NO_STORE = {"cache-control": "no-store"}
_UNKNOWN = "unknown token"
_LOG_IN = ("Log in: POST {\"token\": \"...\"} to /login, or send the header "
           "Authorization: Bearer TOKEN")


class _Shown(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    token: str


def visitor_of(scope: Scope) -> Visitor | None:
    """Return the visitor that `Door` has found for a request."""
    found: Visitor | None = scope["state"].get(_VISITOR)
    return found


def address_of(scope: Scope) -> str:
    """Return the address of a request's client."""
    client = scope.get("client")
    return str(client[0]) if client else ""


class Door:
    """Refuses foreign hosts and origins, and requests for private paths without a visitor.

    Args:
        app: application that it protects.
        access: hosts and origins of this page.
        gate: knows the visitors.
        public: paths for everybody.
        refusal: answer to other users of this machine; "" admits them.
    """

    def __init__(self, app: ASGIApp, access: Access, gate: Gate, public: frozenset[str],
                 refusal: str = "") -> None:
        self._app = app
        self._refusal = refusal
        self._access = access
        self._gate = gate
        self._public = public | {LOGIN}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        connection = HTTPConnection(scope)
        hosts = connection.headers.getlist("host")
        is_here = len(hosts) == 1 and self._access.own_host(hosts[0])
        is_own = self._access.own_origin(connection.headers.get("origin"))
        visitor = self._gate.visitor(connection.headers.get("authorization"),
                                     connection.headers.get("cookie"))
        scope["state"][_VISITOR] = visitor
        is_user = not self._refusal or _is_this_user(scope)
        if scope["type"] == "websocket":
            if not (is_here and is_own and is_user):
                await send({"type": "websocket.close", "code": 1008})  # not accepted: becomes 403
                return
        elif not is_user:
            await PlainTextResponse(self._refusal + "\n", 403)(scope, receive, send)
            return
        elif not is_here:
            await PlainTextResponse("Invalid host header", 400)(scope, receive, send)
            return
        elif scope["method"] not in ("GET", "HEAD") and not is_own:
            await PlainTextResponse("Foreign origin", 403)(scope, receive, send)
            return
        elif scope["path"] not in self._public and visitor is None:
            await PlainTextResponse(_LOG_IN, 401)(scope, receive, send)
            return
        await self._app(scope, receive, send)


def _is_this_user(scope: Scope) -> bool:
    """Return whether a request comes over loopback from a process of the user of the page."""
    client, server = scope["client"], scope["server"]
    return bool(client and server) and plain_address(client[0]).is_loopback and (
        user_of_peer(server, client) == os.getuid())


def login_routes(gate: Gate, audit: AuditLog) -> list[Route]:
    """Return the routes to log in and out; none if the page needs no token."""

    async def log_in(request: Request) -> Response:
        address = address_of(request.scope)
        token = await _token(request)
        if token is None:
            return PlainTextResponse(_LOG_IN, 400, _NO_STORE)
        visitor = gate.visitor(f"Bearer {token}", None)
        if visitor is None:
            audit.write("log in", address=address, refused=True, why=_UNKNOWN)
            return PlainTextResponse(_UNKNOWN, 403, _NO_STORE)
        audit.write("log in", who=visitor.name, role=visitor.role, address=address)
        return JSONResponse({"name": visitor.name, "role": visitor.role},
                            headers={"set-cookie": gate.cookie(visitor), **_NO_STORE})

    async def log_out(request: Request) -> Response:
        visitor = visitor_of(request.scope)
        if visitor is not None:
            audit.write("log out", who=visitor.name, role=visitor.role,
                        address=address_of(request.scope))
        return Response(status_code=204, headers={"set-cookie": gate.no_cookie(), **_NO_STORE})

    return [Route(LOGIN, log_in, methods=["POST"]), Route(LOGOUT, log_out, methods=["POST"])
            ] if gate.asks else []


async def _token(request: Request) -> str | None:
    """Return the token in the body of a request, None if there is none."""
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > _MOST_BYTES:
            return None
    try:
        return msgspec.json.decode(body, type=_Shown).token
    except (msgspec.DecodeError, ValueError):
        return None
