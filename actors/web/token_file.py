"""Secrets in files that only this user can read."""

from __future__ import annotations

import os
import stat
from pathlib import Path

MAX_BYTES = 1000


class SecretError(ValueError):
    """A file must not be used as a secret; one line, without its contents."""


def read_secret(file: Path) -> str:
    """Return the only line of a private file.

    Raises:
        SecretError: see `read_private`; or it does not have one line.
    """
    content = read_private(file, MAX_BYTES + 1)
    lines = content.strip().splitlines()
    if len(lines) != 1 or len(lines[0]) > MAX_BYTES or not lines[0].isascii():
        raise SecretError(f"expected one line of up to {MAX_BYTES} ASCII characters")
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
