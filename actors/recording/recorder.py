"""The recorder: writes the messages of a run to an MCAP file.

Processes of this machine hand their messages over (`recorder_connection`); those of other hosts
cannot. So in a run on several hosts the recorder also subscribes to the bus. It then writes one
turn later, when all earlier messages of this machine have been handed over. A message from the bus
is left out if its process hands over its messages here.
"""

from __future__ import annotations

import contextlib
import datetime
import math
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from operator import itemgetter
from pathlib import Path
from typing import Any, ClassVar

import zenoh
from zenoh.handlers import Callback

from rampart.actors.access.rights import EVERYTHING
from rampart.actors.bus.limits import Remembered
from rampart.actors.bus.recorder_connection import RECORDERS, parse_frame
from rampart.actors.bus.run_info import RunInfo
from rampart.actors.bus.zenoh_session import Credentials, answering_first, open_session
from rampart.actors.recording.bag_writer import BagError, BagWriter, open_target
from rampart.actors.recording.message_form import header_of
from rampart.actors.recording.run_documents import collect
from rampart.actors.recording.run_listener import RunListener

_VIRTUAL_FLUSH_S = 10.0
"""Simulated seconds between two flushes in virtual time: some tenths of a real second."""

Frame = tuple[float, str, bytes]
"""Monotonic time of sending, full key, payload."""

_MOST_WAITING = 100_000
_PROCESSES = 4096
_GARBAGE = 64
_RETRY_S = 0.2


class Recorder(RunListener):
    """One recording of one run.

    Args:
        port: base port of the run.
        path: path of the file.
        overwrite: whether the file may exist.
        wants: returns whether a full key is recorded.
        launcher: as in `RunListener`.
        credentials: returns the recorder's credentials on the bus of a run, for other hosts.

    Attributes:
        file: writer of the file, after `begin`.
    """

    file: BagWriter
    which: ClassVar[str] = RECORDERS[0]

    def __init__(self, port: int, path: Path, *, overwrite: bool = False,
                 wants: Callable[[str], bool] = lambda _key: True,
                 launcher: int | None = None,
                 credentials: Callable[[RunInfo], Credentials | None] = lambda _run: None
                 ) -> None:
        super().__init__(port, path, launcher)
        self._overwrite = overwrite
        self._wants = wants
        self._from_start = launcher is not None
        self._credentials = credentials
        self._other_hosts: _OtherHosts | None = None

    @property
    def messages(self) -> int:
        """See `RunWriter`."""
        return self.file.messages

    def begin(self, info: RunInfo, frames: list[bytes]) -> Recorder:
        """See `RunListener`."""
        begun_s = min((frame[0] for frame in _parsed(frames)), default=time.monotonic())
        self._origin_s, self._rate = info.origin_s, info.rate
        begin_s = (begun_s - info.origin_s) * info.rate
        documents = collect(info.plan, run_id=info.run_id, title=info.title, rate=info.rate,
                            nodes=tuple(info.nodes), started=_wall())
        self.file = BagWriter(
            open_target(self.path, overwrite=self._overwrite), documents, begin_s=begin_s,
            time_zero_s=min(0.0, float(math.floor(begin_s))),
            views=documents.known.views(), wants=self._wants, from_start=self._from_start)
        if info.hosts:
            self._other_hosts = _OtherHosts(info.endpoints, self._credentials(info), begun_s)
        return self

    def write(self, frames: list[bytes], turn_s: float) -> None:
        """See `RunWriter`."""
        parsed = _parsed(frames)
        if self._other_hosts is not None:
            parsed = self._other_hosts.joined(parsed, turn_s)
        for at_s, key, payload in sorted(parsed, key=itemgetter(0)):
            self.file.take((at_s - self._origin_s) * self._rate, key, payload)

    def flush(self) -> None:
        """See `RunWriter`."""
        self.file.flush()

    def end(self, why: str, *, is_cut_off: bool) -> None:
        """See `RunWriter`."""
        del is_cut_off
        self.file.close({"ended": why, "stopped": _wall()})

    def abandon(self) -> None:
        """See `RunWriter`."""
        if self._other_hosts is not None:
            self._other_hosts.close()
        self.file.abandon()


def _parsed(frames: list[bytes]) -> list[Frame]:
    found = []
    for frame in frames:
        with contextlib.suppress(ValueError):  # not from a node
            found.append(parse_frame(frame))
    return found


def _wall() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds")


# -- a run in virtual time -------------------------------------------------------------------------


