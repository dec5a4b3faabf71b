"""When processes of this machine end: each once, and before the kernel has taken them apart.

A pidfd (pidfd_open(2)) tells that a process is gone, which is when its memory has been given back:
2 to 7 ms after SIGKILL. Its threads have run their last instruction long before, and there is a
sign of that, too. A *robust mutex* (pthread_mutexattr_setrobust(3)) whose owner dies is marked by
the kernel, and who waits for it is woken, before anything else of the dying thread is taken apart
(get_robust_list(2)): after 0.1 to 0.2 ms. So the main thread of a node's process holds one until it
ends, in a file of the run's folder, its *mark*; and who watches the process maps that file, and
waits in a thread of its own for all that it watches (futex_waitv, Linux 5.16).

What is told so has ended in that it does nothing any more. Its files and ports are free a little
later, which the pidfd tells. Where there is no mark, no such call, or no room for one, the pidfd
tells both.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import errno
import mmap
import os
import platform
import threading
from collections.abc import Callable, Hashable, Iterable
from pathlib import Path
from typing import NamedTuple

from rampart.actors.machine.unix_peer import ProcessId, process_id

_PAGE = mmap.PAGESIZE
_SHARED, _ROBUST = 1, 1
_MUTEX_BYTES = 64
"""More than any pthread_mutex_t and pthread_mutexattr_t takes."""

_HAS_WAITERS, _OWNER_DIED, _OWNER = 0x8000_0000, 0x4000_0000, 0x3FFF_FFFF
"""Bits of the mutex' word (futex(2), linux/futex.h): the kernel wakes if the first is set."""

_FUTEX = {"x86_64": 202, "aarch64": 98, "riscv64": 98}.get(platform.machine())
_FUTEX_WAKE, _FUTEX_WAITV, _SIZE_U32, _MONOTONIC = 1, 449, 2, 1
_EVERYBODY = 0x7FFF_FFFF
_MOST = 128
"""Words that one call can wait for."""

_libc = ctypes.CDLL(None, use_errno=True)
_own: list[mmap.mmap] = []
"""Marks of this process: held, and so mapped, until it ends."""


class LocalProcess(NamedTuple):
    """A process of this machine.

    Attributes:
        id: which.
        mark: file with its mutex, if it has one.
    """

    id: ProcessId
    mark: str = ""


