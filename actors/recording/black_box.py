"""The black box: the last minutes of a run, and an incident around each decision and failure.

It is a recorder that keeps messages as they were sent, in a ring on disk (`ring`). A decision on a
fault, or a failed process, begins an incident (`incidents`); another one before its end extends it.
When an incident is over, its recording is written from the ring. All state is on disk: a black box
that is restarted continues, and what a killed run leaves is read by `incidents.recover`.

The robot never waits for it. Without room it deletes its oldest incidents, then it ends.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from rampart.actors.bus.envelope import UNREADABLE, decode
from rampart.actors.bus.run_info import RunInfo, find_runs
from rampart.actors.bus.topic import ROOT, Topic
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics
from rampart.actors.ftm.history import Debounce, History
from rampart.actors.ftm.narrator import Narrator
from rampart.actors.recording import incidents, ring
from rampart.actors.recording.bag_writer import BagError, check_reserve
from rampart.actors.recording.incidents import Incident
from rampart.actors.recording.recorder import Recorder
from rampart.actors.recording.ring import Ring
from rampart.actors.recording.run_documents import Documents, collect
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
_CHECKPOINT_BYTES = 8 << 20
_LOCK_S = 5.0


class BlackBoxWriter:
    """Ring, incidents and history of one run; the form of a `BagWriter`, for a `Recorder`.

    Args:
        folder: folder of the system.
        documents: description of the run.
        limits: `[black_box]` of the specification.
        checkpoints: folder of the nodes' checkpoints; None without.
        again: whether it continues the ring of this part of the run.
        wall: returns Unix time.

    Attributes:
        messages: number of messages so far.
        is_cut_off: whether the run has ended otherwise than in order.

    Raises:
        BagError: the folder of the run is in use.
        OSError: the folder cannot be written.
    """

    written_bytes = 0  # no file grows

    def __init__(self, folder: Path, documents: Documents, limits: Limits, *,
                 checkpoints: Path | None = None, again: bool = False,
                 wall: Callable[[], float] = time.time) -> None:
        self.messages = 0
        self.is_cut_off = False
        self._system, self._folder = folder, folder / documents.run_id
        self._limits, self._checkpoints, self._wall = limits, checkpoints, wall
        self._run = documents.run_id
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        incidents.recover(folder, _living() | {self._run} if again else _living() - {self._run})
        incidents.remove_empty(folder)
        self._folder.mkdir(exist_ok=True)
        self._lock = _locked(self._folder)
        incidents.write_head(self._folder, documents)
        self._most_bytes = int(limits.limit_mb * 1e6)
        self._make_room()
        self._ring = Ring(self._folder, self._most_bytes // _SEGMENTS)
        self._open = {incident.name: incident for incident, path
                      in incidents.incidents_in(folder)
                      if incident.run == self._run and not path.exists()}
        self._written = dict(self._open)
        self._narrator = Narrator(documents.known.system.titles)
        self._topics: dict[str, Topic[Any] | None] = {}
        self._debounce = Debounce()
        self._history = History(folder, self._run)
        self._reported = ""
        self._begun_s = -math.inf if again else math.inf
        self._now_s = self._tidied_s = -math.inf

    def take(self, at_s: float, key: str, payload: bytes) -> None:
        """Add a message, as `BagWriter.take`."""
        self.messages += 1
        self._begun_s, self._now_s = min(self._begun_s, at_s), max(self._now_s, at_s)
        self._ring.add(at_s, key, payload)
        if key not in self._topics:
            self._topics[key] = find_topic(key.removeprefix(f"{ROOT}/"), _WATCHED)
        topic = self._topics[key]
        if topic is None:
            return
        try:
            header, body = decode(topic, payload)
        except UNREADABLE:
            return
        self._debounce.take(body, header, at_s)
        lines = self._narrator.describe(body, header)
        if lines and (body.active if isinstance(body, fm.DecisionRecord) else
                      isinstance(body, fm.ProcessEvent) and body.event in fm.FAILURES):
            self._trigger(lines[0].text, at_s)

    def write_silences(self, record: dict[str, str]) -> None:
        """Do nothing: the messages of other hosts are not kept."""

    def flush(self) -> None:
        """Sync the ring, write descriptions and incidents that are over, and make room.

        Raises:
            OSError: the disk is full, or it cannot be written.
        """
        self._write(over_s=self._now_s)

    def close(self, end: object = None) -> None:
        """Write all incidents, also one of a run that was cut off, and remove the ring.

        Raises:
            OSError: the disk is full, or it cannot be written.
        """
        del end
        self._write(over_s=math.inf)
        if not self.is_cut_off:
            self._history.heal_others(_living())
            for path in ring.segments(self._folder):
                path.unlink()
        self.abandon()
        incidents.recover(self._system, _living() - {self._run})
        incidents.remove_empty(self._system)

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
        limits, last = self._limits, next(reversed(self._open.values()), None)
        if last is not None and at_s - limits.before_s <= last.to_s and (
                at_s <= (end_s := last.at_s + 2 * limits.after_s + limits.before_s)):
            self._open[last.name] = msgspec.structs.replace(last, to_s=max(
                last.to_s, min(at_s + limits.after_s, end_s)))
            return
        wall_s = self._wall()
        while (name := incidents.name_at(wall_s)) in self._open:
            wall_s += 0.001
        self._open[name] = Incident(
            name=name, system=self._system.name, run=self._run, at=incidents.iso(wall_s),
            cause=one_line(cause), at_s=at_s, to_s=at_s + limits.after_s,
            from_s=max(at_s - limits.before_s, self._begun_s, last.to_s if last else -math.inf),
            checkpoints=_read_all(self._checkpoints))

    def _write(self, over_s: float) -> None:
        """Write what is new, and the recordings of incidents that were over at a time."""
        self._ring.sync()
        self._keep_reserve()
        for name, incident in list(self._open.items()):
            if self._written.get(name) is not incident:
                incidents.describe(self._folder, incident)
                self._written[name] = incident
            if incident.to_s < over_s - self._limits.before_s:  # nothing can extend it any more
                is_cut = self.is_cut_off and incident.to_s > self._now_s
                incidents.record(self._folder, msgspec.structs.replace(
                    incident, to_s=min(incident.to_s, self._now_s),
                    partial="the run was cut off" if is_cut else ""))
                del self._open[name], self._written[name]
                self._tidied_s = -math.inf
        self._history.put(self._debounce.changes(over_s), self._wall())
        if self._history.problem != self._reported:
            self._reported = self._history.problem
            complain(self._reported)
        if self._now_s - self._tidied_s >= _HOUSEKEEPING_S:
            self._tidied_s = self._now_s
            self._ring.drop(min([self._now_s - self._limits.before_s,
                                 *(i.from_s for i in self._open.values())]))
            self._make_room()

    def _make_room(self) -> None:
        while incidents.size(self._system) > self._most_bytes:
            if not (incidents.drop_oldest(self._system, self._open) or self._ring.drop_oldest()):
                return

    def _keep_reserve(self) -> None:
        """Delete the oldest incidents, then segments, while the disk has only its reserve.

        Raises:
            OSError: nothing more can be deleted.
        """
        while True:
            try:
                check_reserve(self._folder)
            except OSError:
                if not (incidents.drop_oldest(self._system, self._open)
                        or self._ring.drop_oldest()):
                    raise
            else:
                return


class BlackBox(Recorder):
    """The recorder of a black box.

    Args:
        port: base port of the run.
        folder: folder of the system.
        limits: `[black_box]` of the specification.
        launcher: pid of the launcher.
        checkpoints: folder of the nodes' checkpoints; None without.
        again: whether an earlier process of this run's black box has died.
    """

    which = "black_box"
    period_s, flush_s = PERIOD_S, SYNC_S

    def __init__(self, port: int, folder: Path, limits: Limits, *, launcher: int,
                 checkpoints: Path | None = None, again: bool = False) -> None:
        super().__init__(port, folder, launcher=launcher)
        self._limits, self._checkpoints, self._again = limits, checkpoints, again
        self._box: BlackBoxWriter | None = None

    def _begin_file(self, info: RunInfo, begun_s: float) -> None:
        del begun_s
        documents = collect(info.plan, run_id=info.run_id, title=info.title, rate=info.rate,
                            nodes=tuple(info.nodes), started=incidents.iso(time.time()))
        self._box = BlackBoxWriter(self.path, documents, self._limits,
                                   checkpoints=self._checkpoints, again=self._again)
        # It has all that a recorder calls.
        self.writer = self._box  # type: ignore[assignment]

    def _finish(self, why: str, *, run_is_over: bool) -> None:
        if self._box is not None:
            self._box.is_cut_off = run_is_over  # its launcher has died without a signal
        super()._finish(why, run_is_over=run_is_over)


def _living() -> set[str]:
    return {run.run_id for run in find_runs()}


def _locked(folder: Path) -> int:
    until_s = time.monotonic() + _LOCK_S
    while (descriptor := incidents.lock(folder)) is None:
        if time.monotonic() > until_s:
            raise BagError(f"{folder}: another black box of this run writes there")
        time.sleep(0.1)
    return descriptor


def _read_all(folder: Path | None) -> dict[str, bytes]:
    """Return the newest files of a folder by name, of a limited size in total."""
    found: dict[str, bytes] = {}
    left = _CHECKPOINT_BYTES
    for path in sorted(folder.iterdir()) if folder and folder.is_dir() else ():
        try:
            data = path.read_bytes() if path.stat().st_size <= left else b""
        except OSError:  # replaced meanwhile
            continue
        left -= len(data)
        found[path.name] = data
    return found
