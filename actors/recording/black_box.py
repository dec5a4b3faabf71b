"""The black box: the last minutes of a run, and an incident around each decision and failure.

It is a recorder that keeps messages as they were handed over, in a ring on disk (`ring`). A
decision on a fault, or a failed process, begins an incident (`incidents`); another one before its
end extends it. The ring keeps the messages of incidents, from which tools write recordings. All
state is on disk: a black box that is restarted continues, and tools read what a killed run leaves.

The robot never waits for it. Without room it deletes its oldest incidents, then it ends.
"""

from __future__ import annotations

import contextlib
import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from rampart.actors.bus.envelope import UNREADABLE, decode
from rampart.actors.bus.recorder_connection import parse_frame, parse_head
from rampart.actors.bus.run_info import RunInfo, find_runs
from rampart.actors.bus.topic import ROOT, Topic
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics
from rampart.actors.ftm.history import Debounce, History
from rampart.actors.ftm.narrator import Narrator
from rampart.actors.recording import incidents
from rampart.actors.recording.bag_writer import BagError, check_reserve
from rampart.actors.recording.incidents import Incident
from rampart.actors.recording.ring import Ring
from rampart.actors.recording.run_documents import Documents, collect
from rampart.actors.recording.run_listener import RunListener
from rampart.actors.system.topics import find_topic
from rampart.files.plain_text import one_line
from rampart.files.streams import complain
from rampart.manager.spec.tables import BlackBox as Limits

PERIOD_S = 0.5
"""Real seconds between two looks into the sockets: the wake-ups are most of the cost."""

SYNC_S = 1.0
"""Real seconds between two syncs; a loss of power costs so much at most."""

_WATCHED = (topics.DETECTION, topics.DECISION, topics.PROCESS_EVENT)
_SEGMENTS = 16
_HOUSEKEEPING_S = 10.0
_LOCK_S = 5.0


