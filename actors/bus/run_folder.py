"""The folder of a run: its sockets, and which incarnation of each node was issued last.

Only the run's user can enter it, and the kernel sees to that at both ends: no other user can
connect to a socket in it, or put one of his own in the place of a node that is down. So there is no
secret that could leak, no port that could be taken, and no handshake that takes longer for it.

An incarnation is a number that a new process issues before it is heard (`issue`); a reader that
meets a new one looks it up (`Register`). It is kept as the target of a symbolic link, which is
written and read whole or not at all, in a system call or two and with no byte of a disk. Beside it
stands which process that is, if it is one of this machine.

The folder lies in memory where it can: `$XDG_RUNTIME_DIR`, else `/dev/shm`, else the folder for
temporary files. What ends a run removes it; what is left when all of a run dies at once goes
when the same user starts the next one. A lock (flock(2)) shows that a run lives. A pid would not:
the place may be shared with a container, which has pids of its own.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from rampart.actors.bus.board import FileBoard

ROUTERS = ("router_a", "router_b")
"""Names of the sockets of the two routers."""

MAX_SOCKET_BYTES = 107
"""Longest path that the address of a unix socket can hold (unix(7))."""

ROOM_FOR_NAMES = 64
"""Bytes of such a path that are left for the name of a node."""

_NAME = re.compile(r"rampart-\d+-\d+-\w+\Z")
_locks: dict[str, int] = {}
"""By folder that was made here, the lock on it; processes that are forked hold it as well."""

_ISSUED, _SYSTEM, _BOARD = "issued", "system", "board"


def make(port: int, launcher: int) -> str:
    """Make the folder of a run and return its path; remove what dead runs of this user left.

    Args:
        port: base port of the run.
        launcher: pid of its launcher.

    Raises:
        OSError: there is no place for it.
    """
    failure: OSError = FileNotFoundError("no folder for temporary files")
    for place in _places():
        _remove_stale(place)
        try:
            made = Path(tempfile.mkdtemp(prefix=f"rampart-{port}-{launcher}-~", dir=place))
            for inner in (_ISSUED, _BOARD):
                (made / inner).mkdir(mode=0o700)
            lock = os.open(made, os.O_RDONLY | os.O_DIRECTORY)
            fcntl.flock(lock, fcntl.LOCK_EX)
            folder = str(made).replace("~", "")  # only now others look whether it is locked
            made.rename(folder)
            _locks[folder] = lock
            return folder
        except OSError as error:
            failure = error
    raise failure


def remove(folder: str) -> None:
    """Remove the folder of a run that has ended. Harmless when it is gone."""
    if folder:
        shutil.rmtree(folder, ignore_errors=True)
        if (lock := _locks.pop(folder, None)) is not None:
            os.close(lock)


def socket_path(folder: str, name: str) -> str:
    """Return where the socket of that name is.

    Raises:
        ValueError: the name is too long for the address of a socket.
    """
    path = f"{folder}/{name}"
    if len(path.encode()) > MAX_SOCKET_BYTES:
        raise ValueError(f"name {name!r}: must be {ROOM_FOR_NAMES} characters long at most")
    return path


def issue(folder: str, names: Iterable[str], incarnation: int,
          pid: int = 0) -> None:
    """Make a number known as the incarnation of these nodes, before their process is heard.

    Args:
        folder: of the run.
        names: of the nodes.
        incarnation: of their process.
        pid: of their process; 0 if it is on another machine.

    Raises:
        OSError: the folder is gone, or full; or a name is none of a file.
    """
    for name in names:
        if "/" in name or "\0" in name:
            raise OSError(errno.EINVAL, os.strerror(errno.EINVAL), name)
        fresh = Path(folder, _ISSUED, f"{name}~{os.getpid()}~")  # several may issue at once
        fresh.unlink(missing_ok=True)  # left by a process that died here
        fresh.symlink_to(f"{incarnation} {pid}" if pid else f"{incarnation}")
        fresh.replace(fresh.with_name(name))


def change_system(folder: str, system: bytes) -> None:
    """Keep the system as it was changed last, for those that start processes of the run.

    Raises:
        OSError: the folder is gone, or full.
    """
    file = Path(folder, _SYSTEM)
    with contextlib.suppress(OSError):
        if file.read_bytes() == system:
            return
    fresh = file.with_name(f"{_SYSTEM}~{os.getpid()}")
    fresh.write_bytes(system)
    fresh.replace(file)


def changed_system(folder: str, seen: tuple[int, ...]) -> tuple[tuple[int, ...], bytes] | None:
    """Return the system as it was changed last, with a stamp.

    Args:
        folder: of the run.
        seen: the stamp of what was read before; () if nothing was.

    Returns:
        None if there is nothing newer.
    """
    try:
        with Path(folder, _SYSTEM).open("rb") as file:
            found = os.fstat(file.fileno())
            stamp = found.st_ino, found.st_mtime_ns
            return None if stamp == seen else (stamp, file.read())
    except OSError:
        return None


def issued(folder: str) -> dict[str, int]:
    """Return the incarnation issued last of each node of a run."""
    register = register_of(folder)
    try:
        names = [entry.name for entry in Path(folder, _ISSUED).iterdir()]
    except OSError:
        return {}
    return {name: number for name in names
            if not name.endswith("~") and (number := register(name)) is not None}


EPOCH = 1_000_000
"""Beyond a multiple of it begin the incarnations of what is started in another host's place: more
than the restarts of one process in any run, 50 in a minute being a thousand hours' worth."""


