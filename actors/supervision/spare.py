"""Spares: processes that are forked, connected to the bus, and wait to be told who they are.

A spawner keeps some (`[supervision] spares`), and hands a request to fork over to one instead of
forking: that saves the fork and the opening of the session, two thirds of what a new process takes.
In a run with keys the session is the node's, by whose key it is opened; then it saves the rest.
It is a process like others. One that was killed is seen at once. It is asked each second whether it
turns, so one that is stopped or hangs is found out though nobody needs it; if somebody does before,
it does not take the request within `_TAKE_MS`, and the spawner forks as if there were none. Which
of the two has a request is decided by a pipe with one byte in it: who reads that has it. So no
request leads to two processes, however late a spare wakes up.

The spare that has a request goes on as any new process does (`node_process`), with its session.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import select
import selectors
import socket
import time
from collections.abc import Callable, Coroutine
from functools import partial
from typing import Any, NoReturn

from rampart.actors.bus.bus import BusError
from rampart.actors.bus.run_folder import process_of
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.bus.zenoh_session import endpoints
from rampart.actors.machine.patience import Patience, usage
from rampart.actors.machine.unix_peer import process_state
from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.supervision.process_title import kill
from rampart.actors.supervision.rehearsal import rehearse

_TAKE_MS = 10
"""A spare that could take a request does so in a fraction of a millisecond."""

_PAUSE_S = 0.25
"""A spare is forked when for so long no other process was; longer, up to ..."""

_PAUSE_MAX_S = 8.0
"""... this, if the one before ended by itself."""

_LOOK_S = 1.0
"""Seconds between two looks whether a spare turns."""

_HUNG_S = 0.9
"""A spare that could have answered for so long hangs."""

_READY, _TAKEN, _ASKED = b"r", b"t", b"?"
_REQUEST_BYTES = 160_000

Begin = Callable[[bytes, socket.socket, ZenohBus | None], Coroutine[Any, Any, int]]
"""What a spare does with a request: given it, the connection it came by, and the open bus, if it
has one."""


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
        self._patience = Patience(2 * _LOOK_S)
        self._owes, self._asked_s = False, -math.inf

    def heard(self) -> bool:
        """Read what it said; False if it has ended."""
        try:
            said = self.control.recv(1)
        except OSError:
            said = b""
        self.is_ready = said == _READY
        self._patience.answered()
        self._owes = False
        return self.is_ready

    def is_fit(self) -> bool:
        """Whether it is neither stopped nor gone, as the kernel sees it, and answers; ask it."""
        now_s = time.monotonic()
        if process_state(self.pid) in "TtXZ":
            return False
        if self.is_ready and not self._owes and now_s >= self._asked_s + _LOOK_S:
            self._owes, self._asked_s = True, now_s
            with contextlib.suppress(OSError):  # it has just ended, which is seen at once
                self.control.send(_ASKED)
        return not self._owes or (
            self._patience.look(now_s, self.pid, usage(self.pid)) < _HUNG_S)

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
            said = _READY  # the answer to a question may come first
            while said == _READY and poll.poll(_TAKE_MS):
                said = self.control.recv(1)
            taken = said == _TAKEN or not _read(token)
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


class Spares:
    """The spares of one spawner.

    Args:
        number: of them.
        selector: tells when one says something.
        be_spare: what a child does that is forked to be one, with its end of the connection.
    """

    def __init__(self, number: int, selector: selectors.BaseSelector,
                 be_spare: Callable[[socket.socket], NoReturn]) -> None:
        self._number = number
        self._selector = selector
        self._be_spare = be_spare
        self._there: list[Spare] = []
        self._pause_s = _PAUSE_S
        self._since_s = time.monotonic()

    def wait_a_moment(self) -> None:
        """Fork none while processes are being started."""
        self._since_s = time.monotonic()

    def look_after(self) -> float | None:
        """Fork one if one is missing; return in how many seconds to look again, None for never."""
        if self._number == 0:
            return None
        for spare in [one for one in self._there if not one.is_fit()]:
            self._forget(spare)
            spare.end()
        is_missing = len(self._there) < self._number
        wait_s = self._since_s + self._pause_s - time.monotonic()
        if is_missing and wait_s <= 0:
            self.wait_a_moment()
            self._fork()
        return max(_PAUSE_S, wait_s) if is_missing else _LOOK_S

    def take(self, request: bytes, connection: socket.socket) -> bool:
        """Hand a request over to one with its connection; False if there is none that takes it."""
        self.wait_a_moment()
        while ready := [spare for spare in self._there if spare.is_ready]:
            self._forget(ready[0])
            if ready[0].take(request, connection):
                return True
        return False

    def end(self) -> None:
        """End them; others follow."""
        for spare in self._there:
            self._forget(spare)
            spare.end()

    def _fork(self) -> None:
        try:
            ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        except OSError:  # no descriptor left: perhaps later
            self._wait_longer()
            return
        try:
            pid = os.fork()
        except OSError:  # no process may be added, or there is no memory for one
            ours.close()
            theirs.close()
            self._wait_longer()
            return
        if pid == 0:
            ours.close()
            self._be_spare(theirs)
        theirs.close()
        spare = Spare(pid, ours)
        self._there.append(spare)
        self._selector.register(ours, selectors.EVENT_READ, lambda _: self._hear(spare))

    def _hear(self, spare: Spare) -> None:
        if spare not in self._there:  # it was used or ended since the selector saw this
            return
        if spare.heard():
            self._pause_s = _PAUSE_S
        else:
            self._wait_longer()
            self._forget(spare)
            spare.control.close()

    def _wait_longer(self) -> None:
        self._pause_s = min(2 * self._pause_s, _PAUSE_MAX_S)

    def _forget(self, spare: Spare) -> None:
        self._selector.unregister(spare.control)
        self._there = [one for one in self._there if one is not spare]


async def _next(control: socket.socket, woken: asyncio.Event) -> tuple[bytes, list[int]]:
    while True:
        await woken.wait()
        woken.clear()
        with contextlib.suppress(BlockingIOError):  # it was read already
            return socket.recv_fds(control, _REQUEST_BYTES, 2)[:2]


def _read(token: int) -> bool:
    try:
        return os.read(token, 1) != b""
    except BlockingIOError:
        return False


async def _session(plan: RunPlan) -> ZenohBus | None:
    """Return an open session; None in a run with keys, where it takes the key of a node to join.

    Raises:
        BusError: there is no router.
    """
    shown = plan.credentials("")
    bus = ZenohBus("", 0, endpoints(plan.folder) if shown is None else [], credentials=shown,
                   process_of=partial(process_of, plan.folder))
    await bus.open()
    await rehearse(plan, bus)
    if shown is None:
        return bus
    await bus.close()
    return None


async def wait(control: socket.socket, plan: RunPlan, begin: Begin) -> int:
    """Be a spare: open a session, take one request, run until that is over, return its exit code.

    Args:
        control: connection to the spawner; when it ends, so does this.
        plan: of the run.
        begin: what to do with the request.
    """
    loop = asyncio.get_running_loop()
    try:
        bus = await _session(plan)
    except BusError:  # without routers nobody needs it
        return 0
    control.setblocking(False)
    woken = asyncio.Event()
    loop.add_reader(control, woken.set)
    request, descriptors = _ASKED, list[int]()
    try:
        while request == _ASKED:
            control.send(_READY)
            request, descriptors = await _next(control, woken)
        loop.remove_reader(control)
        if not request or len(descriptors) < 2 or not _read(descriptors[1]):
            return 0
        control.send(_TAKEN)
    except OSError:  # the spawner has ended
        return 0
    os.close(descriptors[1])
    control.close()
    return await begin(request, socket.socket(fileno=descriptors[0]), bus)