def leave_marks(files: Iterable[str]) -> None:
    """Hold a mutex until this process ends, in a file that has these names from now on.

    To be called by its main thread. Without room or right for it there is none.
    """
    made = Path(f"{next(iter(files))}~{os.getpid()}")
    with contextlib.suppress(OSError):
        descriptor = os.open(made, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        try:
            os.posix_fallocate(descriptor, 0, _PAGE)  # else a full disk is found out by SIGBUS
            mark = mmap.mmap(descriptor, _PAGE)
            if _hold(mark):
                _own.append(mark)
                for number, file in enumerate(files):
                    fresh = made.with_name(f"{made.name}~{number}")
                    os.link(made, fresh)
                    fresh.replace(file)
        finally:
            os.close(descriptor)
            made.unlink()


def _hold(mark: mmap.mmap) -> bool:
    """Lock a robust mutex at the beginning of a mapping; whether the kernel will mark its word."""
    word = ctypes.c_uint32.from_buffer(mark)
    mutex, kind = ctypes.c_void_p(ctypes.addressof(word)), ctypes.create_string_buffer(_MUTEX_BYTES)
    if (_libc.pthread_mutexattr_init(kind) or _libc.pthread_mutexattr_setpshared(kind, _SHARED)
            or _libc.pthread_mutexattr_setrobust(kind, _ROBUST)
            or _libc.pthread_mutex_init(mutex, kind) or _libc.pthread_mutex_lock(mutex)):
        return False
    if word.value & _OWNER != os.getpid():  # a C library whose mutex begins with something else
        return False
    word.value |= _HAS_WAITERS
    return True


class _Wait(ctypes.Structure):
    """`struct futex_waitv` (linux/futex.h)."""

    _fields_ = (("expected", ctypes.c_uint64), ("address", ctypes.c_uint64),
                ("flags", ctypes.c_uint32), ("reserved", ctypes.c_uint32))


class Marks:
    """Waits, in a thread of its own, for the owners of marks to die; told on the running loop."""

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._bell = ctypes.c_uint32(0)
        self._watched: dict[Hashable, tuple[ctypes.c_uint32, Callable[[], None]]] = {}
        self._is_over = _FUTEX is None
        if not self._is_over:
            threading.Thread(target=self._run, name="process ends", daemon=True).start()

    def watch(self, name: Hashable, process: LocalProcess, died: Callable[[], None]) -> None:
        """Have `died` called when a process dies, if it has left a mark; at most once."""
        word = None if self._is_over else _word(process)
        if word is not None:
            self._watched = {**self._watched, name: (word, died)}
            self._ring()

    def let_go(self, name: Hashable) -> None:
        """Watch one no more; what is under way may still be called."""
        if name in self._watched:
            self._watched = {one: what for one, what in self._watched.items() if one != name}
            self._ring()

    def close(self) -> None:
        """End the thread."""
        self._is_over = True
        self._ring()

    def _ring(self) -> None:
        self._bell.value += 1
        _wake(self._bell)

    def _run(self) -> None:
        told: set[int] = set()
        while not self._is_over:
            rung, watched = self._bell.value, self._watched  # never changed, only replaced
            told &= {id(word) for word, _ in watched.values()}
            waits = [_Wait(rung, ctypes.addressof(self._bell), _SIZE_U32)]
            for word, died in watched.values():
                value = word.value
                if not value & _OWNER_DIED:
                    waits.append(_Wait(value, ctypes.addressof(word), _SIZE_U32))
                elif id(word) not in told:
                    told.add(id(word))
                    _wake(word)  # the kernel wakes one of those who wait
                    with contextlib.suppress(RuntimeError):  # the loop has ended
                        self._loop.call_soon_threadsafe(died)
            vector = (_Wait * len(waits))(*waits)
            if (_libc.syscall(_FUTEX_WAITV, vector, min(len(waits), _MOST), 0, None, _MONOTONIC) < 0
                    and ctypes.get_errno() not in {errno.EAGAIN, errno.EINTR}):
                return  # this kernel does not have it


def _word(process: LocalProcess) -> ctypes.c_uint32 | None:
    """Return the word of a process' mutex, mapped; None if there is none, or it is another's."""
    if not process.mark:
        return None
    try:
        descriptor = os.open(process.mark, os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return None
    try:
        if os.fstat(descriptor).st_size < _PAGE:
            return None
        word = ctypes.c_uint32.from_buffer(mmap.mmap(descriptor, _PAGE))
    except (OSError, ValueError):
        return None
    finally:
        os.close(descriptor)
    return word if word.value & _OWNER == process.id.pid else None


def _wake(word: ctypes.c_uint32) -> None:
    if _FUTEX is not None:
        _libc.syscall(_FUTEX, ctypes.byref(word), _FUTEX_WAKE, _EVERYBODY, None, None, 0)


class ProcessEnds:
    """Hears of the ends of processes of this machine, on the running loop, each once.

    They need not be its children.
    """

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._held: dict[Hashable, int] = {}
        self._marks = Marks()

    def hold(self, name: Hashable, process: LocalProcess, ended: Callable[[], None]) -> None:
        """Have `ended` called when a process ends; not for one that is held, or is gone already.

        Without a descriptor left to hold it by it is not: there are other signs.
        """
        if name in self._held:
            return
        try:
            descriptor = os.pidfd_open(process.id.pid)
        except OSError:
            return
        if process_id(process.id.pid) != process.id:  # looked at last: now its number stays its own
            os.close(descriptor)
            return
        self._held[name] = descriptor

        def told() -> None:
            if self._held.get(name) == descriptor:  # it may have been let go meanwhile
                self.let_go(name)
                ended()

        self._loop.add_reader(descriptor, told)
        self._marks.watch(name, process, told)

    def let_go(self, name: Hashable) -> None:
        """Hear no more of one; harmless if it is not held."""
        descriptor = self._held.pop(name, -1)
        if descriptor >= 0:
            self._loop.remove_reader(descriptor)
            os.close(descriptor)
            self._marks.let_go(name)

    def close(self) -> None:
        """Hear no more of any."""
        for name in list(self._held):
            self.let_go(name)
        self._marks.close()
