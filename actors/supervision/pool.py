"""The pool: processes that are ready, any of which can become any process of the run.

The root forks them in advance, and each opens its session on the bus, which takes two thirds of the
time of a start. With credentials a session belongs to one node, so a process of the pool has only
loaded Zenoh. The root kills a process of the pool that is stopped.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import time
from collections.abc import Callable

from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.bus.zenoh_session import endpoints
from rampart.actors.machine.unix_peer import process_state
from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.supervision.process_title import kill
from rampart.actors.supervision.requests import REQUEST_BYTES

_PAUSE_S = 0.25
"""The pool adds a process when no other process has started for this long."""


class Pool:
    """The root's side of the pool.

    Args:
        number: Of processes.
        fork: Forks a process, which gets the connection; returns its pid.

    Attributes:
        waiting: Connections to its processes by pid, the oldest first.
    """

    def __init__(self, number: int, fork: Callable[[socket.socket], int]) -> None:
        self.waiting: dict[int, socket.socket] = {}
        self._number = number
        self._fork = fork
        self._since_s = time.monotonic()

    def take(self, request: bytes) -> tuple[int, socket.socket] | None:
        """Give a request to a process of the pool; return its pid and the connection, if any."""
        self._since_s = time.monotonic()
        for pid, connection in list(self.waiting.items()):
            if process_state(pid) in "TtXZ":  # a SIGCHLD to the root is on its way
                continue
            with contextlib.suppress(OSError):  # it has just ended
                connection.send(request)
                return pid, self.waiting.pop(pid)
        return None

    def fill(self) -> None:
        """Add a process if one is missing."""
        now_s = time.monotonic()
        if len(self.waiting) >= self._number or now_s < self._since_s + _PAUSE_S:
            return
        self._since_s = now_s
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            try:
                self.waiting[self._fork(theirs)] = ours
            except OSError:  # no process or memory is left; tried again later
                ours.close()

    def forget(self, pid: int) -> bool:
        """Remove a process; False if it is not in the pool."""
        connection = self.waiting.pop(pid, None)
        if connection is not None:
            connection.close()
        return connection is not None

    def end(self) -> None:
        """Kill all; `fill` replaces them."""
        for pid in list(self.waiting):
            self.forget(pid)
            kill(pid)


async def wait(control: socket.socket, plan: RunPlan) -> tuple[bytes, ZenohBus | None]:
    """Open a session and wait for a request, in a process of the pool.

    Args:
        control: Connection to the root.
        plan: Of the run.

    Returns:
        The request, b"" if the root has ended; and the bus, None in a run with credentials, where
        the process joins with those of its node.

    Raises:
        BusError: No router runs.
    """
    shown = plan.credentials("")
    bus = ZenohBus("", endpoints(plan.folder) if shown is None else [], credentials=shown)
    await bus.open()
    if shown is not None:
        await bus.close()
    control.setblocking(False)
    request = await asyncio.get_running_loop().sock_recv(control, REQUEST_BYTES)
    return request, bus if shown is None else None
