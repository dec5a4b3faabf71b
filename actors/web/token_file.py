"""Secrets in files that only this user can read."""

from __future__ import annotations

import os
import stat
from pathlib import Path

MAX_BYTES = 1000


class SecretError(ValueError):
    """A file must not be taken for a secret, or is none; one line, without what is in it."""


def read_secret(file: Path) -> str:
    """Return the one line of a file that belongs to this user and that others cannot read.

    Raises:
        SecretError: as of `read_private`, or it is no line.
    """
    content = read_private(file, MAX_BYTES + 1)
    lines = content.strip().splitlines()
    if len(lines) != 1 or len(lines[0]) > MAX_BYTES or not lines[0].isascii():
        raise SecretError(f"must hold one line of up to {MAX_BYTES} plain characters")
    return lines[0].decode()


def read_private(file: Path, most: int) -> bytes:
    """Return the first bytes of a file that belongs to this user and that others cannot get at.

    What is looked at is what is then read: the file cannot be exchanged in between.

    Raises:
        SecretError: it is not there, or others can read it, or have written it.
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
        raise SecretError("must be an ordinary file")
    if found.st_uid != os.geteuid():
        raise SecretError(f"belongs to user {found.st_uid}; it must be yours")
    if mode & 0o077:
        raise SecretError(f"mode {mode:04o}: others may get at it; chmod 600 it")
