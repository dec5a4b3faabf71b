"""Who may talk to a web page that a node serves. Pure.

A user who reaches the operator's page can drive the robot, kill its nodes and release its emergency
stop. So:

* On loopback the user may whose process serves it; other users of this machine need a token
  (`web_server` asks the kernel whose connection it is). Other people's *web pages* must not, in the
  user's own browser: the `Host` header must name this page (against DNS rebinding), and a
  WebSocket's `Origin` must be the page's own. Programs that are no browsers send no Origin.
* On any other address a token is needed as well, for everything but the files of the page, which
  are the same for everybody. An address literal cannot be rebound, so it is a fine `Host`.

The token travels in clear text, like all of HTTP: outside of a network that you trust, leave the
page on loopback and tunnel to it (`ssh -L`).
"""

from __future__ import annotations

import hmac
import ipaddress
import re
import secrets
from collections.abc import Iterable
from urllib.parse import quote, urlsplit

import msgspec

LOOPBACK = ("127.0.0.1", "localhost", "::1")
TOKEN_PREFIX = "token."  # noqa: S105 it is not one
"""A page cannot set headers of a WebSocket; it names its token as a subprotocol."""

SUBPROTOCOL = "rampart"
_TOKEN = re.compile(r"[A-Za-z0-9._~-]{16,200}")


class AccessError(ValueError):
    """An address at which the page must not be served like this; one line."""


def new_token() -> str:
    """Return a token that cannot be guessed: 128 random bits, safe in a URL."""
    return secrets.token_urlsafe(16)


def is_loopback(host: str) -> bool:
    """Tell whether only this machine can reach an address to bind to."""
    address = _address(host)
    return host == "localhost" or (address is not None and address.is_loopback)


def _address(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(text)
    except ValueError:
        return None


def page_url(host: str, port: int, token: str = "") -> str:
    """Return where to open a page; the token is a fragment, which no browser sends or logs."""
    host = "127.0.0.1" if host in ("0.0.0.0", "::") else host  # noqa: S104 it is shown, not bound
    host = f"[{host}]" if ":" in host else host
    return f"http://{host}:{port}/" + (f"#token={quote(token)}" if token else "")


class Access(msgspec.Struct, frozen=True):
    """The rules for a page served at a host and port.

    Args:
        host: address or name to bind to.
        port: TCP port.
        token: what everybody has to show; "" for nothing, on loopback only.
        names: other names of this machine under which the page may be asked for.

    Raises:
        AccessError: it would be open to the network without a token, or with one that is short.
    """

    host: str
    port: int
    token: str = ""
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not self.token and not is_loopback(self.host):
            raise AccessError(f"page on {self.host}: needs a token, since other machines reach it")
        if self.token and not _TOKEN.fullmatch(self.token):
            raise AccessError(f"token of {len(self.token)} characters: must be 16 or more of "
                              "A to Z, a to z, 0 to 9, and - _ . ~")

    @property
    def url(self) -> str:
        """Where to open the page."""
        return page_url(self.host, self.port, self.token)

    def own_host(self, header: str | None) -> bool:
        """Tell whether a `Host` header means this page."""
        try:
            parts = urlsplit(f"//{header}")
            return (header is not None and "@" not in header and (parts.port or 80) >= 0
                    and self._own_name(parts.hostname or ""))
        except ValueError:
            return False

    def own_origin(self, origin: str | None) -> bool:
        """Tell whether a page of this `Origin` is this page; programs send none."""
        if origin is None:
            return True
        try:
            parts = urlsplit(origin)
            return (parts.scheme == "http" and "@" not in origin and not parts.path
                    and self._own_name(parts.hostname or "") and (parts.port or 80) == self.port)
        except ValueError:
            return False

    def permits(self, shown: str | None) -> bool:
        """Tell whether a token is the right one; takes as long for any wrong one."""
        return not self.token or hmac.compare_digest(
            (shown or "").encode(errors="replace"), self.token.encode())

    def _own_name(self, name: str) -> bool:
        if name in LOOPBACK or name in (self.host.lower(), *(n.lower() for n in self.names)):
            return True
        return bool(self.token) and _address(name) is not None  # without one, only loopback is here


def shown_token(authorization: str | None, query: str | None,
                subprotocols: Iterable[str] = ()) -> str | None:
    """Return the token that a request shows, or None.

    Args:
        authorization: its header of that name, `Bearer TOKEN`.
        query: its parameter `token`.
        subprotocols: those of a WebSocket, `token.TOKEN` among them.
    """
    scheme, _, value = (authorization or "").partition(" ")
    if scheme.lower() == "bearer":
        return value.strip()
    return next((name.removeprefix(TOKEN_PREFIX) for name in subprotocols
                 if name.startswith(TOKEN_PREFIX)), query)
