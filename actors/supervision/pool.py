"""The pool: warm processes, any of which may become any process of the run.

The root forks them ahead of time, and each opens its session on the bus. That is two thirds of what
a new process takes. In a run with keys the session is the node's, by whose key it is opened; such a
process has Zenoh loaded only.

A process of the pool that is stopped is ended at once. One that hangs does not take its request
within `_TAKE_S`: it is killed, and the next process gets the request when it is gone. So no request
leads to two processes.
"""

from __future__ import annotations

import asyncio
import os
import select
import selectors
import socket
import time
from collections.abc import Awaitable, Callable

from rampart.actors.bus.bus import BusError
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.bus.zenoh_session import endpoints
from rampart.actors.machine.unix_peer import process_state
from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.supervision.process_title import kill
from rampart.actors.supervision.requests import REQUEST_BYTES

_PAUSE_S = 0.25
"""A process is added when for so long no other was started; longer, up to ..."""

_PAUSE_MAX_S = 8.0
"""... this, if the one before ended by itself."""

_TAKE_S, _GONE_S = 0.01, 0.05
"""Within which a process takes a request, and is gone when it was killed."""

_READY, _TAKEN = b"ready", b"taken"


class Pool:
    """The root's side of the pool.

    Args:
        number: Of processes.
        selector: Watches their connections.
        fork: Forks one, given its end of the connection; returns its number.
    """

    def __init__(self, number: int, selector: selectors.BaseSelector,
                 fork: Callable[[socket.socket], int]) -> None:
        self._number = number
        self._selector = selector
        self._fork = fork
        self._waiting: dict[int, socket.socket] = {}
        self._ready: list[int] = []
        self._pause_s = _PAUSE_S
        self._since_s = time.monotonic()

    def take(self, request: bytes, answer: socket.socket) -> int:
        """Give a request to a process of the pool and return its number; 0 if none is ready.

        Raises:
            OSError: one may have the request or not; it is to be made again.
        """
        self._since_s = time.monotonic()
        while self._ready:
            pid = self._ready[0]
            connection = self._waiting[pid]
            try:
                if process_state(pid) not in "TtXZ":
                    socket.send_fds(connection, [request], [answer.fileno()])
                    if _is_readable(connection.fileno(), _TAKE_S) and connection.recv(1):
                        self._forget(pid)
                        return pid
            except OSError:  # it has just ended
                pass
            self.remove(pid)
            if not _has_ended(pid):
                raise TimeoutError("a process of the pool does not end")
        return 0

    def look(self) -> float | None:
        """Add a process if one is missing; return in how many seconds to look again."""
        if len(self._waiting) >= self._number:
            return None
        now_s = time.monotonic()
        wait_s = self._since_s + self._pause_s - now_s
        if wait_s > 0:
            return wait_s
        self._since_s = now_s
        try:
            ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            with theirs:
                pid = self._fork(theirs)
        except OSError:  # no descriptor, process or memory is left: perhaps later
            self._wait_longer()
            return self._pause_s
        self._waiting[pid] = ours
        self._selector.register(ours, selectors.EVENT_READ, lambda: self._read(pid))
        return _PAUSE_S

    def remove(self, pid: int) -> None:
        """End a process of the pool; harmless for any other."""
        if pid in self._waiting:
            self._forget(pid)
            kill(pid)

    def end(self) -> None:
        """End all; others follow."""
        for pid in list(self._waiting):
            self.remove(pid)

    def _read(self, pid: int) -> None:
        connection = self._waiting.get(pid)
        if connection is None:  # removed since the selector saw this
            return
        try:
            said = connection.recv(len(_READY))
        except OSError:
            said = b""
        if said:
            self._ready.append(pid)
            self._pause_s = _PAUSE_S
            return
        self._wait_longer()  # it has ended by itself
        self._forget(pid)

    def _forget(self, pid: int) -> None:
        connection = self._waiting.pop(pid)
        self._selector.unregister(connection)
        connection.close()
        if pid in self._ready:
            self._ready.remove(pid)

    def _wait_longer(self) -> None:
        self._pause_s = min(2 * self._pause_s, _PAUSE_MAX_S)


def _has_ended(pid: int) -> bool:
    """Wait for the end of a process that was killed; False if that takes too long."""
    try:
        ended = os.pidfd_open(pid)
    except ProcessLookupError:
        return True
    try:
        return _is_readable(ended, _GONE_S)
    finally:
        os.close(ended)


def _is_readable(descriptor: int, within_s: float) -> bool:
    poll = select.poll()
    poll.register(descriptor, select.POLLIN)
    return bool(poll.poll(1000 * within_s))


Become = Callable[[bytes, socket.socket, ZenohBus | None], Awaitable[int]]
"""Given a request, the socket for the answer, and the open bus, if there is one: runs that process
and returns its exit code."""


async def wait(control: socket.socket, plan: RunPlan, become: Become) -> int:
    """Be a process of the pool: open a session, take one request, carry it out.

    Args:
        control: Connection to the root; when it ends, so does this.
        plan: Of the run.
        become: Carries the request out.
    """
    try:
        bus = await _session(plan)
    except BusError:  # there is no router
        return 0
    control.setblocking(False)
    loop, readable = asyncio.get_running_loop(), asyncio.Event()
    loop.add_reader(control, readable.set)
    try:
        control.send(_READY)
        await readable.wait()
        request, descriptors, _, _ = socket.recv_fds(control, REQUEST_BYTES, 1)
        if descriptors:
            control.send(_TAKEN)
    except OSError:
        return 0
    finally:
        loop.remove_reader(control)
        control.close()
    if not descriptors:
        return 0
    return await become(request, socket.socket(fileno=descriptors[0]), bus)


async def _session(plan: RunPlan) -> ZenohBus | None:
    """Return an open session; None in a run with keys, where it takes the key of a node to join.

    Raises:
        BusError: there is no router.
    """
    shown = plan.credentials("")
    bus = ZenohBus("", endpoints(plan.folder) if shown is None else [], credentials=shown)
    await bus.open()
    if shown is None:
        return bus
    await bus.close()
    return None


