"""Takes the messages that the processes of a run hand over (`recorder_connection`).

It runs in a separate process, not a node, and not on the bus, so no node ever waits for it. It
empties all sockets periodically, and ends on a signal, or when the launcher of the run has ended in
whatever way. Then it takes what is still in the sockets.
"""

from __future__ import annotations

import math
import os
import select
import selectors
import signal
import socket
import time
from pathlib import Path
from typing import ClassVar, Protocol

from rampart.actors.bus import recorder_connection
from rampart.actors.bus.run_info import RunInfo, ask
from rampart.actors.machine.unix_peer import is_same_user
from rampart.actors.recording.bag_writer import BagError

PERIOD_S = 0.05
"""Real seconds between two looks into the sockets."""

FLUSH_S = 0.8
"""Real seconds between two flushes; a crash loses so much at most."""

LAST_S = 2.0
"""Real seconds for which sockets are read after the end of the launcher, until the nodes end."""

RUN_ENDED = signal.SIGUSR1
"""Signal of the launcher to its recorder when all nodes have ended."""

_RUN_ENDED = "the run has ended"
_ASK_S = 0.2
_WAITING_FRAMES = 500_000


class RunWriter(Protocol):
    """Writes what the processes of a run hand over."""

    @property
    def messages(self) -> int:
        """Number of messages so far."""

    def write(self, frames: list[bytes], turn_s: float) -> None:
        """Write what was handed over.

        Args:
            frames: see `recorder_connection`.
            turn_s: monotonic seconds before they were taken; infinity for the last time.
        """

    def flush(self) -> None:
        """Hand everything to the kernel or the disk."""

    def end(self, why: str, *, is_cut_off: bool) -> None:
        """Write the end, for a reason; `is_cut_off` if the launcher has died without a signal."""

    def abandon(self) -> None:
        """Close all files as they are. Harmless when repeated."""


class RunListener:
    """Base class of recorders. Call `open`, then `run`, once.

    Class attributes:
        which: its name in `recorder_connection.RECORDERS`.
        period_s: real seconds between two looks into the sockets.
        flush_s: real seconds between two flushes; a crash loses so much at most.

    Args:
        port: base port of the run.
        path: where it writes.
        launcher: pid of the launcher of a run that is about to start; None joins a running one.

    Attributes:
        writer: of the run; None before it answers.
    """

    which: ClassVar[str]
    period_s: ClassVar[float] = PERIOD_S
    flush_s: ClassVar[float] = FLUSH_S

    def __init__(self, port: int, path: Path, launcher: int | None) -> None:
        self.path = path
        self._port = port
        self._launcher = launcher
        self._listener: socket.socket | None = None
        self._sockets = selectors.DefaultSelector()
        self._buffer = bytearray(recorder_connection.MAX_FRAME_BYTES)
        self.writer: RunWriter | None = None
        self._wait_s = PERIOD_S
        self._frames: list[bytes] = []
        self._next_ask_s = 0.0
        self._next_flush_s = 0.0

    def begin(self, info: RunInfo, frames: list[bytes]) -> RunWriter:
        """Return the writer as soon as the run answers.

        Args:
            info: of the run.
            frames: received so far; the writer gets them next.
        """
        raise NotImplementedError

    def open(self) -> None:
        """Bind the socket where nodes look for a recorder.

        Raises:
            BagError: the run is being recorded already.
        """
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        try:
            listener.bind(recorder_connection.address(self._port, self.which))
        except OSError:
            listener.close()
            raise BagError(f"the run on port {self._port} is being recorded already") from None
        listener.listen(256)
        self._listener = listener

    def run(self, stop: int, duration_s: float | None = None) -> str:
        """Record until `stop` can be read, or the run or the duration is over; return the reason.

        Args:
            stop: file descriptor; its byte is the number of a signal, `RUN_ENDED` or another.
            duration_s: real seconds.

        Raises:
            BagError: the file cannot be written; its content so far stays.
        """
        poller = select.poll()
        poller.register(stop, select.POLLIN)
        pidfd = -1
        begun_s = time.monotonic()
        why, over = "", False
        try:
            while not why:
                if pidfd < 0 and self._launcher is not None:
                    try:
                        pidfd = os.pidfd_open(self._launcher)
                    except OSError:
                        why, over = _RUN_ENDED, True
                        break
                    poller.register(pidfd, select.POLLIN)
                ready = {fd for fd, _ in poller.poll(1000 * self._wait_s)}
                if pidfd in ready:
                    why, over = _RUN_ENDED, True
                elif stop in ready:
                    why = _RUN_ENDED if RUN_ENDED in os.read(stop, 64) else "it was told to"
                elif duration_s is not None and time.monotonic() - begun_s >= duration_s:
                    why = f"its {duration_s:g} s are over"
                self._turn()
            self._finish(why, run_is_over=over)
        except OSError as error:
            count = self.writer.messages if self.writer else 0
            raise BagError(f"{self.path}: {error.strerror or error}: the recording ends after "
                           f"{count} messages, the robot goes on") from None
        finally:
            if pidfd >= 0:
                os.close(pidfd)
            self.close()
        return why

    def close(self) -> None:
        """Close all sockets, and the files as they are."""
        if self._listener is not None:
            self._listener.close()
            self._listener = None
        for key in list(self._sockets.get_map().values()):
            self._drop(key.fileobj)  # type: ignore[arg-type]
        self._sockets.close()
        if self.writer is not None:
            self.writer.abandon()

    # -- one turn -------------------------------------------------------------------------------

    def _turn(self, *, is_last: bool = False) -> None:
        turn_s = time.monotonic()
        self._gather()
        if self.writer is None and turn_s >= self._next_ask_s:
            self._next_ask_s = turn_s + _ASK_S
            info = ask(self._port)
            if info is not None and self._launcher in {None, info.pid}:
                self.writer, self._launcher = self.begin(info, self._frames), info.pid
                self._wait_s = min(self.period_s, 0.4 / info.rate)  # sockets fill sooner then
        if self.writer is None:
            return
        frames, self._frames = self._frames, []
        self.writer.write(frames, math.inf if is_last else turn_s)
        if turn_s >= self._next_flush_s:
            self._next_flush_s = turn_s + self.flush_s
            self.writer.flush()

    def _finish(self, why: str, *, run_is_over: bool) -> None:
        deadline = time.monotonic() + LAST_S
        while run_is_over and self._sockets.get_map() and time.monotonic() < deadline:
            time.sleep(self._wait_s)
            self._turn()
        self._turn(is_last=True)
        if self.writer is not None:
            self.writer.end(why, is_cut_off=run_is_over)

    def _gather(self) -> None:
        """Take the frames that were handed over since the last call."""
        self._accept()
        frames, view = self._frames, memoryview(self._buffer)
        for key, _ in self._sockets.select(0):
            connection: socket.socket = key.fileobj  # type: ignore[assignment]
            try:
                while (size := connection.recv_into(self._buffer)) > 0:
                    frames.append(bytes(view[:size]))
            except BlockingIOError:
                continue
            except OSError:
                pass
            self._drop(connection)
        del frames[_WAITING_FRAMES:]  # the run does not answer yet

    def _accept(self) -> None:
        while self._listener is not None:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                return
            connection.setblocking(False)
            if is_same_user(connection):
                self._sockets.register(connection, selectors.EVENT_READ)
            else:
                connection.close()

    def _drop(self, connection: socket.socket) -> None:
        self._sockets.unregister(connection)
        connection.close()
