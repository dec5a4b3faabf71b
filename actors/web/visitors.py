"""Who may use a page, and as what: named tokens, each with a role.

A token is 128 random bits. Its file keeps no token but the SHA-256 of each, so that what is read
in it, or in a copy of it, opens nothing; a slow hash is for secrets that can be guessed. One line
per visitor:

    anna drive 4c9184f37cff01bcdc32dc486ec36961ad8d...

It is read anew when it has changed, so a token that is withdrawn is withdrawn at once, by an editor
as well as by the verb. A file that is not there any more or cannot be read lets nobody in.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import re
import tempfile
from collections.abc import Callable, Iterable
from enum import StrEnum
from pathlib import Path

import msgspec

from rampart.actors.web.access import new_token
from rampart.actors.web.token_file import SecretError, read_private

MOST = 200
"""Visitors in a file."""

MAX_BYTES = 40_000

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.@-]{0,39}")
_DIGEST = re.compile(r"[0-9a-f]{64}")
_HEAD = "# who may use the operator's page: name, role, SHA-256 of the token\n"


class Role(StrEnum):
    """What a visitor may do; each may do what those before it may."""

    LOOK = "look"
    DRIVE = "drive"
    INJECT = "inject"

    def may(self, needed: Role) -> bool:
        """Tell whether it includes another."""
        order = list(Role)
        return order.index(self) >= order.index(needed)


class Visitor(msgspec.Struct, frozen=True):
    """Somebody who may use a page; `digest` is of the token, "" where none is asked for."""

    name: str
    role: Role
    digest: str = ""


class VisitorError(ValueError):
    """A name, role or line that cannot be; one line, without a token."""


def digest(token: str) -> str:
    """Return what is kept of a token."""
    return hashlib.sha256(token.encode(errors="replace")).hexdigest()


def check_name(name: str) -> str:
    """Return a visitor's name.

    Raises:
        VisitorError: it can be none.
    """
    if not _NAME.fullmatch(name):
        raise VisitorError(f"name {name[:40]!r}: expected up to 40 letters, digits, and _ . @ -, "
                           "a letter or digit first")
    return name


def check_role(role: str) -> Role:
    """Return a role by its name.

    Raises:
        VisitorError: there is none of that name.
    """
    if role not in set(Role):
        raise VisitorError(f"role {role[:40]!r}: unknown; there are: {', '.join(Role)}")
    return Role(role)


def parse(lines: Iterable[str]) -> dict[str, Visitor]:
    """Return the visitors that a file lists, by name; blank lines and # are comments.

    Raises:
        VisitorError: a line is none, or names somebody again.
    """
    found: dict[str, Visitor] = {}
    for number, line in enumerate(lines, 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            visitor = _visitor(words)
            if visitor.name in found:
                raise VisitorError(f"name {visitor.name!r}: there already; each name once")
            if any(hmac.compare_digest(visitor.digest, v.digest) for v in found.values()):
                raise VisitorError(f"{visitor.name!r} has the token of another; each has its own")
        except VisitorError as error:
            raise VisitorError(f"line {number}: {error}") from None
        found[visitor.name] = visitor
    if len(found) > MOST:
        raise VisitorError(f"{len(found)} names: {MOST} at most")
    return found


def _visitor(words: list[str]) -> Visitor:
    if len(words) != 3:
        raise VisitorError("expected NAME ROLE SHA256, as `rampart tokens issue` writes it")
    name, role, kept = words
    check_name(name)
    if not _DIGEST.fullmatch(kept):
        raise VisitorError(f"{name}: expected the SHA-256 of a token in 64 hexadecimal digits")
    return Visitor(name, check_role(role), kept)


def lists_visitors(file: Path) -> bool:
    """Tell whether a file lists visitors; one of a single line that is none holds a bare token.

    Raises:
        SecretError, VisitorError: as of `read_visitors`.
    """
    lines = "\n".join(_lines(file)).strip().splitlines()
    return len(lines) != 1 or len(lines[0].split()) == 3 or lines[0].startswith("#")


def read_visitors(file: Path) -> dict[str, Visitor]:
    """Return the visitors of a file that only this user can get at.

    Raises:
        SecretError: others can get at it, or it cannot be read.
        VisitorError: it is no list of visitors.
    """
    return parse(_lines(file))


def _lines(file: Path) -> list[str]:
    content = read_private(file, MAX_BYTES + 1)
    if len(content) > MAX_BYTES or not content.isascii():
        raise VisitorError(f"must be of up to {MAX_BYTES} plain characters")
    return content.decode().splitlines()


def issue(file: Path, name: str, role: Role) -> str:
    """Add a visitor to a file, which is made if need be, and return the token, kept nowhere.

    Raises:
        SecretError, VisitorError: as of `read_visitors`; or there is one of that name.
        OSError: the file cannot be written.
    """
    visitors = read_visitors(file) if file.exists() else {}
    if check_name(name) in visitors:
        raise VisitorError(f"{name} has a token already; revoke it first")
    token = new_token()
    _write(file, {**visitors, name: Visitor(name, role, digest(token))})
    return token


def revoke(file: Path, name: str) -> None:
    """Take a visitor out of a file: the token opens nothing any more, from now on.

    Raises:
        SecretError, VisitorError: as of `read_visitors`; or there is none of that name.
        OSError: the file cannot be written.
    """
    visitors = read_visitors(file)
    if name not in visitors:
        raise VisitorError(f"no {name[:40]!r}; there are: {', '.join(visitors) or 'none'}")
    _write(file, {k: v for k, v in visitors.items() if k != name})


def _write(file: Path, visitors: dict[str, Visitor]) -> None:
    """Replace the file as a whole; comments in it are lost."""
    if len(visitors) > MOST:
        raise VisitorError(f"{len(visitors)} names: {MOST} at most")
    lines = "".join(f"{v.name} {v.role} {v.digest}\n" for v in visitors.values())
    target = file.resolve()
    handle, temporary = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.")  # mode 0600
    try:
        with os.fdopen(handle, "w", encoding="ascii") as made:
            made.write(_HEAD + lines)
            made.flush()
            os.fsync(made.fileno())
        Path(temporary).replace(target)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


class Register:
    """The visitors that there are now: fixed, or those of a file.

    Args:
        fixed: of whom the page was told.
        file: where more of them are, or None.
        complain: is told why the file is not taken, once for each content of it.
    """

    def __init__(self, fixed: Iterable[Visitor] = (), file: Path | None = None,
                 complain: Callable[[str], None] = lambda _why: None) -> None:
        self._fixed = {visitor.name: visitor for visitor in fixed}
        self._file = file
        self._complain = complain
        self._seen: tuple[int, ...] | None = None
        self._listed: dict[str, Visitor] = {}

    def visitors(self) -> dict[str, Visitor]:
        """Return who may come now, by name."""
        if self._file is not None and (state := _state(self._file)) != self._seen:
            self._seen = state
            try:
                self._listed = read_visitors(self._file)
            except (SecretError, VisitorError) as error:
                self._listed = {}
                self._complain(f"{self._file}: {error}; it lets nobody in")
        return {**self._listed, **self._fixed}

    def by_token(self, token: str) -> Visitor | None:
        """Return whose token it is."""
        shown = digest(token)
        found = None
        for visitor in self.visitors().values():
            if visitor.digest and hmac.compare_digest(visitor.digest, shown):
                found = visitor
        return found

    def still(self, visitor: Visitor) -> bool:
        """Tell whether somebody may come as before: with this token, and in this role."""
        return self.visitors().get(visitor.name) == visitor


def _state(file: Path) -> tuple[int, ...]:
    """Return what changes when a file does."""
    try:
        found = file.stat()
    except (OSError, ValueError):
        return ()
    return found.st_dev, found.st_ino, found.st_mtime_ns, found.st_ctime_ns, found.st_size
