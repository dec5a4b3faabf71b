"""The supervisor's interface to processes, and its implementation by kernel and root.

The supervisor decides, and acts through `Processes`. `OsProcesses` is this machine; a run in
virtual time has `rampart.sim.virtual.virtual_processes` instead.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import select
import signal
import socket
from collections.abc import Callable, Sequence
from typing import Protocol

import msgspec

from rampart.actors.bus.run_folder import change_system
from rampart.actors.ftm.messages import AdaptedSystem
from rampart.actors.machine.patience import AT_LEISURE, Usage, usage
from rampart.actors.machine.unix_peer import process_state
from rampart.actors.supervision.process_title import RunProcess, find_processes, kill
from rampart.actors.supervision.requests import ALIVE, REQUEST_BYTES, WELL, ForkRequest, Reply

__all__ = ["OsProcesses", "ProcessHandle", "Processes", "RunProcess"]

ALIVE_S = 0.25
"""Wall seconds between two messages to the root, each with a check whether the root is stopped."""

Answer = Callable[[int, str], None]
"""Receives the pid of a new process, or 0 and why there is none, in one line."""


class ProcessHandle:
    """A hold on one process, which stays valid when the kernel reuses the pid.

    This class itself holds nothing: there is no process, or, if `is_gone` is False, no descriptor
    was left to hold it by.
    """

    def __init__(self, *, is_gone: bool = True) -> None:
        self._is_gone = is_gone

    def kill(self) -> None:
        """Send SIGKILL, if the process still exists."""

    def gone(self) -> bool:
        """Whether it certainly has ended and holds nothing, ports included."""
        return self._is_gone

    def stopped(self) -> bool:
        """Whether it is stopped (SIGSTOP); False if that is not known."""
        return False

    def usage(self) -> Usage:
        """Return its run time and its wait for a processor, as far as they are known."""
        return AT_LEISURE

    def ignore(self) -> None:
        """Do not report its end any more."""

    def close(self) -> None:
        """Release the process. Nothing may be called afterwards."""


class Processes(Protocol):
    """The processes of one run.

    Attributes:
        has_routers: Whether the bus of the run needs routers.
    """

    has_routers: bool

    def living(self) -> Sequence[RunProcess]:
        """Return the processes of the run that exist."""

    def fork(self, names: tuple[str, ...], incarnation: int, answer: Answer) -> None:
        """Start a process for the named actors; `answer` is called once, now or later.

        Raises:
            OSError: The root accepts no request now.
        """

    def hold(self, pid: int, ended: Callable[[], None]) -> ProcessHandle:
        """Take hold of a process; `ended` is called on the event loop when it ends.

        Raises:
            ProcessLookupError: It has ended already.
            OSError: No descriptor is left.
        """

    def adapt(self, adapted: AdaptedSystem) -> None:
        """Use a changed system for all later processes.

        Raises:
            OSError: The folder of the run is full or missing.
        """


class OsHandle(ProcessHandle):
    """A pidfd. It works for any process, not only for children, so a supervisor can adopt it."""

    def __init__(self, pid: int, ended: Callable[[], None]) -> None:
        self._pidfd = os.pidfd_open(pid)
        self._pid = pid
        self._ended = ended
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._pidfd, self._report_end)

    def _report_end(self) -> None:
        self.ignore()
        self._ended()

    def kill(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(self._pidfd, signal.SIGKILL)

    def gone(self) -> bool:
        # Not the state in /proc: it is that of the main thread, which may be a zombie while another
        # thread still holds the ports. A pidfd is readable when the last thread has ended.
        poll = select.poll()  # not select(), which handles only 1024 descriptors
        poll.register(self._pidfd, select.POLLIN)
        return bool(poll.poll(0))

    def stopped(self) -> bool:
        return process_state(self._pid) in "Tt"

    def usage(self) -> Usage:
        return usage(self._pid)

    def ignore(self) -> None:
        self._loop.remove_reader(self._pidfd)

    def close(self) -> None:
        self.ignore()
        os.close(self._pidfd)


class OsProcesses:
    """Processes of this machine, which the root of the run forks. Needs a running event loop.

    Args:
        folder: Of the run.
        port: Base port of the run.
        launcher: Pid of the root.
        root: Descriptor of the connection to the root.
        call_soon: Puts a call into the supervisor's mailbox, under a name.
        manager_works: Whether the FTM Manager works, as far as the supervisor knows.
    """

    has_routers = True

    def __init__(self, folder: str, port: int, launcher: int, root: int,
                 call_soon: Callable[[str, Callable[[], None]], None],
                 *, manager_works: Callable[[], bool]) -> None:
        self.folder = folder
        self._port = port
        self._launcher = launcher
        self._root = socket.socket(fileno=root)
        self._root.setblocking(False)
        self._call_soon = call_soon
        self._manager_works = manager_works
        self._asked: dict[ForkRequest, Answer] = {}
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._root, self._answered)
        self._loop.call_soon(self._show_alive)

    def _show_alive(self) -> None:
        """Show the root that this event loop works, and continue the root if it is stopped."""
        with contextlib.suppress(OSError):
            self._root.send(WELL if self._manager_works() else ALIVE)
        if process_state(self._launcher) == "T":
            kill(self._launcher, signal.SIGCONT)
        self._loop.call_later(ALIVE_S, self._show_alive)

    def fork(self, names: tuple[str, ...], incarnation: int, answer: Answer) -> None:
        """Request a process from the root, which answers each request once."""
        request = ForkRequest(names[0], incarnation)
        self._root.send(msgspec.json.encode(request))
        self._asked[request] = answer

    def _answered(self) -> None:
        try:
            data = self._root.recv(REQUEST_BYTES)
        except OSError:
            data = b""
        if not data:  # the root has ended, and so does the run
            self._loop.remove_reader(self._root)
            return
        reply = msgspec.json.decode(data, type=Reply)
        answer = self._asked.pop(reply.request)
        self._call_soon(f"{reply.request}", lambda: answer(reply.pid, reply.error))

    def adapt(self, adapted: AdaptedSystem) -> None:
        """Write a changed system to the run folder, where the root reads it before a fork."""
        change_system(self.folder, msgspec.json.encode(adapted))

    def living(self) -> list[RunProcess]:
        """Return the processes of this run from /proc."""
        return find_processes(self._port, self._launcher)

    def hold(self, pid: int, ended: Callable[[], None]) -> ProcessHandle:
        """Open a pidfd."""
        return OsHandle(pid, ended)
