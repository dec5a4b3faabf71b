"""The recorder: writes the messages that nodes hand over.

It is a separate process, not a node, and not on the bus, so no node ever waits for it. Some twenty
times a second it empties all sockets, sorts the messages by time of sending, and writes them. Every
0.8 s it hands the file to the kernel. It ends on a signal, or when the launcher of the run has
ended in whatever way. Then it takes what is still in the sockets, and closes the file.

In a run on several hosts it also subscribes to the messages of other hosts (`other_hosts`). It then
writes one turn later, when all earlier messages of this machine have been handed over.
"""

from __future__ import annotations

import contextlib
import datetime
import math
import os
import select
import selectors
import signal
import socket
import time
from collections.abc import Callable
from operator import itemgetter
from pathlib import Path
from typing import ClassVar

from rampart.actors.bus import recorder_connection
from rampart.actors.bus.run_info import RunInfo, ask
from rampart.actors.bus.zenoh_session import Credentials
from rampart.actors.machine.unix_peer import is_same_user
from rampart.actors.recording.bag_writer import BagError, BagWriter, open_target
from rampart.actors.recording.other_hosts import (
    BusListener,
    EachOnce,
    Frame,
    OtherHosts,
    Silences,
)
from rampart.actors.recording.run_documents import collect

PERIOD_S = 0.05
"""Real seconds between two looks into the sockets."""

FLUSH_S = 0.8
"""Real seconds between two flushes; a crash loses so much at most."""

LAST_S = 2.0
"""Real seconds for which sockets are read after the end of the launcher, until the nodes end."""

FILE_BYTES = 1 << 30
"""Size at which a recording goes on in another file: three to four hours of a robot."""

RUN_ENDED = signal.SIGUSR1
"""Signal of the launcher to its recorder when all nodes have ended."""

_RUN_ENDED = "the run has ended"
_ASK_S = 0.2
_WAITING_FRAMES = 500_000


