"""Spares: processes that are forked, connected to the bus, and wait to be told who they are.

A spawner keeps some (`[supervision] spares`), and hands a request to fork over to one instead of
forking: that saves the fork and the opening of the session, two thirds of what a new process takes.
It is a process like others. One that was killed is seen at once; one that is stopped or hangs does
not take the request within `_TAKE_MS`, is ended, and the spawner forks as if there were none. Which
of the two has a request is decided by a pipe with one byte in it: who reads that has it. So no
request leads to two processes, however late a spare wakes up.

The spare that has a request goes on as any new process does (`node_process`), with its session.
"""

from __future__ import annotations

import asyncio
import os
import select
import socket
from collections.abc import Callable, Coroutine
from typing import Any

from rampart.actors.bus.bus import BusError
from rampart.actors.bus.unix_peer import process_state
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.bus.zenoh_session import endpoints
from rampart.actors.supervision.process_title import kill

_TAKE_MS = 10
"""A spare that could take a request does so in a fraction of a millisecond."""

_READY, _TAKEN = b"r", b"t"
_REQUEST_BYTES = 160_000

Begin = Callable[[bytes, socket.socket, ZenohBus], Coroutine[Any, Any, int]]
"""What a spare does with a request: given it, the connection it came by, and the open bus."""


class Spare:
    """A spare, as the spawner that forked it holds it.

    Args:
        pid: of it.
        control: connection to it.
    """

    def __init__(self, pid: int, control: socket.socket) -> None:
        self.pid = pid
        self.control = control
        self.is_ready = False

    def heard(self) -> bool:
        """Read what it said; False if it has ended."""
        try:
            said = self.control.recv(1)
        except OSError:
            said = b""
        self.is_ready = said == _READY
        return self.is_ready

    def is_fit(self) -> bool:
        """Whether it is neither stopped nor gone, as the kernel sees it."""
        return process_state(self.pid) not in "TtXZ"

    def take(self, request: bytes, connection: socket.socket) -> bool:
        """Hand a request over with its connection; False if it did not take it, and is ended."""
        token, put = os.pipe()
        os.set_blocking(token, False)
        os.write(put, b"x")
        os.close(put)
        try:
            socket.send_fds(self.control, [request], [connection.fileno(), token])
            poll = select.poll()
            poll.register(self.control, select.POLLIN)
            taken = bool(poll.poll(_TAKE_MS)) and self.control.recv(1) == _TAKEN
            taken = taken or not _read(token)
        except OSError:  # it has just ended
            taken = not _read(token)
        finally:
            os.close(token)
            self.control.close()
        if not taken:
            kill(self.pid)
        return taken

    def end(self) -> None:
        """End it."""
        self.control.close()
        kill(self.pid)


def _read(token: int) -> bool:
    try:
        return os.read(token, 1) != b""
    except BlockingIOError:
        return False


async def wait(control: socket.socket, folder: str, begin: Begin) -> int:
    """Be a spare: open a session, take one request, run until that is over, return its exit code.

    Args:
        control: connection to the spawner; when it ends, so does this.
        folder: of the run.
        begin: what to do with the request.
    """
    loop = asyncio.get_running_loop()
    bus = ZenohBus("", 0, endpoints(folder))
    try:
        await bus.open()
    except BusError:  # without routers nobody needs it
        return 0
    control.setblocking(False)
    control.send(_READY)
    woken = asyncio.Event()
    loop.add_reader(control, woken.set)
    await woken.wait()
    loop.remove_reader(control)
    try:
        request, descriptors, _flags, _address = socket.recv_fds(control, _REQUEST_BYTES, 2)
        if not request or len(descriptors) < 2 or not _read(descriptors[1]):
            return 0
        control.send(_TAKEN)
    except OSError:  # the spawner has ended
        return 0
    os.close(descriptors[1])
    control.close()
    return await begin(request, socket.socket(fileno=descriptors[0]), bus)
