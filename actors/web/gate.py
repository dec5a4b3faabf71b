"""Lets visitors in by their token, once, and then by a cookie. Pure but for the register.

A token in an address ends up in histories, logs and over shoulders, so it is in none: a person
types it into a form, a script sends it as `Authorization: Bearer TOKEN`. Whoever logs in gets a
cookie that the page's scripts cannot read, that no other site's page sends along, and that over
TLS is sent over TLS alone.

The cookie says who, since when, and a MAC of both and of the token's digest, with a key that the
run has made for itself. So the node that serves the page keeps nothing: it may die, and its
successor knows its visitors. With the token goes the cookie, and with the run all of them.

Cookies know no ports: a browser sends them to every server of the same host. The key makes those of
another run worthless here, not the other way round; on plain loopback a page of another user of the
machine, opened in the same browser, would be sent it.
"""

from __future__ import annotations

import hashlib
import hmac
import time
from collections.abc import Callable

from rampart.actors.bus.limits import Remembered
from rampart.actors.web.guests import Bucket
from rampart.actors.web.visitors import Register, Visitor

LASTS_S = 12 * 3600
"""Real seconds after which a visitor has to log in again."""

GUESSES_AT_ONCE = 10
GUESSES_PER_S = 0.5
"""Wrong tokens of one source; beyond, it waits."""

_SOURCES = 256


class Gate:
    """Who is let in, and how they are known again.

    Args:
        register: of those who may come.
        secret: of the run: key of its cookies.
        port: of the page: part of the cookie's name.
        tls: whether the page is encrypted.
        owner: who everybody is where no token is asked for; None where one is.
        clock: real seconds, the same for all processes of the machine.
    """

    def __init__(self, register: Register, secret: str, port: int, *, tls: bool,
                 owner: Visitor | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        self._register = register
        self._key = secret.encode()
        self._tls = tls
        self._owner = owner
        self._clock = clock
        self._cookie = f"{'__Host-' if tls else ''}rampart-{port}"
        self._guesses: Remembered[str, Bucket] = Remembered(_SOURCES)

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
        return self._by_cookie(cookies or "")

    def still(self, visitor: Visitor) -> bool:
        """Tell whether somebody who was let in may stay as who he was."""
        return visitor == self._owner or self._register.still(visitor)

    def log_in(self, token: str, source: str) -> tuple[Visitor | None, str]:
        """Return who shows a token, and a `Set-Cookie` for them; or None, and why not.

        Args:
            token: what was shown.
            source: whom its mistakes are counted with.
        """
        now_s = self._clock()
        guesses = self._guesses.pop(source, None) or Bucket(GUESSES_AT_ONCE, GUESSES_PER_S, now_s)
        self._guesses[source] = guesses
        if not guesses.has(1, now_s):
            return None, "too many wrong tokens; wait some seconds"
        visitor = self._owner or self._register.by_token(token)
        if visitor is None:
            guesses.take(1, now_s)
            return None, "that token opens nothing"
        since = int(now_s)
        value = f"{visitor.name}|{since}|{self._mac(visitor, since)}"
        return visitor, self._set_cookie(value, LASTS_S)

    def log_out(self) -> str:
        """Return a `Set-Cookie` that takes the cookie away."""
        return self._set_cookie("", 0)

    def _set_cookie(self, value: str, lasts_s: int) -> str:
        return (f"{self._cookie}={value}; Path=/; Max-Age={lasts_s}; HttpOnly; SameSite=Strict"
                + ("; Secure" if self._tls else ""))

    def _by_cookie(self, header: str) -> Visitor | None:
        for part in header.split(";"):
            key, _, value = part.strip().partition("=")
            if key == self._cookie and (visitor := self._signed(value)):
                return visitor
        return None

    def _signed(self, value: str) -> Visitor | None:
        name, _, rest = value.partition("|")
        since, _, mac = rest.partition("|")
        visitor = self._register.visitors().get(name)
        if visitor is None or not (since.isascii() and since.isdecimal() and len(since) < 16):
            return None
        is_own = hmac.compare_digest(mac.encode(errors="replace"),
                                     self._mac(visitor, int(since)).encode())
        return visitor if is_own and 0 <= self._clock() - int(since) <= LASTS_S else None

    def _mac(self, visitor: Visitor, since: int) -> str:
        said = f"{visitor.name}|{visitor.digest}|{since}"
        return hmac.new(self._key, said.encode(), hashlib.sha256).hexdigest()
