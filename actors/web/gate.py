"""Lets visitors in by their token, once, and then by a cookie. Pure but for the register.

A token in an address ends up in histories, logs and over shoulders, so it is in none: a person
types it into a form, a script sends it as `Authorization: Bearer TOKEN`. Whoever logs in gets a
cookie that the page's scripts cannot read, that no other site's page sends along, and that over
TLS is sent over TLS alone.

The cookie is the visitor's name, signed with a time (itsdangerous) by a key that the run has made
for itself, salted with the token's digest. So the node that serves the page keeps nothing: it may
die, and its successor knows its visitors. With the token goes the cookie, and with the run all of
them.

Cookies know no ports: a browser sends them to every server of the same host. The key makes those of
another run worthless here, not the other way round; on plain loopback a page of another user of the
machine, opened in the same browser, would be sent it.
"""

from __future__ import annotations

from itsdangerous import BadSignature, TimestampSigner

from rampart.actors.web.visitors import Register, Visitor

LASTS_S = 12 * 3600
"""Real seconds after which a visitor has to log in again."""


class Gate:
    """Who is let in, and how they are known again.

    Args:
        register: of those who may come.
        secret: of the run: key of its cookies.
        port: of the page: part of the cookie's name.
        tls: whether the page is encrypted on its way to the browser.
        owner: who everybody is where no token is asked for; None where one is.
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
        """Whether there is anything to show."""
        return self._owner is None

    def visitor(self, authorization: str | None, cookies: str | None) -> Visitor | None:
        """Return who makes a request, by two of its headers; None if it shows nothing valid."""
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
        """Tell whether somebody who was let in may stay as who he was."""
        return visitor == self._owner or self._register.still(visitor)

    def log_in(self, token: str) -> tuple[Visitor | None, str]:
        """Return who shows a token, and a `Set-Cookie` for them; or None, and why not."""
        visitor = self._owner or self._register.by_token(token)
        if visitor is None:
            return None, "unknown token"
        return visitor, self._set_cookie(
            self._signer(visitor).sign(visitor.name).decode(), LASTS_S)

    def log_out(self) -> str:
        """Return a `Set-Cookie` that takes the cookie away."""
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