class BlackBoxWriter:
    """Ring, incidents and history of one run.

    Args:
        folder: folder of the system.
        documents: description of the run.
        limits: `[black_box]` of the specification.
        origin_s: start of simulated time, monotonic seconds.
        again: whether it continues the ring of this part of the run.
        wall: returns Unix time.

    Attributes:
        messages: number of messages so far.

    Raises:
        BagError: the folder of the run is in use.
        OSError: the folder cannot be written.
    """

    def __init__(self, folder: Path, documents: Documents, limits: Limits, *, origin_s: float = 0.0,
                 again: bool = False, wall: Callable[[], float] = time.time) -> None:
        self._system, self._folder = folder, folder / documents.run_id
        self._limits, self._wall = limits, wall
        self._origin_s, self._rate = origin_s, float(documents.run["rate"])
        self._run = documents.run_id
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        incidents.settle(folder, _living() | {self._run} if again else _living() - {self._run})
        self._folder.mkdir(exist_ok=True)
        self._lock = _locked(self._folder)
        incidents.begin(self._folder, documents)
        self._most_bytes = int(limits.limit_mb * 1e6)
        self._ring = Ring(self._folder, self._most_bytes // _SEGMENTS, origin_s, self._rate)
        self._make_room(is_whole=True)
        known = [one for one, _ in incidents.incidents_in(folder) if one.run == self._run]
        self._last = known[-1] if known and again else None
        self._described = self._last
        self._narrator = Narrator(documents.known.system.titles)
        self._topics: dict[bytes, Topic[Any] | None] = {}
        self._debounce = Debounce()
        self._history = History(folder, self._run)
        self._reported = ""
        self._begun_s = -math.inf if again else math.inf
        self._now_s = self._tidied_s = -math.inf
        self.messages = 0

    def write(self, frames: list[bytes], turn_s: float = 0.0) -> None:
        """See `RunWriter`."""
        del turn_s
        for frame in frames:
            with contextlib.suppress(ValueError):  # not from a node
                self._take(frame)

    def _take(self, frame: bytes) -> None:
        """Add a message as it was handed over.

        Raises:
            ValueError: it is not a frame.
            OSError: the disk is full, or it cannot be written.
        """
        sent_s, key = parse_head(frame)
        self.messages += 1
        at_s = (sent_s - self._origin_s) * self._rate
        self._begun_s, self._now_s = min(self._begun_s, at_s), max(self._now_s, at_s)
        self._ring.add(at_s, frame)
        if key not in self._topics:
            self._topics[key] = find_topic(
                key.decode(errors="replace").removeprefix(f"{ROOT}/"), _WATCHED)
        topic = self._topics[key]
        if topic is None:
            return
        try:
            header, body = decode(topic, parse_frame(frame)[2])
        except UNREADABLE:
            return
        self._debounce.take(body, header, at_s)
        lines = self._narrator.describe(body, header)
        if lines and (body.active if isinstance(body, fm.DecisionRecord) else
                      isinstance(body, fm.ProcessEvent) and body.event in fm.FAILURES):
            self._trigger(lines[0].text, at_s)

    def flush(self) -> None:
        """Make room, sync the ring, and write the description of a new or extended incident.

        Raises:
            OSError: the disk is full, or it cannot be written.
        """
        is_due = self._now_s - self._tidied_s >= _HOUSEKEEPING_S
        if is_due:
            self._tidied_s = self._now_s
            incidents.keep_needed(self._ring, self._folder, self._now_s - self._limits.before_s)
        self._make_room(is_whole=is_due)
        self._ring.sync()
        self._describe_last()
        self._history.put(self._debounce.changes(self._now_s), self._wall())
        if self._history.problem != self._reported:
            self._reported = self._history.problem
            complain(self._reported)

    def end(self, why: str = "", *, is_cut_off: bool = False) -> None:
        """Keep only the messages of incidents, or all if the run was cut off.

        Raises:
            OSError: the disk is full, or it cannot be written.
        """
        del why
        if self._last is not None and not is_cut_off:
            self._last = msgspec.structs.replace(
                self._last, to_s=min(self._last.to_s, self._now_s))
        self.flush()
        self._history.put(self._debounce.changes(math.inf), self._wall())
        if not is_cut_off:
            self._history.heal_others(_living())
            self._ring.close()
            incidents.keep_needed(self._ring, self._folder)
            incidents.end(self._folder)
        self.abandon()
        incidents.settle(self._system, _living() - {self._run})

    def abandon(self) -> None:
        """Close all files as they are. Harmless when repeated."""
        self._ring.close()
        self._history.close()
        if self._lock >= 0:
            os.close(self._lock)
            self._lock = -1

    # -- incidents ------------------------------------------------------------------------------

    def _trigger(self, cause: str, at_s: float) -> None:
        """Extend the last incident if the time before this one overlaps it; else begin one.

        An incident is twice as long as usual at most; the next one follows it without a gap.
        """
        limits, last = self._limits, self._last
        if last is not None and at_s - limits.before_s <= last.to_s and (
                at_s <= (end_s := last.at_s + 2 * limits.after_s + limits.before_s)):
            self._last = msgspec.structs.replace(last, to_s=max(
                last.to_s, min(at_s + limits.after_s, end_s)))
            return
        self._describe_last()
        wall_s = self._wall()
        while (self._folder / f"{(name := incidents.name_at(wall_s))}.json").exists():
            wall_s += 0.001
        self._last = Incident(
            name=name, system=self._system.name, run=self._run, at=incidents.iso(wall_s),
            cause=one_line(cause), at_s=at_s, to_s=at_s + limits.after_s,
            from_s=max(at_s - limits.before_s, self._begun_s, last.to_s if last else -math.inf))

    def _describe_last(self) -> None:
        if self._last is not None and self._last is not self._described:
            incidents.describe(self._folder, self._last)
            self._described = self._last

    # -- room -----------------------------------------------------------------------------------

    def _make_room(self, *, is_whole: bool) -> None:
        """Delete the oldest incidents, then segments, while the disk has only its reserve.

        Args:
            is_whole: whether to keep to the limit of the system, too.

        Raises:
            OSError: nothing more can be deleted.
        """
        while True:
            try:
                check_reserve(self._folder)
                if not is_whole or incidents.size(self._system) <= self._most_bytes:
                    return
                problem = None
            except OSError as error:
                problem = error
            if incidents.drop_oldest(self._system, keep=self._last):
                incidents.keep_needed(self._ring, self._folder,
                                      self._now_s - self._limits.before_s)
            elif not self._ring.drop_oldest():
                if problem:
                    raise problem
                return


class BlackBox(RunListener):
    """Hands the messages of a run to a `BlackBoxWriter`.

    Args:
        port: base port of the run.
        folder: folder of the system.
        limits: `[black_box]` of the specification.
        launcher: pid of the launcher.
        again: whether an earlier process of this run's black box has died.
    """

    which = "black_box"
    period_s, flush_s = PERIOD_S, SYNC_S

    def __init__(self, port: int, folder: Path, limits: Limits, *, launcher: int,
                 again: bool = False) -> None:
        super().__init__(port, folder, launcher)
        self._limits, self._again = limits, again

    def begin(self, info: RunInfo, frames: list[bytes]) -> BlackBoxWriter:
        """See `RunListener`."""
        del frames
        documents = collect(info.plan, run_id=info.run_id, title=info.title, rate=info.rate,
                            nodes=tuple(info.nodes), started=incidents.iso(time.time()))
        return BlackBoxWriter(
            self.path, documents, self._limits, origin_s=info.origin_s, again=self._again)


def _living() -> set[str]:
    return {run.run_id for run in find_runs()}


def _locked(folder: Path) -> int:
    until_s = time.monotonic() + _LOCK_S
    while (descriptor := incidents.lock(folder)) is None:
        if time.monotonic() > until_s:
            raise BagError(f"{folder}: another black box of this run writes there")
        time.sleep(0.1)
    return descriptor
