"""The recorder: takes what the nodes hand over, and writes it down.

It is a process of its own, and neither a node nor on the bus: whatever becomes of it, no node waits
for it, and the robot drives on. It sleeps most of the time: some twenty times a second it empties
all sockets at once, puts what it found into order by time of sending, and writes; every 0.8 s it
hands the file to the kernel. It ends when it is told to, or when the launcher of the run has ended,
however that ended; then it takes what is still in the sockets and closes the file in order.

In a run on several hosts it also hears, on the bus, what the others publish (`other_hosts`). Then
what has come is written one turn later: by then all that was sent here before has been handed over.
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

from rampart.actors.bus import recorder_connection
from rampart.actors.bus.run_info import RunInfo, ask
from rampart.actors.bus.zenoh_session import Credentials
from rampart.actors.machine.unix_peer import is_same_user
from rampart.actors.recording.bag_writer import BagError, BagWriter, open_target
from rampart.actors.recording.other_hosts import EachOnce, Ear, Frame, OtherHosts, Silences
from rampart.actors.recording.run_documents import collect

PERIOD_S = 0.05
"""Real seconds between two looks into the sockets."""

FLUSH_S = 0.8
"""Real seconds between two hand-overs of the file to the kernel: so much a crash may lose."""

LAST_S = 2.0
"""Real seconds that nodes have to end after their launcher, while their sockets are still read."""

FILE_BYTES = 1 << 30
"""A recording that is larger goes on in another file: three to four hours of a robot."""

RUN_ENDED = signal.SIGUSR1
"""What the launcher of a run sends its recorder when all nodes have ended."""

_RUN_ENDED = "the run has ended"
_ASK_S = 0.2
_WAITING_FRAMES = 500_000


class Recorder:
    """One recording of one run. Use: `open`, then `run`, once.

    Args:
        port: base port of the run.
        path: of the file, which must not exist.
        overwrite: it may.
        wants: says of a full key whether it is recorded.
        launcher: pid of the run's launcher if it is about to start; None joins the run there is.
        others: what there is to be heard of other hosts; None in a run on one.
        shown: returns by what it shows who it is on the bus of a run, for that.
    """

    def __init__(self, port: int, path: Path, *, overwrite: bool = False,
                 wants: Callable[[str], bool] = lambda _key: True,
                 launcher: int | None = None, others: OtherHosts | None = None,
                 shown: Callable[[RunInfo], Credentials | None] = lambda _run: None) -> None:
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
        self._shown = shown
        self._elsewhere: _Elsewhere | None = None
        self._next_ask_s = 0.0
        self._next_flush_s = 0.0

    def open(self) -> None:
        """Take the place where nodes look for a recorder.

        Raises:
            BagError: the run is being recorded already.
        """
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        try:
            listener.bind(recorder_connection.address(self._port))
        except OSError:
            listener.close()
            raise BagError(f"the run on port {self._port} is being recorded already") from None
        listener.listen(256)
        self._listener = listener

    def run(self, stop: int, duration_s: float | None = None) -> str:
        """Record until a byte can be read from `stop`, or the run or its time is over; say why.

        Args:
            stop: file descriptor; the byte is the number of a signal, `RUN_ENDED` or another.
            duration_s: real seconds.

        Raises:
            BagError: the file cannot be written (any more); what is in it stays.
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
        """What was written, file by file."""
        return [*self.earlier, *([self.writer] if self.writer else [])]

    def close(self) -> None:
        """Let go of all sockets, and of the file as it is."""
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
        if writer is None or info is None:  # it is not known yet what runs
            return
        self._waiting = []
        if self._elsewhere is not None:
            frames = self._elsewhere.joined(frames, math.inf if is_last else turn_s)
        for at_s, key, payload in sorted(frames, key=itemgetter(0)):
            writer.take((at_s - info.origin_s) * info.rate, key, payload)
        if self._elsewhere is not None:
            writer.tell_unheard(self._elsewhere.silences.record(
                lambda at_s: (at_s - info.origin_s) * info.rate))
        now_s = time.monotonic()
        if now_s >= self._next_flush_s:
            self._next_flush_s = now_s + FLUSH_S
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
        """Return how long to sleep: at a high rate the sockets fill sooner."""
        return min(PERIOD_S, 0.4 / self._info.rate) if self._info else PERIOD_S

    # -- the run --------------------------------------------------------------------------------

    def _find_run(self) -> None:
        """Begin the file as soon as it is known what runs."""
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
                self._others, Ear(self._others, info.endpoints, self._shown(info)), begun_s)

    def _begin_file(self, info: RunInfo, begun_s: float) -> None:
        """Begin the file; if there is one already, the next one, with a number in its name."""
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
        """Return all that was handed over since the last time."""
        self._accept()
        frames: list[Frame] = []
        for key, _ in self._sockets.select(0):
            connection: socket.socket = key.fileobj  # type: ignore[assignment]
            try:
                while (size := connection.recv_into(self._buffer)) > 0:
                    with contextlib.suppress(ValueError):  # not a node's
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
    """What comes of other hosts, put together with what was handed over here.

    Attributes:
        silences: of theirs.
    """

    def __init__(self, others: OtherHosts, ear: Ear, now_s: float) -> None:
        self.silences = Silences(others, now_s)
        self._ear = ear
        self._each_once = EachOnce()
        self._held: list[Frame] = []
        self._heard: list[Frame] = []
        self._before_s = now_s

    def joined(self, frames: list[Frame], turn_s: float) -> list[Frame]:
        """Return what is to be written now: what was sent before the turn before this one.

        Args:
            frames: handed over in this turn.
            turn_s: when it began; infinity has nothing held back.
        """
        self._each_once.handed_over(frames)
        self._heard += self._ear.take()
        self._held += frames
        until_s, self._before_s = (turn_s if turn_s == math.inf else self._before_s), turn_s
        now, self._held = _split(self._held, until_s)
        heard, self._heard = _split(self._heard, until_s)
        for frame, source in self._each_once.from_elsewhere(heard):
            now.append(frame)
            self.silences.heard(source, frame[0])
        self.silences.look(min(until_s, time.monotonic()))
        return now

    def close(self) -> None:
        """Hear nothing more."""
        self._ear.close()


def _split(frames: list[Frame], until_s: float) -> tuple[list[Frame], list[Frame]]:
    """Return those that were sent until a time, and the others."""
    return ([frame for frame in frames if frame[0] <= until_s],
            [frame for frame in frames if frame[0] > until_s])


def _wall() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds")
