"""The pool: warm processes, any of which may become any process of the run.

The root forks them ahead of time, and each opens its session on the bus. That is two thirds of what
a new process takes. In a run with keys the session is the node's, by whose key it is opened; such a
process has Zenoh loaded only. A process of the pool that is stopped is ended at once.
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
"""A process is added when for so long no other was started."""


class Pool:
    """The root's side of the pool.

    Args:
        number: Of processes.
        fork: Forks one, given its end of the connection; returns its number.

    Attributes:
        waiting: Connections to its processes by their numbers, the oldest first.
    """

    def __init__(self, number: int, fork: Callable[[socket.socket], int]) -> None:
        self.waiting: dict[int, socket.socket] = {}
        self._number = number
        self._fork = fork
        self._since_s = time.monotonic()

    def take(self, request: bytes) -> int:
        """Give a request to a process of the pool and return its number; 0 if there is none."""
        self._since_s = time.monotonic()
        for pid, connection in list(self.waiting.items()):
            if process_state(pid) in "TtXZ":  # the root is about to be told so
                continue
            with contextlib.suppress(OSError):  # it has just ended
                connection.send(request)
                self.forget(pid)
                return pid
        return 0

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
            except OSError:  # no process or memory is left: perhaps later
                ours.close()

    def forget(self, pid: int) -> bool:
        """Let go of a process; False if it is none of the pool."""
        connection = self.waiting.pop(pid, None)
        if connection is not None:
            connection.close()
        return connection is not None

    def end(self) -> None:
        """End all; others follow."""
        for pid in list(self.waiting):
            self.forget(pid)
            kill(pid)


async def wait(control: socket.socket, plan: RunPlan) -> tuple[bytes, ZenohBus | None]:
    """Be a process of the pool: open a session and wait for a request.

    Args:
        control: Connection to the root.
        plan: Of the run.

    Returns:
        The request, b"" if the root has ended; and the bus, None in a run with keys, where the
        process joins by the key of its node.

    Raises:
        BusError: there is no router.
    """
    shown = plan.credentials("")
    bus = ZenohBus("", endpoints(plan.folder) if shown is None else [], credentials=shown)
    await bus.open()
    if shown is not None:
        await bus.close()
    with control:
        control.setblocking(False)
        request = await asyncio.get_running_loop().sock_recv(control, REQUEST_BYTES)
    return request, bus if shown is None else None
