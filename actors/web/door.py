"""Who may pass: the middleware of a page, and how it identifies visitors.

Requests with a foreign host or origin are refused first, and, on a page without tokens, those of
other users of this machine. Everybody may read the page's files and log in. Everything else needs a
visitor.

A token in a URL would end up in histories and logs. So a person types it into a form, and a script
sends it as `Authorization: Bearer TOKEN`. The answer to the form sets a cookie that scripts of the
page cannot read, that pages of other sites do not send, and that a TLS page receives over TLS only.

The cookie is the visitor's name with a time, signed (itsdangerous) by a key of the run that is
salted with the token's digest. So the page's node keeps no state, and its next incarnation knows
the visitors. A cookie ends with its token, and all cookies end with the run.

Browsers send cookies to every port of a host. The key makes cookies of other runs useless here. On
plain loopback, another user's page that is opened in the same browser receives the cookie.
"""

from __future__ import annotations

import os
from pathlib import Path

import msgspec
from itsdangerous import BadSignature, TimestampSigner
from starlette.requests import HTTPConnection, Request
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from rampart.actors.web.access import Access, IpAddress, plain_address
from rampart.actors.web.audit import AuditLog
from rampart.actors.web.visitors import Register, Visitor

LASTS_S = 12 * 3600
"""Real seconds after which a visitor has to log in again."""

LOGIN = "/login"
LOGOUT = "/logout"

_MOST_BYTES = 1000
_VISITOR = "visitor"
_NO_STORE = {"cache-control": "no-store"}
_UNKNOWN = "unknown token"
_LOG_IN = ("Log in: POST {\"token\": \"...\"} to /login, or send the header "
           "Authorization: Bearer TOKEN")


class Gate:
    """Identifies the visitor of a request.

    Args:
        register: the visitors.
        secret: key of the run's cookies.
        port: of the page, in the cookie's name.
        tls: whether the browser reaches the page over TLS.
        owner: the only visitor of a page without tokens; None if the page needs them.
    """

    def __init__(self, register: Register, secret: str, port: int, *, tls: bool,
                 owner: Visitor | None = None) -> None:
        self._register = register
        self._key = secret
        self._tls = tls
        self._owner = owner
        self._cookie = f"{'__Host-' if tls else ''}rampart-{port}"

    @property
    def asks(self) -> bool:
        """Whether the page needs tokens."""
        return self._owner is None

    def visitor(self, authorization: str | None, cookies: str | None) -> Visitor | None:
        """Return the visitor of a request by two of its headers; None if neither is valid."""
        if self._owner is not None:
            return self._owner
        scheme, _, token = (authorization or "").partition(" ")
        if scheme.lower() == "bearer":
            return self._register.by_token(token.strip())
        for part in (cookies or "").split(";"):
            key, _, value = part.strip().partition("=")
            if key == self._cookie and (visitor := self._signed(value)):
                return visitor
        return None

    def still(self, visitor: Visitor) -> bool:
        """Return whether a visitor still has the same token and role."""
        return visitor == self._owner or self._register.still(visitor)

    def cookie(self, visitor: Visitor) -> str:
        """Return the `Set-Cookie` of a visitor."""
        return self._set_cookie(self._signer(visitor).sign(visitor.name).decode(), LASTS_S)

    def no_cookie(self) -> str:
        """Return a `Set-Cookie` that deletes the cookie."""
        return self._set_cookie("", 0)

    def _set_cookie(self, value: str, lasts_s: int) -> str:
        return (f"{self._cookie}={value}; Path=/; Max-Age={lasts_s}; HttpOnly; SameSite=Strict"
                + ("; Secure" if self._tls else ""))

    def _signed(self, value: str) -> Visitor | None:
        name = "".join(value.rsplit(".", 2)[:-2])
        visitor = self._register.visitors().get(name)
        if visitor is None:
            return None
        try:
            self._signer(visitor).unsign(value, max_age=LASTS_S)
        except BadSignature:
            return None
        return visitor

    def _signer(self, visitor: Visitor) -> TimestampSigner:
        return TimestampSigner(self._key, salt=f"rampart {visitor.digest}")


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


# -- the user at the other end of a connection within this machine (proc_net_tcp(5)) -------------


def user_of_peer(local: tuple[str, int], peer: tuple[str, int]) -> int | None:
    """Return the user whose socket is the other end of a connection within this machine.

    Args:
        local: address and port of this end.
        peer: address and port of the other end.

    Returns:
        User id. None if there is no such connection, or no process has its socket any more (the
        kernel reports user 0 then).
    """
    ends = (plain_address(peer[0]), peer[1]), (plain_address(local[0]), local[1])
    for table in ("tcp", "tcp6"):
        try:
            lines = Path("/proc/net", table).read_text(encoding="ascii").splitlines()[1:]
        except OSError:  # a kernel without IPv6
            continue
        for line in lines:
            fields = line.split()
            if (_end(fields[1]), _end(fields[2])) == ends and fields[9] != "0":
                return int(fields[7])
    return None


def _end(field: str) -> tuple[IpAddress, int]:
    """Return address and port of e.g. 0100007F:1F90, in words of the machine's byte order."""
    address, _, port = field.partition(":")
    words = [bytes.fromhex(address[i:i + 8])[::-1] for i in range(0, len(address), 8)]
    return plain_address(b"".join(words)), int(port, 16)