class Recorder:
    """One recording of one run. Call `open`, then `run`, once.

    Class attributes:
        which: its name in `recorder_connection.RECORDERS`.
        period_s: real seconds between two looks into the sockets.
        flush_s: real seconds between two flushes; a crash loses so much at most.

    Args:
        port: base port of the run.
        path: path of the file.
        overwrite: whether the file may exist.
        wants: returns whether a full key is recorded.
        launcher: pid of the launcher of a run that is about to start; None joins a running one.
        others: the other hosts; None in a run on one.
        credentials: returns the recorder's credentials on the bus of a run, for other hosts.
    """

    which: ClassVar[str] = "recorder"
    period_s: ClassVar[float] = PERIOD_S
    flush_s: ClassVar[float] = FLUSH_S

    def __init__(self, port: int, path: Path, *, overwrite: bool = False,
                 wants: Callable[[str], bool] = lambda _key: True,
                 launcher: int | None = None, others: OtherHosts | None = None,
                 credentials: Callable[[RunInfo], Credentials | None] = lambda _run: None
                 ) -> None:
        self.path = path
        self.writer: BagWriter | None = None
        self.earlier: list[BagWriter] = []
        self._port = port
        self._overwrite = overwrite
        self._wants = wants
        self._launcher = launcher
        self._from_start = launcher is not None
        self._listener: socket.socket | None = None
        self._sockets = selectors.DefaultSelector()
        self._buffer = bytearray(recorder_connection.MAX_FRAME_BYTES)
        self._info: RunInfo | None = None
        self._waiting: list[Frame] = []
        self._others = others
        self._credentials = credentials
        self._elsewhere: _Elsewhere | None = None
        self._next_ask_s = 0.0
        self._next_flush_s = 0.0

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
                ready = {fd for fd, _ in poller.poll(1000 * self._period_s())}
                if pidfd in ready:
                    why, over = _RUN_ENDED, True
                elif stop in ready:
                    why = _RUN_ENDED if RUN_ENDED in os.read(stop, 64) else "it was told to"
                elif duration_s is not None and time.monotonic() - begun_s >= duration_s:
                    why = f"its {duration_s:g} s are over"
                self._turn()
            self._finish(why, run_is_over=over)
        except OSError as error:
            written = sum(file.messages for file in self.files)
            raise BagError(f"{self.path}: {error.strerror or error}: the recording ends after "
                           f"{written} messages, the robot goes on") from None
        finally:
            if pidfd >= 0:
                os.close(pidfd)
            self.close()
        return why

    @property
    def files(self) -> list[BagWriter]:
        """Writers of all files so far."""
        return [*self.earlier, *([self.writer] if self.writer else [])]

    def close(self) -> None:
        """Close all sockets, and the file as it is."""
        if self._listener is not None:
            self._listener.close()
            self._listener = None
        for key in list(self._sockets.get_map().values()):
            self._drop(key.fileobj)  # type: ignore[arg-type]
        self._sockets.close()
        if self._elsewhere is not None:
            self._elsewhere.close()
        if self.writer is not None:
            self.writer.abandon()

    # -- one turn -------------------------------------------------------------------------------

    def _turn(self, *, is_last: bool = False) -> None:
        turn_s = time.monotonic()
        frames = self._gather()
        if self.writer is None:
            self._waiting += frames[:max(0, _WAITING_FRAMES - len(self._waiting))]
            self._find_run()
            frames = self._waiting
        writer, info = self.writer, self._info
        if writer is None or info is None:  # the run does not answer yet
            return
        self._waiting = []
        if self._elsewhere is not None:
            frames = self._elsewhere.joined(frames, math.inf if is_last else turn_s)
        for at_s, key, payload in sorted(frames, key=itemgetter(0)):
            writer.take((at_s - info.origin_s) * info.rate, key, payload)
        if self._elsewhere is not None:
            writer.write_silences(self._elsewhere.silences.record(
                lambda at_s: (at_s - info.origin_s) * info.rate))
        now_s = time.monotonic()
        if now_s >= self._next_flush_s:
            self._next_flush_s = now_s + self.flush_s
            writer.flush()
            if writer.written_bytes > FILE_BYTES:
                self._begin_file(info, now_s)

    def _finish(self, why: str, *, run_is_over: bool) -> None:
        deadline = time.monotonic() + LAST_S
        while run_is_over and self._sockets.get_map() and time.monotonic() < deadline:
            time.sleep(self._period_s())
            self._turn()
        self._turn(is_last=True)
        if self.writer is not None:
            self.writer.close({"ended": why, "stopped": _wall()})

    def _period_s(self) -> float:
        """Return the time to sleep; at a high rate sockets fill sooner."""
        return min(self.period_s, 0.4 / self._info.rate) if self._info else PERIOD_S

    # -- the run --------------------------------------------------------------------------------

    def _find_run(self) -> None:
        """Begin the file as soon as the run answers."""
        now_s = time.monotonic()
        if now_s < self._next_ask_s:
            return
        self._next_ask_s = now_s + _ASK_S
        info = ask(self._port)
        if info is None or self._launcher not in {None, info.pid}:
            return
        self._info, self._launcher = info, info.pid
        begun_s = min((f[0] for f in self._waiting), default=now_s)
        self._begin_file(info, begun_s)
        if self._others is not None:
            self._elsewhere = _Elsewhere(
                self._others,
                BusListener(self._others, info.endpoints, self._credentials(info)), begun_s)

    def _begin_file(self, info: RunInfo, begun_s: float) -> None:
        """Begin the first file, or the next one with a number in its name."""
        path = self.path
        if self.writer is not None:
            path = path.with_stem(f"{path.stem}-{len(self.files) + 1}")
            self.writer.close({"ended": f"it goes on in {path.name}", "stopped": _wall()})
            self.earlier.append(self.writer)
        documents = collect(info.plan, run_id=info.run_id, title=info.title, rate=info.rate,
                            nodes=tuple(info.nodes), started=_wall())
        begin_s = (begun_s - info.origin_s) * info.rate
        zero_s = min(0.0, float(math.floor(begin_s)))
        file = open_target(path, overwrite=self._overwrite)
        self.writer = BagWriter(
            file, documents, time_zero_s=zero_s, begin_s=begin_s, wants=self._wants,
            views=documents.known.views(), from_start=self._from_start and not self.earlier)

    # -- sockets --------------------------------------------------------------------------------

    def _gather(self) -> list[Frame]:
        """Return the messages that were handed over since the last call."""
        self._accept()
        frames: list[Frame] = []
        for key, _ in self._sockets.select(0):
            connection: socket.socket = key.fileobj  # type: ignore[assignment]
            try:
                while (size := connection.recv_into(self._buffer)) > 0:
                    with contextlib.suppress(ValueError):  # not from a node
                        frames.append(recorder_connection.parse_frame(
                            memoryview(self._buffer)[:size]))
            except BlockingIOError:
                continue
            except OSError:
                pass
            self._drop(connection)
        return frames

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


class _Elsewhere:
    """Joins the messages of other hosts with those that were handed over here.

    Attributes:
        silences: of the other hosts.
    """

    def __init__(self, others: OtherHosts, listener: BusListener, now_s: float) -> None:
        self.silences = Silences(others, now_s)
        self._listener = listener
        self.close = listener.close
        self._each_once = EachOnce()
        self._from_here: list[Frame] = []
        self._from_bus: list[Frame] = []
        self._before_s = now_s

    def joined(self, frames: list[Frame], turn_s: float) -> list[Frame]:
        """Return the messages that were sent before the previous turn began.

        Args:
            frames: handed over in this turn.
            turn_s: begin of this turn; infinity for the last one, which returns all messages.
        """
        self._each_once.handed_over(frames)
        self._from_bus += self._listener.take()
        self._from_here += frames
        until_s, self._before_s = (turn_s if turn_s == math.inf else self._before_s), turn_s
        now, self._from_here = _split(self._from_here, until_s)
        from_bus, self._from_bus = _split(self._from_bus, until_s)
        for frame, source in self._each_once.from_elsewhere(from_bus):
            now.append(frame)
            self.silences.received(source, frame[0])
        self.silences.look(min(until_s, time.monotonic()))
        return now


def _split(frames: list[Frame], until_s: float) -> tuple[list[Frame], list[Frame]]:
    """Return the messages that were sent up to a time, and the others."""
    return ([frame for frame in frames if frame[0] <= until_s],
            [frame for frame in frames if frame[0] > until_s])


def _wall() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds")
