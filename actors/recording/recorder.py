"""The recorder: writes the messages of a run to MCAP files.

Processes of this machine hand their messages over (`recorder_connection`); those of other hosts
cannot. So in a run on several hosts the recorder also subscribes on the bus to the keys that other
hosts may publish. It then writes one turn later, when all earlier messages of this machine have
been handed over. Processes of both sides may publish on a key: a message from the bus is left out
if its process hands over its messages here.
"""

from __future__ import annotations

import contextlib
import datetime
import math
import time
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any, ClassVar

import zenoh
from zenoh.handlers import Callback

from rampart.actors.access.rights import EVERYTHING, published_elsewhere
from rampart.actors.bus.limits import Remembered
from rampart.actors.bus.recorder_connection import RECORDERS, parse_frame
from rampart.actors.bus.run_info import RunInfo
from rampart.actors.bus.zenoh_session import Credentials, answering_first, open_session
from rampart.actors.recording.bag_writer import BagError, BagWriter, open_target
from rampart.actors.recording.message_form import header_of
from rampart.actors.recording.run_documents import collect
from rampart.actors.recording.run_listener import RunListener
from rampart.actors.system.layout import Layout

FILE_BYTES = 1 << 30
"""Size at which a recording goes on in another file: three to four hours of a robot."""

_VIRTUAL_FLUSH_S = 10.0
"""Simulated seconds between two flushes in virtual time: some tenths of a real second."""

Frame = tuple[float, str, bytes]
"""Monotonic time of sending, full key, payload."""

_MOST_BYTES = 60_000
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
        elsewhere: key expressions of what other hosts publish.
        credentials: returns the recorder's credentials on the bus of a run, for other hosts.

    Attributes:
        files: writers of all files so far.
    """

    which: ClassVar[str] = RECORDERS[0]

    def __init__(self, port: int, path: Path, *, overwrite: bool = False,
                 wants: Callable[[str], bool] = lambda _key: True,
                 launcher: int | None = None, elsewhere: Sequence[str] = (),
                 credentials: Callable[[RunInfo], Credentials | None] = lambda _run: None
                 ) -> None:
        super().__init__(port, path, launcher)
        self.files: list[BagWriter] = []
        self._overwrite = overwrite
        self._wants = wants
        self._from_start = launcher is not None
        self._keys_elsewhere = elsewhere
        self._credentials = credentials
        self._elsewhere: _Elsewhere | None = None

    @property
    def writer(self) -> BagWriter | None:
        """Writer of the present file."""
        return self.files[-1] if self.files else None

    @property
    def messages(self) -> int:
        """See `RunListener`."""
        return sum(file.messages for file in self.files)

    def begin(self, info: RunInfo, frames: list[bytes]) -> None:
        """See `RunListener`."""
        begun_s = min((frame[0] for frame in _parsed(frames)), default=time.monotonic())
        self._begin_file(info, begun_s)
        if self._keys_elsewhere:
            self._elsewhere = _Elsewhere(BusListener(
                self._keys_elsewhere, info.endpoints, self._credentials(info)), begun_s)

    def write(self, frames: list[bytes], turn_s: float) -> None:
        """See `RunListener`."""
        info, parsed = self._run, _parsed(frames)
        if self._elsewhere is not None:
            parsed = self._elsewhere.joined(parsed, turn_s)
        for at_s, key, payload in sorted(parsed, key=itemgetter(0)):
            self.files[-1].take((at_s - info.origin_s) * info.rate, key, payload)

    def flush(self) -> None:
        """See `RunListener`."""
        self.files[-1].flush()
        if self.files[-1].written_bytes > FILE_BYTES:
            self._begin_file(self._run, time.monotonic())

    def end(self, why: str, *, is_cut_off: bool) -> None:
        """See `RunListener`."""
        del is_cut_off
        self.files[-1].close({"ended": why, "stopped": _wall()})

    def abandon(self) -> None:
        """See `RunListener`."""
        if self._elsewhere is not None:
            self._elsewhere.close()
        if self.files:
            self.files[-1].abandon()

    def _begin_file(self, info: RunInfo, begun_s: float) -> None:
        """Begin the first file, or the next one with a number in its name."""
        self._run, path = info, self.path
        if self.files:
            path = path.with_stem(f"{path.stem}-{len(self.files) + 1}")
            self.files[-1].close({"ended": f"it goes on in {path.name}", "stopped": _wall()})
        documents = collect(info.plan, run_id=info.run_id, title=info.title, rate=info.rate,
                            nodes=tuple(info.nodes), started=_wall())
        begin_s = (begun_s - info.origin_s) * info.rate
        zero_s = min(0.0, float(math.floor(begin_s)))
        file = open_target(path, overwrite=self._overwrite)
        self.files.append(BagWriter(
            file, documents, time_zero_s=zero_s, begin_s=begin_s, wants=self._wants,
            views=documents.known.views(), from_start=self._from_start and not self.files))


class _Elsewhere:
    """Joins the messages of other hosts with those that were handed over here."""

    def __init__(self, listener: BusListener, now_s: float) -> None:
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
        return [*now, *self._each_once.from_elsewhere(from_bus)]


def _split(frames: list[Frame], until_s: float) -> tuple[list[Frame], list[Frame]]:
    """Return the messages that were sent up to a time, and the others."""
    return ([frame for frame in frames if frame[0] <= until_s],
            [frame for frame in frames if frame[0] > until_s])


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


def keys_elsewhere(layout: Layout) -> tuple[str, ...]:
    """Return key expressions of all that other hosts of a system may publish; none for one host.

    No key is in two of them.
    """
    return distinct(published_elsewhere(layout)) if layout.hosts.several else ()


def distinct(expressions: Collection[str]) -> tuple[str, ...]:
    """Return the key expressions that no other one includes; `**` if they are too many."""
    if sum(map(len, expressions)) > _MOST_BYTES:
        return (EVERYTHING,)
    wide = [zenoh.KeyExpr(expression) for expression in expressions if "*" in expression]
    return tuple(sorted(
        expression for expression in expressions
        if not any(str(other) != expression and other.includes(expression) for other in wide)))


class EachOnce:
    """Leaves out messages from the bus that were also handed over here. Pure; bounded.

    Call `handed_over` with the messages up to a time before `from_elsewhere` with those of the bus.
    """

    def __init__(self) -> None:
        self._here: Remembered[tuple[str, int], None] = Remembered(_PROCESSES)
        self._garbage: Remembered[tuple[str, bytes], None] = Remembered(_GARBAGE)

    def handed_over(self, frames: Iterable[Frame]) -> None:
        """Take messages of processes of this machine."""
        for _, key, payload in frames:
            header = header_of(payload)
            if header is None:
                self._garbage[key, payload] = None
            else:
                self._here[header.source, header.incarnation] = None

    def from_elsewhere(self, frames: Iterable[Frame]) -> Iterator[Frame]:
        """Yield the messages of other hosts' processes."""
        for frame in frames:
            header = header_of(frame[2])
            if (frame[1:] not in self._garbage if header is None
                    else (header.source, header.incarnation) not in self._here):
                yield frame


