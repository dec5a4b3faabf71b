"""The pool: warm processes, any of which may become any process of the run.

The root forks them ahead of time, and each opens its session on the bus. That is two thirds of what
a new process takes. In a run with keys the session is the node's, by whose key it is opened; such a
process has Zenoh loaded only.

A process of the pool that is stopped is ended at once.
"""

from __future__ import annotations

import asyncio
import selectors
import socket
import time
from collections.abc import Awaitable, Callable

from rampart.actors.bus.bus import BusError
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.bus.zenoh_session import endpoints
from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.supervision.process_title import kill
from rampart.actors.supervision.requests import REQUEST_BYTES

_PAUSE_S = 0.25
"""A process is added when for so long no other was started; longer, up to ..."""

_PAUSE_MAX_S = 8.0
"""... this, if the one before ended by itself."""

_READY = b"ready"


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

    def take(self, request: bytes) -> int:
        """Give a request to a process of the pool and return its number; 0 if none is ready."""
        self._since_s = time.monotonic()
        while self._ready:
            pid = self._ready[0]
            try:
                self._waiting[pid].send(request)
            except OSError:  # it has just ended
                self.remove(pid)
            else:
                self._forget(pid)
                return pid
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


Become = Callable[[bytes, ZenohBus | None], Awaitable[int]]
"""Given a request, and the open bus, if there is one: runs that process; returns its exit code."""


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
        request = control.recv(REQUEST_BYTES)
    except OSError:
        return 0
    finally:
        loop.remove_reader(control)
        control.close()
    return await become(request, bus) if request else 0


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


