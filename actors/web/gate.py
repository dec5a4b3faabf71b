"""Identifies visitors by their token, and after that by a cookie. Pure, except for the register.

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

from itsdangerous import BadSignature, TimestampSigner

from rampart.actors.web.visitors import Register, Visitor

LASTS_S = 12 * 3600
"""Real seconds after which a visitor has to log in again."""


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