class BusListener:
    """Subscribes to the messages of other hosts as soon as a router answers.

    Args:
        keys: key expressions of what other hosts publish.
        dial: endpoints of the routers of this host.
        credentials: of the recorder; None in a run without credentials.
    """

    def __init__(self, keys: Sequence[str], dial: list[str], credentials: Credentials | None
                 ) -> None:
        self._keys = keys
        self._dial = dial
        self._credentials = credentials
        self._session: zenoh.Session | None = None
        self._held: list[zenoh.Subscriber[None]] = []
        self._arrived: deque[Frame] = deque(maxlen=_MOST_WAITING)
        self._next_try_s = 0.0

    def take(self) -> list[Frame]:
        """Return the messages since the last call."""
        if self._session is None:
            self._open()
        return [self._arrived.popleft() for _ in range(len(self._arrived))]

    def close(self) -> None:
        """Close the session."""
        session, self._session = self._session, None
        self._held.clear()
        if session is not None:
            with contextlib.suppress(zenoh.ZError):
                session.close()  # type: ignore[no-untyped-call]

    def _open(self) -> None:
        now_s = time.monotonic()
        if now_s < self._next_try_s:
            return
        self._next_try_s = now_s + _RETRY_S
        with contextlib.suppress(zenoh.ZError, OSError):  # the router has just ended
            if dial := answering_first(self._dial):
                self._session = open_session(dial, self._credentials)
                self._held = [self._session.declare_subscriber(
                    key, Callback(self._receive, lambda: None, indirect=False))
                    for key in self._keys]

    def _receive(self, sample: zenoh.Sample) -> None:  # runs on a Zenoh thread
        self._arrived.append(
            (time.monotonic(), str(sample.key_expr), sample.payload.to_bytes()))
