"""The visitors of a page: named tokens, each with a role.

A token is 128 random bits. The file keeps the SHA-256 of each token, so a copy of the file gives no
access. (Slow hashes are for secrets that can be guessed.) It has one line per visitor:

    anna drive 4c9184f37cff01bcdc32dc486ec36961ad8d...

The file is read again when it changes, so a token can be revoked at once, with the verb or with an
editor. While the file is missing or wrong, it admits no visitors. It is private, as is a file with
the one token of a page.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import re
import stat
from collections.abc import Callable, Iterable
from enum import StrEnum
from pathlib import Path

import msgspec

from rampart.actors.web.access import new_token
from rampart.files.writing import replace_file

SECRET_BYTES = 1000


class SecretError(ValueError):
    """A file must not be used as a secret; one line, without its contents."""


def read_secret(file: Path) -> str:
    """Return the only line of a private file.

    Raises:
        SecretError: see `read_private`; or it does not have one line.
    """
    content = read_private(file, SECRET_BYTES + 1)
    lines = content.strip().splitlines()
    if len(lines) != 1 or len(lines[0]) > SECRET_BYTES or not lines[0].isascii():
        raise SecretError(f"expected one line of up to {SECRET_BYTES} ASCII characters")
    return lines[0].decode()


def read_private(file: Path, most: int) -> bytes:
    """Return the first bytes of a file that belongs to this user and that others cannot access.

    The open file is checked, so it cannot be replaced between the check and the reading.

    Raises:
        SecretError: it cannot be read, belongs to another user, or others can access it.
    """
    try:
        opened = os.open(file, os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise SecretError(f"cannot be read ({why})") from None
    try:
        _check(os.fstat(opened))
        return os.read(opened, most)
    finally:
        os.close(opened)


def _check(found: os.stat_result) -> None:
    mode = stat.S_IMODE(found.st_mode)
    if not stat.S_ISREG(found.st_mode):
        raise SecretError("expected an ordinary file")
    if found.st_uid != os.geteuid():
        raise SecretError(f"belongs to user {found.st_uid}; expected your file")
    if mode & 0o077:
        raise SecretError(f"mode {mode:04o}: others can access it; chmod 600")


def file_state(file: Path) -> tuple[int, ...]:
    """Return numbers that change when a file changes; none if it cannot be found."""
    try:
        found = file.stat()
    except (OSError, ValueError):
        return ()
    return found.st_dev, found.st_ino, found.st_mtime_ns, found.st_ctime_ns, found.st_size


MOST = 200
"""Most visitors in a file."""

MAX_BYTES = 40_000

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.@-]{0,39}")
_DIGEST = re.compile(r"[0-9a-f]{64}")
_HEAD = "# who may use the operator's page: name, role, SHA-256 of the token\n"


class Role(StrEnum):
    """Rights of a visitor; each role includes the previous ones."""

    LOOK = "look"
    DRIVE = "drive"
    INJECT = "inject"

    def may(self, needed: Role) -> bool:
        """Return whether it includes another role."""
        order = list(Role)
        return order.index(self) >= order.index(needed)


class Visitor(msgspec.Struct, frozen=True):
    """A user of a page; `digest` is of the token, "" on a page without tokens."""

    name: str
    role: Role
    digest: str = ""


class VisitorError(ValueError):
    """A name, role or line of the file is not valid; one line, without a token."""


def digest(token: str) -> str:
    """Return the SHA-256 of a token."""
    return hashlib.sha256(token.encode(errors="replace")).hexdigest()


def check_name(name: str) -> str:
    """Return the name of a visitor.

    Raises:
        VisitorError: it is not a valid name.
    """
    if not _NAME.fullmatch(name):
        raise VisitorError(f"name {name[:40]!r}: expected up to 40 letters, digits, and _ . @ -, "
                           "a letter or digit first")
    return name


def check_role(role: str) -> Role:
    """Return the role with a name.

    Raises:
        VisitorError: there is no such role.
    """
    if role not in set(Role):
        raise VisitorError(f"role {role[:40]!r}: unknown; known: {', '.join(Role)}")
    return Role(role)


def parse(lines: Iterable[str]) -> dict[str, Visitor]:
    """Return the visitors in lines of a file, by name; # begins a comment.

    Raises:
        VisitorError: a line is not valid, or repeats a name or token.
    """
    found: dict[str, Visitor] = {}
    for number, line in enumerate(lines, 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            visitor = _visitor(words)
            if visitor.name in found:
                raise VisitorError(f"name {visitor.name!r}: there already; expected each name once")
            if any(hmac.compare_digest(visitor.digest, v.digest) for v in found.values()):
                raise VisitorError(f"{visitor.name!r}: another visitor has the same token")
        except VisitorError as error:
            raise VisitorError(f"line {number}: {error}") from None
        found[visitor.name] = visitor
    if len(found) > MOST:
        raise VisitorError(f"{len(found)} names; expected at most {MOST}")
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
    """Return whether a file lists visitors; otherwise its only line is a bare token.

    Raises:
        SecretError, VisitorError: see `read_visitors`.
    """
    lines = "\n".join(_lines(file)).strip().splitlines()
    return len(lines) != 1 or len(lines[0].split()) == 3 or lines[0].startswith("#")


def read_visitors(file: Path) -> dict[str, Visitor]:
    """Return the visitors of a private file.

    Raises:
        SecretError: it cannot be read, or others can access it.
        VisitorError: it is not a list of visitors.
    """
    return parse(_lines(file))


def _lines(file: Path) -> list[str]:
    content = read_private(file, MAX_BYTES + 1)
    if len(content) > MAX_BYTES or not content.isascii():
        raise VisitorError(f"expected up to {MAX_BYTES} ASCII characters")
    return content.decode().splitlines()


def issue(file: Path, name: str, role: Role) -> str:
    """Add a visitor to a file, which may be new, and return the token, which is stored nowhere.

    Raises:
        SecretError, VisitorError: see `read_visitors`; or the name is there already.
        OSError: the file cannot be written.
    """
    visitors = read_visitors(file) if file.exists() else {}
    if check_name(name) in visitors:
        raise VisitorError(f"{name} has a token already; revoke it first")
    token = new_token()
    _write(file, {**visitors, name: Visitor(name, role, digest(token))})
    return token


def revoke(file: Path, name: str) -> None:
    """Remove a visitor from a file; the token is invalid at once.

    Raises:
        SecretError, VisitorError: see `read_visitors`; or there is no such name.
        OSError: the file cannot be written.
    """
    visitors = read_visitors(file)
    if name not in visitors:
        raise VisitorError(f"no visitor {name[:40]!r}; known: {', '.join(visitors) or 'none'}")
    _write(file, {k: v for k, v in visitors.items() if k != name})


def _write(file: Path, visitors: dict[str, Visitor]) -> None:
    """Replace the file as a whole; comments in it are lost."""
    if len(visitors) > MOST:
        raise VisitorError(f"{len(visitors)} names; expected at most {MOST}")
    lines = "".join(f"{v.name} {v.role} {v.digest}\n" for v in visitors.values())
    replace_file(file.resolve(), (_HEAD + lines).encode("ascii"))


class Register:
    """The current visitors: given ones, and those of a file.

    Args:
        fixed: visitors that are always there.
        file: list of further visitors, or None.
        complain: called with the reason when the file cannot be used, once per change.
    """

    def __init__(self, fixed: Iterable[Visitor] = (), file: Path | None = None,
                 complain: Callable[[str], None] = lambda _why: None) -> None:
        self._fixed = {visitor.name: visitor for visitor in fixed}
        self._file = file
        self._complain = complain
        self._seen: tuple[int, ...] | None = None
        self._listed: dict[str, Visitor] = {}

    def visitors(self) -> dict[str, Visitor]:
        """Return the current visitors by name."""
        if self._file is not None and (state := file_state(self._file)) != self._seen:
            self._seen = state
            try:
                self._listed = read_visitors(self._file)
            except (SecretError, VisitorError) as error:
                self._listed = {}
                self._complain(f"{self._file}: {error}; it admits no visitors")
        return {**self._listed, **self._fixed}

    def by_token(self, token: str) -> Visitor | None:
        """Return the visitor with a token."""
        shown = digest(token)
        found = None
        for visitor in self.visitors().values():
            if visitor.digest and hmac.compare_digest(visitor.digest, shown):
                found = visitor
        return found

    def still(self, visitor: Visitor) -> bool:
        """Return whether a visitor still has the same token and role."""
        return self.visitors().get(visitor.name) == visitor
