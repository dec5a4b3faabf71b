"""The folder of a run: its sockets, its postings, and the incarnation issued last for each node.

Only the run's user can enter it. So no other user can connect to its sockets or replace one that is
down, and no secret or port is needed.

A new process issues its incarnation before it publishes (`issue`). A reader that meets a new
incarnation looks it up (`Register`). The number is the target of a symbolic link, which is written
and read whole, in one or two system calls. The link also holds the pid if the process is on this
machine.

The folder is in memory where possible: `$XDG_RUNTIME_DIR`, else `/dev/shm`, else the folder for
temporary files. The end of a run removes it. If all of a run dies at once, the user's next run
removes it. A lock (flock(2)) shows that a run lives. A pid would not, because a container that
shares the folder has other pids.
"""

from __future__ import annotations

import contextlib
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

_MAX_SOCKET_BYTES = 107
"""Longest path of a unix socket (unix(7))."""

_LONGEST = f"/rampart-32000-4194304-12345678/{ROUTERS[0]}"

_NAME = re.compile(r"rampart-\d+-\d+-\w+\Z")
_locks: dict[str, int] = {}
"""Lock on each folder that this process made. Forked processes hold it as well."""

_ISSUED, _SYSTEM, _BOARD = "issued", "system", "board"


def make(port: int, launcher: int) -> str:
    """Make the folder of a run and return its path. Remove what dead runs of this user left.

    Args:
        port: Base port of the run.
        launcher: Pid of its launcher.

    Raises:
        OSError: No place can hold it.
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
            folder = str(made).replace("~", "")  # from now on others look whether it is locked
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


def issue(folder: str, names: Iterable[str], incarnation: int, pid: int = 0) -> None:
    """Register the incarnation of nodes, before their process publishes.

    Args:
        folder: Folder of the run.
        names: Names of the nodes.
        incarnation: Number of their process.
        pid: Their process; 0 if it is on another machine.

    Raises:
        OSError: The folder is gone or full.
    """
    for name in names:
        fresh = Path(folder, _ISSUED, f"{name}~{os.getpid()}~")  # several may issue at once
        fresh.unlink(missing_ok=True)  # left by a process that died here
        fresh.symlink_to(f"{incarnation} {pid}" if pid else f"{incarnation}")
        fresh.replace(fresh.with_name(name))


def change_system(folder: str, system: bytes) -> None:
    """Keep the changed system for those that start processes of the run.

    Raises:
        OSError: The folder is gone or full.
    """
    file = Path(folder, _SYSTEM)
    with contextlib.suppress(OSError):
        if file.read_bytes() == system:
            return
    fresh = file.with_name(f"{_SYSTEM}~{os.getpid()}")
    fresh.write_bytes(system)
    fresh.replace(file)


def changed_system(folder: str, seen: tuple[int, ...]) -> tuple[tuple[int, ...], bytes] | None:
    """Return the stamp and content of the last change of the system; None if there is none newer.

    Args:
        folder: Folder of the run.
        seen: Stamp of the change that was read before; () if none was.
    """
    try:
        with Path(folder, _SYSTEM).open("rb") as file:
            found = os.fstat(file.fileno())
            stamp = found.st_ino, found.st_mtime_ns
            return None if stamp == seen else (stamp, file.read())
    except OSError:
        return None


def issued(folder: str) -> dict[str, int]:
    """Return the incarnation issued last for each node of a run."""
    register = register_of(folder)
    try:
        names = [entry.name for entry in Path(folder, _ISSUED).iterdir()]
    except OSError:
        return {}
    return {name: number for name in names
            if not name.endswith("~") and (number := register(name)) is not None}


EPOCH = 1_000_000
"""Incarnations that replace those of a lost host begin beyond a multiple of this number. No process
restarts as often in a run: at 50 restarts a minute it would take two weeks.
"""


def next_epoch(incarnation: int) -> int:
    """Return the number that the incarnations of a node exceed when another host takes it over."""
    return (incarnation // EPOCH + 1) * EPOCH


def restarts_of(incarnation: int) -> int:
    """Return how often a node was restarted at least, by its incarnation."""
    return max(0, sum(divmod(incarnation, EPOCH)) - 1)


Register = Callable[[str], int | None]
"""Returns the incarnation issued last for a node; None if there is none."""


def register_of(folder: str) -> Register:
    """Return the register of a run."""

    def look_up(name: str) -> int | None:
        found = _look_up(folder, name)
        return found[0] if found else None

    return look_up


def is_here(folder: str, name: str) -> bool:
    """Whether the last incarnation of a node is a process of this machine."""
    return len(_look_up(folder, name)) == 2


def is_elsewhere(folder: str, name: str) -> bool:
    """Whether the last incarnation of a node is on another machine."""
    return len(_look_up(folder, name)) == 1


def board_of(folder: str) -> FileBoard:
    """Return this process's access to the postings of a run."""
    return FileBoard(f"{folder}/{_BOARD}")


def _look_up(folder: str, name: str) -> tuple[int, ...]:
    """Return incarnation and pid of a node: (n, pid) on this machine, (n,) on another, or ()."""
    if "/" in name or "\0" in name:  # names come from messages
        return ()
    try:
        target = os.readlink(f"{folder}/{_ISSUED}/{name}")  # noqa: PTH115 pathlib is slower
    except (OSError, UnicodeError):
        return ()
    words = target.split(" ")
    return tuple(map(int, words)) if all(map(str.isdecimal, words)) else ()


def _places() -> Iterator[str]:
    room = _MAX_SOCKET_BYTES - len(_LONGEST)
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
