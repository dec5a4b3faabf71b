"""Rules for the requests that may reach a page. Pure.

A user of the operator's page can drive the robot, kill its nodes and release its emergency stop.
So:

* On loopback only the user whose process serves the page may use it; other users of this machine
  need a token (`door` asks the kernel for the user of a connection). Other web pages in the user's
  browser must not use it: the `Host` header has to name this page (against DNS rebinding), and the
  `Origin` of a request that changes something has to be this page. Other programs send no Origin.
* On any other address everybody needs a token, except for the files of the page. The page is
  encrypted, unless the operator declares otherwise. An address literal cannot be rebound, so it is
  a valid `Host`, as are the names in the page's certificate.

`gate` and `visitors` decide who a visitor is and what it may do.
"""

from __future__ import annotations

import ipaddress
import re
import secrets
from urllib.parse import urlsplit

import msgspec

LOOPBACK = ("127.0.0.1", "localhost", "::1")
ANY = ("0.0.0.0", "::")  # noqa: S104 named, not bound
"""All addresses of a machine."""

IpAddress = ipaddress.IPv4Address | ipaddress.IPv6Address

SUBPROTOCOL = "rampart"
_TOKEN = re.compile(r"[A-Za-z0-9._~-]{16,200}")


class AccessError(ValueError):
    """The page must not be served in this way at this address; one line."""


def new_token() -> str:
    """Return a token of 128 random bits that is safe in a URL."""
    return secrets.token_urlsafe(16)


def check_token(token: str) -> str:
    """Return the token.

    Raises:
        AccessError: it is too short or has other characters; the text does not contain it.
    """
    if not _TOKEN.fullmatch(token):
        raise AccessError(f"token of {len(token)} characters: expected 16 to 200 of "
                          "A to Z, a to z, 0 to 9, and - _ . ~")
    return token


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach a listening address."""
    address = _address(host)
    return host == "localhost" or (address is not None and address.is_loopback)


def plain_address(address: str | bytes) -> IpAddress:
    """Return an address; an IPv4 address that is mapped to IPv6 as IPv4.

    Raises:
        ValueError: it is not an address.
    """
    found = ipaddress.ip_address(
        address.partition("%")[0] if isinstance(address, str) else address)
    return getattr(found, "ipv4_mapped", None) or found


def _address(text: str) -> IpAddress | None:
    try:
        return ipaddress.ip_address(text)
    except ValueError:
        return None


def page_url(host: str, port: int, *, tls: bool = False) -> str:
    """Return the URL of a page."""
    host = "127.0.0.1" if host in ANY else host
    host = f"[{host}]" if ":" in host else host
    return f"http{'s' if tls else ''}://{host}:{port}/"


class Access(msgspec.Struct, frozen=True):
    """The rules for a page served at a host and port.

    Args:
        host: address or name to bind to.
        port: TCP port.
        asks: whether visitors need a token.
        tls: whether the page is encrypted.
        plain: whether other machines may reach it unencrypted.
        names: other names of the page: of this machine, and of the page's certificate.
        behind: origin under which a reverse proxy serves the page, e.g. https://robot.example; ""
            without one.

    Raises:
        AccessError: the network could reach it without a token, or unencrypted.
    """

    host: str
    port: int
    asks: bool = False
    tls: bool = False
    plain: bool = False
    names: tuple[str, ...] = ()
    behind: str = ""

    def __post_init__(self) -> None:
        if self.behind:
            parts = urlsplit(self.behind)
            if parts.scheme not in {"http", "https"} or not parts.hostname or (
                    f"{parts.scheme}://{parts.netloc}" != self.behind):
                raise AccessError(f"page behind {self.behind}: expected an origin, e.g. "
                                  "https://robot.example")
            if not self.asks:
                raise AccessError(f"page behind {self.behind}: needs a token, because other "
                                  "machines can reach it")
        if is_loopback(self.host):
            return
        if not self.asks:
            raise AccessError(f"page on {self.host}: needs a token, because other machines can "
                              "reach it")
        if not (self.tls or self.plain):
            raise AccessError(f"page on {self.host}: has to be encrypted, because other machines "
                              "can reach it: --hmi-cert FILE --hmi-key FILE; or "
                              "--hmi-unencrypted on a trusted network")

    @property
    def url(self) -> str:
        """URL of the page."""
        return f"{self.behind}/" if self.behind else page_url(self.host, self.port, tls=self.tls)

    def own_host(self, header: str | None) -> bool:
        """Return whether a `Host` header names this page."""
        if self.behind and header == urlsplit(self.behind).netloc:
            return True
        try:
            parts = urlsplit(f"//{header}")
            return (header is not None and "@" not in header and (parts.port or 80) >= 0
                    and self._own_name(parts.hostname or ""))
        except ValueError:
            return False

    def own_origin(self, origin: str | None) -> bool:
        """Return whether an `Origin` is this page; programs send none."""
        if origin is None or (self.behind and origin == self.behind):
            return True
        scheme, port = ("https", 443) if self.tls else ("http", 80)
        try:
            parts = urlsplit(origin)
            return (parts.scheme == scheme and "@" not in origin and not parts.path
                    and self._own_name(parts.hostname or "") and (parts.port or port) == self.port)
        except ValueError:
            return False

    def _own_name(self, name: str) -> bool:
        own = (self.host.lower(), *(n.lower() for n in self.names))
        if name in LOOPBACK or name in own or f"*.{name.partition('.')[2]}" in own:
            return True
        return self.asks and _address(name) is not None  # without a token, only loopback is here


class PagePlan(msgspec.Struct, frozen=True):
    """Settings of the operator's page of a run, secrets included.

    Attributes:
        port: TCP port; 0 for no page.
        host: address to bind to.
        token: the one token of the page; "" if it needs none, or if a file lists tokens.
        token_is_new: the token was made for this run, so the operator does not know it yet.
        token_file: path of the list of visitors; "" for none.
        cert: path of the certificate; "" for plain HTTP.
        key: path of the certificate's key.
        unencrypted: other machines may reach it unencrypted.
        secret: key of its cookies; without one its node makes one.
        shown: address or name in its URL; "" for `host`.
        audit_log: path of its audit; "" for none.
        behind: origin under which a reverse proxy serves it; "" without one.
    """

    port: int = 0
    host: str = "127.0.0.1"
    token: str = ""
    token_is_new: bool = False
    token_file: str = ""
    cert: str = ""
    key: str = ""
    unencrypted: bool = False
    secret: str = ""
    shown: str = ""
    audit_log: str = ""
    behind: str = ""

    @property
    def url(self) -> str:
        """URL of the page without a token, "" if there is no page."""
        if self.behind:
            return f"{self.behind}/"
        return page_url(self.shown or self.host, self.port, tls=bool(self.cert)
                        ) if self.port else ""

    @property
    def invitation(self) -> str:
        """URL for the person who has started the run: with the token if it is new."""
        if self.token_is_new:
            return f"{self.url} asks for the token {self.token}"
        return f"{self.url} asks for your token" if self.token or self.token_file else self.url
