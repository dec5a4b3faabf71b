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
from typing import Protocol

from rampart.actors.bus.run_folder import mark_of
from rampart.actors.ftm.messages import AdaptedSystem
from rampart.actors.machine.patience import AT_LEISURE, Usage, usage
from rampart.actors.machine.process_ends import LocalProcess, Marks
from rampart.actors.machine.unix_peer import process_id, process_state
from rampart.actors.supervision.node_process import Waits
from rampart.actors.supervision.process_title import RunProcess, find_processes
from rampart.actors.supervision.spawner_client import SpawnerClient, SpawnerUnavailableError

__all__ = ["OsProcesses", "ProcessHandle", "Processes", "RunProcess", "SpawnerUnavailableError"]


class ProcessHandle:
    """One process, held so that its number cannot come to mean another one.

    This class itself is the hold on none: either there is no process, or (`is_gone` False) there
    was no descriptor left to hold it by.
    """

    def __init__(self, *, is_gone: bool = True) -> None:
        self._is_gone = is_gone

    def kill(self) -> None:
        """End it at once (SIGKILL), if it is still there."""

    def gone(self) -> bool:
        """Whether it certainly runs no more and holds nothing, its ports included."""
        return self._is_gone

    def stopped(self) -> bool:
        """Whether it was stopped from outside (SIGSTOP); False if that cannot be known."""
        return False

    def usage(self) -> Usage:
        """Return what it has run, and waited for a processor, as far as that is known."""
        return AT_LEISURE

    def ignore(self) -> None:
        """Do not report its end any more."""

    def close(self) -> None:
        """Let go of it."""


class Processes(Protocol):
    """The processes of one run.

    Attributes:
        has_routers: Whether its bus needs routers.
    """

    has_routers: bool

    def living(self) -> Sequence[RunProcess]:
        """Return those that are there."""

    def fork(self, names: tuple[str, ...], incarnation: int) -> int:
        """Start a process for the named actors and return its pid.

        Raises:
            SpawnerBusyError: It is under way; to be called again with the same names and
                incarnation.
            SpawnerUnavailableError: No spawner could do it now; likewise.
            OSError: Likewise, for want of memory or descriptors.
        """

    def prepare(self, names: tuple[str, ...], incarnation: int, kind: Waits) -> None:
        """Have a process made ready for these actors, silent, for `fork` to take if it can."""

    def is_ready(self, names: tuple[str, ...]) -> bool:
        """Whether there is one, which neither hangs nor is stopped, as far as is known."""

    def set_up(self, names: tuple[str, ...]) -> bool:
        """Have that process set up what it has only rehearsed; False if that is not so."""

    def forget(self, names: tuple[str, ...]) -> None:
        """End a process that was made ready and is not wanted."""

    def withdraw(self, names: tuple[str, ...]) -> None:
        """Likewise, and one that `fork` was called for and is under way."""

    def hold(self, pid: int, ended: Callable[[], None], node: str = "") -> ProcessHandle:
        """Take hold of a process; `ended` is called on the event loop when it ends.

        Sooner if it has left a mark as that node (`process_ends`).

        Raises:
            ProcessLookupError: It is gone already.
            OSError: There is no descriptor left to hold it by.
        """

    def adapt(self, adapted: AdaptedSystem) -> None:
        """Start processes by a changed system from now on."""

    def end(self, handles: Sequence[ProcessHandle], grace_s: float) -> None:
        """End the processes held: asked to, in the sequence given, and killed if they linger."""

    def close(self) -> None:
        """Let go of everything."""


class OsHandle(ProcessHandle):
    """A pidfd, and the mark of the process: of any, not of children only, so it can be adopted."""

    def __init__(self, pid: int, ended: Callable[[], None], marks: Marks | None = None,
                 mark: str = "") -> None:
        self.pidfd = os.pidfd_open(pid)
        self._pid = pid
        self._ended = ended
        self._is_heard = True
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self.pidfd, self._told)
        self._marks = marks
        process = process_id(pid)
        if marks is not None and process is not None:
            marks.watch(self, LocalProcess(process, mark), self._told)

    def _told(self) -> None:
        if self._is_heard:
            self.ignore()
            self._ended()

    def kill(self) -> None:
        self.send(signal.SIGKILL)

    def send(self, number: signal.Signals) -> None:
        """Send a signal, if it is still there."""
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
        return process_state(self._pid) in "Tt"

    def usage(self) -> Usage:
        return usage(self._pid)

    def ignore(self) -> None:
        if self._is_heard:
            self._is_heard = False
            self._loop.remove_reader(self.pidfd)
            if self._marks is not None:
                self._marks.let_go(self)

    def close(self) -> None:
        if self.pidfd >= 0:
            self.ignore()
            os.close(self.pidfd)
            self.pidfd = -1


class OsProcesses(SpawnerClient):
    """Processes of this machine; the run's spawners fork them."""

    has_routers = True
    _marks: Marks | None = None

    def living(self) -> list[RunProcess]:
        """Return the processes of this run, found in /proc."""
        return find_processes(self._port, self._launcher)

    def hold(self, pid: int, ended: Callable[[], None], node: str = "") -> ProcessHandle:
        """Open a pidfd; raises ProcessLookupError if there is no such process."""
        self._marks = self._marks or Marks()
        return OsHandle(pid, ended, self._marks, mark_of(self.folder, node) if node else "")

    def end(self, handles: Sequence[ProcessHandle], grace_s: float) -> None:
        """SIGTERM to all in their sequence, then SIGKILL for those that are there after a while."""
        poll = select.poll()
        waiting = {h.pidfd: h for h in handles if isinstance(h, OsHandle) and h.pidfd >= 0}
        for fd, handle in waiting.items():
            handle.send(signal.SIGTERM)
            poll.register(fd, select.POLLIN)
        deadline = time.monotonic() + grace_s
        while waiting and (left := deadline - time.monotonic()) > 0:
            for fd, _ in poll.poll(left * 1000):
                poll.unregister(fd)
                del waiting[fd]
        for handle in waiting.values():
            handle.kill()

    def close(self) -> None:
        """Let go of everything."""
        if self._marks is not None:
            self._marks.close()
        super().close()