def next_epoch(incarnation: int) -> int:
    """Return what the incarnations of a node have to exceed that is started in another place."""
    return (incarnation // EPOCH + 1) * EPOCH


def restarts_of(incarnation: int) -> int:
    """Return how often a node was restarted at least, by its incarnation."""
    return max(0, sum(divmod(incarnation, EPOCH)) - 1)


Register = Callable[[str], int | None]
"""Returns the incarnation of a node that was issued last; None if none ever was."""


def register_of(folder: str) -> Register:
    """Return the register of a run."""

    def look_up(name: str) -> int | None:
        found = _look_up(folder, name)
        return found[0] if found else None

    return look_up


def is_here(folder: str, name: str) -> bool:
    """Whether the incarnation of a node that was issued last is a process of this machine."""
    found = _look_up(folder, name)
    return found is not None and len(found) > 1


def is_elsewhere(folder: str, name: str) -> bool:
    """Whether the incarnation of a node that was issued last is on another machine."""
    found = _look_up(folder, name)
    return found is not None and len(found) == 1


def board_of(folder: str) -> FileBoard:
    """Return this process's access to what the nodes of a run have posted."""
    return FileBoard(f"{folder}/{_BOARD}")


def _look_up(folder: str, name: str) -> tuple[int, ...] | None:
    if "/" in name or "\0" in name:
        return None
    try:
        target = os.readlink(f"{folder}/{_ISSUED}/{name}")  # noqa: PTH115 made of each newcomer
    except (OSError, UnicodeError):
        return None
    words = target.split(" ")
    return tuple(map(int, words)) if all(map(str.isdecimal, words)) else None


def _places() -> Iterator[str]:
    room = MAX_SOCKET_BYTES - ROOM_FOR_NAMES - len("/rampart-32000-4194304-12345678/")
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    for place in (runtime, "/dev/shm", tempfile.gettempdir(), "/tmp"):  # noqa: S108 mkdtemp's
        if place.startswith("/") and len(place.encode()) <= room and Path(place).is_dir():
            yield place


def _remove_stale(place: str) -> None:
    with contextlib.suppress(OSError), os.scandir(place) as entries:
        for entry in entries:
            if _NAME.match(entry.name) is None:
                continue
            with contextlib.suppress(OSError):  # it is locked: its run lives
                folder = os.open(entry.path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
                try:
                    if os.fstat(folder).st_uid == os.getuid():
                        fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
                        remove(entry.path)
                finally:
                    os.close(folder)