class VirtualRecording:
    """One recording in the same process. Call `take` for each message, then `close`.

    The same run gives the same file. If the file cannot be written any more, the recording ends and
    the run goes on.

    Args:
        path: path of the file.
        plan: plan of the run (`RunPlan.description`).
        title: title for people.
        nodes: names of the nodes.
        lead_s: whole simulated seconds from the start of the run to simulated time 0.
        overwrite: whether the file may exist.

    Raises:
        BagError: the file cannot be written.
    """

    def __init__(self, path: Path, plan: Mapping[str, Any], title: str, *,
                 nodes: Iterable[str], lead_s: float, overwrite: bool) -> None:
        self._path = path
        self._failed = ""
        self._next_flush_s = 0.0
        documents = collect(plan, run_id=f"virtual-{plan.get('seed')}", title=title, rate=1.0,
                            nodes=tuple(nodes), started="")
        file = open_target(path, overwrite=overwrite)
        try:
            self._writer = BagWriter(file, documents, time_zero_s=-lead_s,
                                     views=documents.known.views(), from_start=True)
        except OSError as error:
            file.close()
            raise BagError(f"{path}: {error.strerror or error}") from None

    @property
    def problem(self) -> str:
        """Why the recording has ended before the run; "" if it has not."""
        return self._failed

    def take(self, at_s: float, key: str, payload: bytes) -> None:
        """Record a message that was sent at a simulated time."""
        if self._failed:
            return
        try:
            self._writer.take(at_s, key, payload)
            if at_s >= self._next_flush_s:
                self._next_flush_s = at_s + _VIRTUAL_FLUSH_S
                self._writer.flush()
        except Exception as error:  # the run goes on in any case
            self._fail(error)

    def close(self) -> str:
        """Write the end of the file, and return one line about the recording."""
        if not self._failed:
            try:
                self._writer.close({"ended": "the run has ended"})
            except Exception as error:
                self._fail(error)
        if not self._failed and not self._path.exists():
            return f"{self._path}: was removed while it was written: nothing is recorded"
        return self._failed or f"recorded {self._writer.messages} messages in {self._path}"

    def _fail(self, error: Exception) -> None:
        self._writer.abandon()
        why = getattr(error, "strerror", None) or f"{type(error).__name__}: {error}"
        self._failed = (f"{self._path}: {why}: the recording ends after "
                        f"{self._writer.messages} messages")


# -- other hosts -----------------------------------------------------------------------------------


class _OtherHosts:
    """Messages of the processes of other hosts, from the bus. Bounded.

    Args:
        dial: endpoints of the routers of this host.
        credentials: of the recorder; None in a run without credentials.
        now_s: begin of the recording, monotonic seconds.
    """

    def __init__(self, dial: list[str], credentials: Credentials | None, now_s: float) -> None:
        self._dial, self._credentials = dial, credentials
        self._session: zenoh.Session | None = None
        self._next_try_s = 0.0
        self._arrived: deque[Frame] = deque(maxlen=_MOST_WAITING)
        self._waiting: list[tuple[Frame, bool]] = []
        """Messages of this turn and the one before, and whether they came from the bus."""
        self._before_s = now_s
        self._here: Remembered[tuple[str, int], None] = Remembered(_PROCESSES)
        self._garbage: Remembered[tuple[str, bytes], None] = Remembered(_GARBAGE)

    def joined(self, frames: list[Frame], turn_s: float) -> list[Frame]:
        """Return the messages of all hosts that were sent before the previous turn began.

        Args:
            frames: handed over in this turn.
            turn_s: begin of this turn; infinity for the last one, which returns all messages.
        """
        if self._session is None:
            self._open()
        for _, key, payload in frames:
            header = header_of(payload)
            if header is None:
                self._garbage[key, payload] = None
            else:
                self._here[header.source, header.incarnation] = None
        self._waiting += [(frame, False) for frame in frames]
        self._waiting += [(self._arrived.popleft(), True) for _ in range(len(self._arrived))]
        until_s, self._before_s = (turn_s if turn_s == math.inf else self._before_s), turn_s
        due = [frame for frame, by_bus in self._waiting
               if frame[0] <= until_s and not (by_bus and self._is_from_here(frame))]
        self._waiting = [one for one in self._waiting if one[0][0] > until_s]
        return due

    def _is_from_here(self, frame: Frame) -> bool:
        """Return whether the process that sent a message hands over its messages."""
        header = header_of(frame[2])
        if header is None:
            return frame[1:] in self._garbage
        return (header.source, header.incarnation) in self._here

    def close(self) -> None:
        """Close the session."""
        session, self._session = self._session, None
        if session is not None:
            with contextlib.suppress(zenoh.ZError):
                session.close()  # type: ignore[no-untyped-call]

    def _open(self) -> None:
        """Subscribe to the bus as soon as a router answers."""
        now_s = time.monotonic()
        if now_s < self._next_try_s:
            return
        self._next_try_s = now_s + _RETRY_S
        with contextlib.suppress(zenoh.ZError, OSError):  # the router has just ended
            if dial := answering_first(self._dial):
                self._session = open_session(dial, self._credentials)
                self._held = self._session.declare_subscriber(
                    EVERYTHING, Callback(self._receive, lambda: None, indirect=False))

    def _receive(self, sample: zenoh.Sample) -> None:  # runs on a Zenoh thread
        self._arrived.append(
            (time.monotonic(), str(sample.key_expr), sample.payload.to_bytes()))
