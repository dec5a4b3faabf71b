"""The recorder: writes the messages of a run to MCAP files.

In a run on several hosts it also subscribes to the messages of other hosts (`other_hosts`). It then
writes one turn later, when all earlier messages of this machine have been handed over.
"""

from __future__ import annotations

import contextlib
import datetime
import math
import time
from collections.abc import Callable
from operator import itemgetter
from pathlib import Path
from typing import ClassVar

from rampart.actors.bus.recorder_connection import RECORDERS, parse_frame
from rampart.actors.bus.run_info import RunInfo
from rampart.actors.bus.zenoh_session import Credentials
from rampart.actors.recording.bag_writer import BagWriter, open_target
from rampart.actors.recording.other_hosts import (
    BusListener,
    EachOnce,
    Frame,
    OtherHosts,
    Silences,
)
from rampart.actors.recording.run_documents import collect
from rampart.actors.recording.run_listener import RunListener

FILE_BYTES = 1 << 30
"""Size at which a recording goes on in another file: three to four hours of a robot."""


class Recorder(RunListener):
    """One recording of one run.

    Args:
        port: base port of the run.
        path: path of the file.
        overwrite: whether the file may exist.
        wants: returns whether a full key is recorded.
        launcher: as in `RunListener`.
        others: the other hosts; None in a run on one.
        credentials: returns the recorder's credentials on the bus of a run, for other hosts.

    Attributes:
        files: writers of all files so far.
    """

    which: ClassVar[str] = RECORDERS[0]

    def __init__(self, port: int, path: Path, *, overwrite: bool = False,
                 wants: Callable[[str], bool] = lambda _key: True,
                 launcher: int | None = None, others: OtherHosts | None = None,
                 credentials: Callable[[RunInfo], Credentials | None] = lambda _run: None
                 ) -> None:
        super().__init__(port, path, launcher)
        self.files: list[BagWriter] = []
        self._overwrite = overwrite
        self._wants = wants
        self._from_start = launcher is not None
        self._others = others
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
        if self._others is not None:
            self._elsewhere = _Elsewhere(
                self._others,
                BusListener(self._others, info.endpoints, self._credentials(info)), begun_s)

    def write(self, frames: list[bytes], turn_s: float) -> None:
        """See `RunListener`."""
        info, parsed = self._run, _parsed(frames)
        if self._elsewhere is not None:
            parsed = self._elsewhere.joined(parsed, turn_s)
        for at_s, key, payload in sorted(parsed, key=itemgetter(0)):
            self.files[-1].take((at_s - info.origin_s) * info.rate, key, payload)
        if self._elsewhere is not None:
            self.files[-1].write_silences(self._elsewhere.silences.record(
                lambda at_s: (at_s - info.origin_s) * info.rate))

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


def _parsed(frames: list[bytes]) -> list[Frame]:
    found = []
    for frame in frames:
        with contextlib.suppress(ValueError):  # not from a node
            found.append(parse_frame(frame))
    return found


def _wall() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="milliseconds")
