"""The door of a page: who makes a request, and may it come in at all.

Other users of this machine, where no token is asked for, and foreign hosts and origins are turned
away before all else. The page's files are for everybody, they
are the same for all; so is the form where one logs in. Everything else is for visitors.
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
_LOG_IN = ("Log in first: POST {\"token\": \"...\"} to /login, or send the header "
           "Authorization: Bearer TOKEN")


class _Shown(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    token: str


def visitor_of(scope: Scope) -> Visitor | None:
    """Return who makes a request that has come through the door."""
    found: Visitor | None = scope["state"].get(_VISITOR)
    return found


def address_of(scope: Scope) -> str:
    """Return the address that a request comes from."""
    client = scope.get("client")
    return str(client[0]) if client else ""


class Door:
    """Turns away foreign hosts and origins, and strangers from what is not for all.

    Args:
        app: behind it.
        access: which hosts and origins are this page's.
        gate: who is known.
        public: paths that are for everybody.
        refusal: answer to other users of this machine; "" lets them in.
    """

    def __init__(self, app: ASGIApp, access: Access, gate: Gate, public: frozenset[str],
                 refusal: str = "") -> None:
        self._app = app
        self._refusal = refusal
        self._access = access
        self._gate = gate
        self._public = public | {LOGIN}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request pass, or answer it."""
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
                await send({"type": "websocket.close", "code": 1008})  # before it was accepted: 403
                return
        elif not is_user:
            await PlainTextResponse(self._refusal + "\n", 403)(scope, receive, send)
            return
        elif not is_here:
            await PlainTextResponse("Invalid host header", 400)(scope, receive, send)
            return
        elif scope["method"] not in ("GET", "HEAD") and not is_own:
            await PlainTextResponse("Only for this page", 403)(scope, receive, send)
            return
        elif scope["path"] not in self._public and visitor is None:
            await PlainTextResponse(_LOG_IN, 401)(scope, receive, send)
            return
        await self._app(scope, receive, send)


def _is_this_user(scope: Scope) -> bool:
    """Whether a request on loopback comes from a process of the user who serves the page."""
    client, server = scope["client"], scope["server"]
    return bool(client and server) and plain_address(client[0]).is_loopback and (
        user_of_peer(server, client) == os.getuid())


def login_routes(gate: Gate, audit: AuditLog) -> list[Route]:
    """Return where one logs in and out; nowhere, where no token is asked for."""

    async def log_in(request: Request) -> Response:
        address = address_of(request.scope)
        token = await _token(request)
        if token is None:
            return PlainTextResponse(_LOG_IN, 400, _NO_STORE)
        visitor, told = gate.log_in(token)
        if visitor is None:
            audit.write("log in", address=address, refused=True, why=told)
            return PlainTextResponse(told, 403, _NO_STORE)
        audit.write("log in", who=visitor.name, role=visitor.role, address=address)
        return JSONResponse({"name": visitor.name, "role": visitor.role},
                            headers={"set-cookie": told, **_NO_STORE})

    async def log_out(request: Request) -> Response:
        visitor = visitor_of(request.scope)
        if visitor is not None:
            audit.write("log out", who=visitor.name, role=visitor.role,
                        address=address_of(request.scope))
        return Response(status_code=204, headers={"set-cookie": gate.log_out(), **_NO_STORE})

    return [Route(LOGIN, log_in, methods=["POST"]), Route(LOGOUT, log_out, methods=["POST"])
            ] if gate.asks else []


async def _token(request: Request) -> str | None:
    """Return the token in the body of a request, None if it is something else."""
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > _MOST_BYTES:
            return None
    try:
        return msgspec.json.decode(body, type=_Shown).token
    except (msgspec.DecodeError, ValueError):
        return None
