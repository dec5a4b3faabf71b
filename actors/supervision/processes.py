"""What the supervisor can do to processes, and how the kernel does it.

The supervisor decides (who is dead, who is respawned when); this is the mechanism. `Processes` is
what it asks for; `OsProcesses` is the machine. In virtual time
`rampart.sim.virtual.virtual_processes` stands here.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import select
import signal
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

from rampart.actors.ftm.messages import AdaptedSystem
from rampart.actors.supervision.patience import AT_LEISURE, Usage, usage
from rampart.actors.supervision.process_title import find_processes, is_stopped
from rampart.actors.supervision.spawner_client import (
    SpawnerBusyError,
    SpawnerClient,
    SpawnerUnavailableError,
)

__all__ = ["Hold", "Living", "OsProcesses", "ProcessHandle", "Processes", "SpawnerBusyError",
           "SpawnerUnavailableError"]


class Living(NamedTuple):
    """A process of the run that is there already."""

    names: tuple[str, ...]
    pid: int
    incarnation: int


class ProcessHandle(Protocol):
    """One process, held so that its number cannot come to mean another one."""

    def kill(self) -> None:
        """End it at once (SIGKILL), if it is still there."""

    def gone(self) -> bool:
        """Whether it runs no more and holds nothing, its ports included."""

    def stopped(self) -> bool:
        """Whether it was stopped from outside (SIGSTOP) and runs nothing."""

    def usage(self) -> Usage:
        """Return what it has run, and waited for a processor."""

    def ignore(self) -> None:
        """Do not report its end any more."""

    def close(self) -> None:
        """Let go of it."""


class Processes(Protocol):
    """The processes of one run."""

    def living(self) -> Sequence[Living]:
        """Return those that are there."""

    def fork(self, names: tuple[str, ...], incarnation: int) -> int:
        """Start a process for the named actors and return its pid.

        Raises:
            SpawnerBusyError: It is under way; to be called again with the same names and
                incarnation.
            SpawnerUnavailableError: Nobody could do it now; likewise.
            OSError: Likewise, for want of memory or descriptors.
        """

    def hold(self, pid: int, ended: Callable[[], None]) -> ProcessHandle:
        """Take hold of a process; `ended` is called on the event loop when it ends.

        Raises:
            ProcessLookupError: It is gone already.
            OSError: There is no descriptor left to hold it by.
        """

    def adapt(self, adapted: AdaptedSystem) -> None:
        """Start processes by a changed system from now on."""

    def end(self, handles: Sequence[ProcessHandle], grace_s: float) -> None:
        """End processes: asked to, in the sequence given, and killed if they linger."""

    def close(self) -> None:
        """Let go of everything."""


class Hold:
    """The hold on a process that may not be there, or for which no descriptor was left.

    Attributes:
        handle: What it is held by, None if it is not.
    """

    def __init__(self) -> None:
        self.handle: ProcessHandle | None = None
        self._is_lacking = False

    def take(self, machine: Processes, pid: int, ended: Callable[[], None]) -> None:
        """Take hold of a process; raises as `Processes.hold`, and counts then as not gone."""
        self._is_lacking = True
        self.handle = machine.hold(pid, ended)
        self._is_lacking = False

    def is_gone(self) -> bool:
        """Whether it certainly runs no more and holds nothing."""
        return not self._is_lacking and (self.handle is None or self.handle.gone())

    def stopped(self) -> bool:
        """Whether it was stopped from outside; False if that cannot be known."""
        return self.handle is not None and self.handle.stopped()

    def usage(self) -> Usage:
        """Return what it has run, and waited for a processor, as far as that is known."""
        return self.handle.usage() if self.handle is not None else AT_LEISURE

    def kill(self) -> None:
        """End it at once, and do not report that."""
        if self.handle is not None:
            self.handle.ignore()
            self.handle.kill()

    def let_go(self) -> None:
        """Let go of it."""
        self._is_lacking = False
        if self.handle is not None:
            self.handle.close()
            self.handle = None


class _OsHandle:
    """A pidfd. It works for processes that are not children, so the living can be adopted."""

    def __init__(self, pid: int, ended: Callable[[], None]) -> None:
        self.pidfd = os.pidfd_open(pid)
        self._pid = pid
        self._ended = ended
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self.pidfd, self._readable)

    def _readable(self) -> None:
        self._loop.remove_reader(self.pidfd)
        self._ended()

    def kill(self) -> None:
        self.send(signal.SIGKILL)

    def send(self, number: signal.Signals) -> None:
        if self.pidfd >= 0:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(self.pidfd, number)

    def gone(self) -> bool:
        # Not the state in /proc: that is the main thread's, which may be a zombie while another
        # thread still ends and holds the ports. A pidfd is readable when the last one has ended.
        if self.pidfd < 0:
            return True
        poll = select.poll()  # not select(), which knows 1024 descriptors
        poll.register(self.pidfd, select.POLLIN)
        return bool(poll.poll(0))

    def stopped(self) -> bool:
        return is_stopped(self._pid)

    def usage(self) -> Usage:
        return usage(self._pid)

    def ignore(self) -> None:
        if self.pidfd >= 0:
            self._loop.remove_reader(self.pidfd)

    def close(self) -> None:
        if self.pidfd >= 0:
            self.ignore()
            os.close(self.pidfd)
            self.pidfd = -1


class OsProcesses:
    """Processes of this machine, forked by the run's spawners.

    Args:
        port: base port of the run.
        launcher: pid of its launcher.
        folder: of its sockets.
    """

    def __init__(self, port: int, launcher: int, folder: str) -> None:
        self._port = port
        self._launcher = launcher
        self._spawner = SpawnerClient(folder, port, launcher)

    def living(self) -> list[Living]:
        """Return the processes of this run, found in /proc."""
        return [Living(p.names, p.pid, p.incarnation) for p in find_processes(self._port)
                if p.launcher == self._launcher]

    def fork(self, names: tuple[str, ...], incarnation: int) -> int:
        """Have a spawner fork; raises SpawnerUnavailableError while none answers."""
        return self._spawner.fork(names, incarnation)

    def hold(self, pid: int, ended: Callable[[], None]) -> ProcessHandle:
        """Open a pidfd; raises ProcessLookupError if there is no such process."""
        return _OsHandle(pid, ended)

    def adapt(self, adapted: AdaptedSystem) -> None:
        """Tell the spawners."""
        self._spawner.adapt(adapted)

    def end(self, handles: Sequence[ProcessHandle], grace_s: float) -> None:
        """SIGTERM to all in their sequence, then SIGKILL for those that are there after a while."""
        poll = select.poll()
        waiting: dict[int, _OsHandle] = {}
        for handle in handles:
            if isinstance(handle, _OsHandle) and handle.pidfd >= 0:
                handle.send(signal.SIGTERM)
                poll.register(handle.pidfd, select.POLLIN)
                waiting[handle.pidfd] = handle
        deadline = time.monotonic() + grace_s
        while waiting and (left := deadline - time.monotonic()) > 0:
            for fd, _ in poll.poll(left * 1000):
                poll.unregister(fd)
                del waiting[fd]
        for handle in waiting.values():
            handle.kill()

    def close(self) -> None:
        """Close the connections to the spawners."""
        self._spawner.close()
