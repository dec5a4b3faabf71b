"""The connection of the process `run` to the root, by which it loads, starts and ends the run.

`run` is a child of the root and inherits the connection.
"""

from __future__ import annotations

import asyncio
import os
import select
import socket
import threading
import time
from collections.abc import Callable
from typing import TypeVar

import msgspec

from rampart.actors.bus.recorder_connection import RecorderConnection
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.bus.zenoh_session import endpoints
from rampart.actors.runtime.run_plan import OBSERVER, RunPlan, on_host
from rampart.actors.supervision import requests
from rampart.actors.supervision.process_title import RUN, end_run, kill, set_title
from rampart.actors.supervision.requests import LaunchError
from rampart.actors.supervision.unseen import report_callbacks, watch
from rampart.files.streams import complain

STARTUP_S = (0.4, 5.0)
"""Least and most wall seconds from the start of the processes to simulated time 0. Until then,
silence is not a fault."""

_LOADS = 1.9
"""The same, in multiples of the time to load the root; all processes run after 0.8 to 1.3."""

_LATE_S = 0.5
"""Simulated seconds after time 0 in which a process may still start: silence from the beginning
has `startup_grace_s`, and the first mission waits for all nodes."""

_MAX_LINE = 1 << 26
_Answer = TypeVar("_Answer", bound=requests.FromRoot)


class Launcher:
    """The client of one run's root.

    Use on a running event loop: `load`, `start`, `end`.

    Args:
        plan: Of the run.
        title: Of the run, for people.
        link: Connection to the root.

    Attributes:
        plan: Of the run; from `load` on with folder, ports and the root's pid.
        names: Of the actors, from `load` on.
        failure: Why the run has to end, "" while it can continue.
        recording: Returns the file of the recording, and why nothing more is written to it.
        on_restart: Called with the name of a process that the root has restarted.
        on_interrupt: Called with the name of the signal by which the user ends the run.
        report: Called with one line about each problem.
    """

    def __init__(self, plan: RunPlan, title: str, link: socket.socket) -> None:
        self.plan = plan
        self.names: tuple[str, ...] = ()
        self.failure = ""
        self.recording: Callable[[], tuple[str, str]] = lambda: ("", "")
        self.on_restart: Callable[[str], None] = lambda _name: None
        self.on_interrupt: Callable[[str], None] = lambda _signal: None
        self.report: Callable[[str], None] = complain
        self._title = title
        self._link = link
        self._writer: asyncio.StreamWriter | None = None
        self._reading: asyncio.Task[None] | None = None
        self._answers: asyncio.Queue[requests.FromRoot | None] = asyncio.Queue()
        self._recorded = ("", "")
        self._load_s = 0.0

    async def connect(self) -> None:
        """Connect to the root, which forwards the user's interrupts; `load` does it as well."""
        if self._writer is not None:
            return
        report_callbacks(asyncio.get_running_loop(), lambda line: self.report(line))  # noqa: PLW0108 it may change
        reader, self._writer = await asyncio.open_unix_connection(
            sock=self._link, limit=_MAX_LINE)
        self._reading = asyncio.create_task(self._read(reader))
        watch(self._reading, "the connection to the root", self.failed)

    async def load(self) -> None:
        """Have the root reserve the resources of the run and load its system.

        Raises:
            LaunchError: Spec, airport or mission is unsound; another run has the base port; there
                is no place for the run's sockets, or a limit of open files or processes is too low.
        """
        await self.connect()
        begun = await self._ask(requests.Begin(self.plan, self._title), requests.Begun)
        self.plan, self.names, self._load_s = begun.plan, begun.names, begun.load_s
        if self.plan.launcher_pid == os.getppid():
            set_title(self.plan.base_port, self.plan.launcher_pid, (RUN,), 1)
            _clean_up_after(self.plan.launcher_pid, self.plan.folder)

    async def start(self) -> None:
        """Set simulated time 0 and start routers and supervisor, which starts the rest.

        Raises:
            LaunchError: No process can be started.
        """
        self.plan = msgspec.structs.replace(self.plan, origin_s=self.origin_s())
        await self._ask(requests.Start(self.plan.origin_s), requests.Done)

    def origin_s(self) -> float:
        """Return the reading of the monotonic clock at simulated time 0, if loading ends now."""
        startup_s = STARTUP_S[1] if self.plan.part else min(
            max(STARTUP_S[0], _LOADS * self._load_s - _LATE_S / self.plan.rate), STARTUP_S[1])
        return time.monotonic() + startup_s - self.plan.begins_s / self.plan.rate

    def failed(self, why: str) -> None:
        """Note that the run has to end because a part of this process has failed."""
        self.failure = self.failure or why

    def look_at_recording(self) -> tuple[str, str]:
        """Return file and problem of the recording, and pass them to the root for tools."""
        recorded = self.recording()
        if recorded != self._recorded:
            self._recorded = recorded
            self._send(requests.Recording(*recorded))
        return recorded

    def observers_bus(self) -> ZenohBus:
        """Return the bus of an observer in this process; it is not open yet."""
        name = on_host(OBSERVER, self.plan.host)
        return ZenohBus(name, endpoints(self.plan.folder),
                        recorder=RecorderConnection(self.plan.base_port),
                        credentials=self.plan.credentials(name))

    async def end(self) -> None:
        """Have the root end all processes of the run."""
        writer, self._writer = self._writer, None
        if writer is None or self._reading is None:
            return
        try:
            writer.write(msgspec.json.encode(requests.End()) + b"\n")
            while not isinstance(await self._answers.get(), requests.Done | None):
                pass
        finally:
            self._reading.cancel()
            await asyncio.gather(self._reading, return_exceptions=True)
            writer.close()

    # -- inside ---------------------------------------------------------------------------------

    async def _read(self, reader: asyncio.StreamReader) -> None:
        while line := await reader.readline():
            message = msgspec.json.decode(line, type=requests.FromRoot)
            match message:
                case requests.Restarted():
                    self.on_restart(message.name)
                case requests.Trouble():
                    self.report(message.text)
                case requests.Interrupt():
                    self.on_interrupt(message.signal)
                case _:
                    self._answers.put_nowait(message)
        self.failed("the root of the run has ended; --resume continues a mission")
        self._answers.put_nowait(None)

    def _send(self, request: requests.FromRun) -> None:
        if self._writer is not None:
            self._writer.write(msgspec.json.encode(request) + b"\n")

    async def _ask(self, request: requests.FromRun, kind: type[_Answer]) -> _Answer:
        """Send a request and return the answer.

        Raises:
            LaunchError: The root has refused it, or has ended.
        """
        self._send(request)
        answer = await self._answers.get()
        if isinstance(answer, requests.Refused):
            raise LaunchError(answer.why)
        if not isinstance(answer, kind):
            raise LaunchError("the root of the run has ended")
        return answer


def _clean_up_after(root: int, folder: str) -> None:
    """Start a thread that ends this process, and all of the run, when the root has ended.

    The kernel kills the root's other children. Processes that commands have forked, and the folder
    of the run, are left to this thread.

    Raises:
        LaunchError: No thread can be started.
    """
    ended = os.pidfd_open(root)

    def wait() -> None:
        poll = select.poll()
        poll.register(ended, select.POLLIN)
        poll.poll()
        end_run(root, folder)
        kill(os.getpid())

    try:
        threading.Thread(target=wait, name="root", daemon=True).start()
    except RuntimeError as error:
        raise LaunchError(f"no process can be started: {error}") from None
