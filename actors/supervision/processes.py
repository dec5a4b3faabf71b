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
import socket
import time
from collections.abc import Callable, Sequence
from typing import Protocol

import msgspec

from rampart.actors.bus.run_folder import change_system
from rampart.actors.ftm.messages import AdaptedSystem
from rampart.actors.machine.patience import AT_LEISURE, Usage, usage
from rampart.actors.machine.unix_peer import process_state
from rampart.actors.supervision.process_title import RunProcess, find_processes, kill
from rampart.actors.supervision.requests import REQUEST_BYTES, WORD, ForkRequest, Reply

__all__ = ["OsProcesses", "ProcessHandle", "Processes", "RunProcess"]

WORD_S = 0.25
"""Wall seconds between two words to the root, and between two looks whether that is stopped."""

Answer = Callable[[int, str], None]
"""Called with the pid of a new process, or with 0 and why there is none, in one line."""


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

    def fork(self, names: tuple[str, ...], incarnation: int, answer: Answer) -> None:
        """Start a process for the named actors; `answer` is called once, now or later.

        Raises:
            OSError: No request can be made now.
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
        """End the processes held: asked to, in the sequence given, and killed if they linger."""

    def close(self) -> None:
        """Let go of everything."""


class OsHandle(ProcessHandle):
    """A pidfd: of any process, not of children only, so it can be adopted."""

    def __init__(self, pid: int, ended: Callable[[], None]) -> None:
        self.pidfd = os.pidfd_open(pid)
        self._pid = pid
        self._ended = ended
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self.pidfd, self._told)

    def _told(self) -> None:
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
        if self.pidfd >= 0:
            self._loop.remove_reader(self.pidfd)

    def close(self) -> None:
        if self.pidfd >= 0:
            self.ignore()
            os.close(self.pidfd)
            self.pidfd = -1


class OsProcesses:
    """Processes of this machine, which the root of the run forks. To be made on a running loop.

    Args:
        folder: Of the run.
        port: Base port of the run.
        launcher: Process id of the root.
        root: Descriptor of the connection to it.
        call_soon: Has the supervisor do something, which it is told in words, after what it does.
    """

    has_routers = True

    def __init__(self, folder: str, port: int, launcher: int, root: int,
                 call_soon: Callable[[str, Callable[[], None]], None]) -> None:
        self.folder = folder
        self._port = port
        self._launcher = launcher
        self._root = socket.socket(fileno=root)
        self._root.setblocking(False)
        self._call_soon = call_soon
        self._asked: dict[ForkRequest, Answer] = {}
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._root, self._answered)
        self._word()

    def _word(self) -> None:
        """Show the root that this loop turns, and continue it if it was stopped."""
        with contextlib.suppress(OSError):
            self._root.send(WORD)
        if process_state(self._launcher) == "T":
            kill(self._launcher, signal.SIGCONT)
        self._next_word = self._loop.call_later(WORD_S, self._word)

    def fork(self, names: tuple[str, ...], incarnation: int, answer: Answer) -> None:
        """Ask the root for a process, as `Processes`. The root answers each request once."""
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
        """Have every process that is forked from now on know a changed system.

        Raises:
            OSError: the folder of the run is full, or gone.
        """
        change_system(self.folder, msgspec.json.encode(adapted))

    def living(self) -> list[RunProcess]:
        """Return the processes of this run, found in /proc."""
        return find_processes(self._port, self._launcher)

    def hold(self, pid: int, ended: Callable[[], None]) -> ProcessHandle:
        """Open a pidfd; raises ProcessLookupError if there is no such process."""
        return OsHandle(pid, ended)

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
        self._next_word.cancel()
        self._loop.remove_reader(self._root)
        self._root.close()
