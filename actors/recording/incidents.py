"""Incidents: what happened around a decision or a failed process, kept as recordings.

The folder of a system has one folder for each run:

    head.mcap       description of the run: specification, files, versions, options
    ended           mark that it has ended in order, or that its end is described
    NUMBER.ring     the last minutes, and the messages of incidents (`ring`)
    NAME.json       description of an incident (`Incident`)
    NAME.mcap       its recording, in folders of version 1.0

The black box locks the folder of its run (flock(2)). An unlocked folder without the mark belongs to
a run that was cut off: `settle` describes its last seconds as an incident.
"""

from __future__ import annotations

import contextlib
import datetime
import fcntl
import math
import os
import shutil
import tempfile
from collections.abc import Collection, Iterator
from pathlib import Path

import msgspec

from rampart.actors.recording import ring
from rampart.actors.recording.bag_reader import BagReader, Summary
from rampart.actors.recording.bag_writer import BagError, BagWriter
from rampart.actors.recording.ring import Ring, Span
from rampart.actors.recording.run_documents import (
    Documents,
    recorded_system,
    restore,
)
from rampart.actors.recording.views import Views
from rampart.files.writing import replace_file, sync
from rampart.manager.spec.tables import BlackBox

HEAD, ENDED = "head.mcap", "ended"

SLACK_S = 2.0
"""Simulated seconds that may be missing at either end of a complete incident."""

_LARGEST_JSON = 64 << 20


class Incident(msgspec.Struct, frozen=True, kw_only=True):
    """An incident. Times are simulated seconds of its run.

    Attributes:
        name: unique name, from the wall clock at its begin.
        system: name of the system.
        run: run id.
        at: wall clock at its begin, ISO 8601.
        cause: the event that began it, in words.
        at_s: time of this event.
        from_s: begin of its recording.
        to_s: end of its recording.
        partial: why a part is missing; "" if none is.
    """

    name: str
    system: str
    run: str
    at: str
    cause: str
    at_s: float
    from_s: float
    to_s: float
    partial: str = ""


def state_folder(system: str) -> Path:
    """Return the folder of a system's incidents and history; it may not exist.

    Raises:
        BagError: the user has no home directory.
    """
    home = os.environ.get("XDG_STATE_HOME", "")
    try:
        state = Path(home) if home.startswith("/") else Path.home() / ".local/state"
    except RuntimeError:
        raise BagError("this user has no home directory; expected a folder in XDG_STATE_HOME"
                       ) from None
    return state / "rampart" / system


def name_at(wall_s: float) -> str:
    """Return the name of an incident that begins at a Unix time."""
    return datetime.datetime.fromtimestamp(wall_s, datetime.UTC).strftime("%Y%m%d-%H%M%S-%f")[:-3]


def iso(wall_s: float) -> str:
    """Return a Unix time as ISO 8601."""
    return datetime.datetime.fromtimestamp(wall_s, datetime.UTC).isoformat(timespec="milliseconds")


def lock(folder: Path) -> int | None:
    """Lock the folder of a run, and return the descriptor to close; None if it is locked.

    Raises:
        OSError: the folder does not exist.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        return None
    return descriptor


def describe(folder: Path, incident: Incident) -> None:
    """Write the description of an incident, and wait until it is on the disk.

    Raises:
        OSError: it cannot be written.
    """
    replace_file(folder / f"{incident.name}.json",
                 msgspec.json.format(msgspec.json.encode(incident)))


def incidents_in(folder: Path) -> list[tuple[Incident, Path]]:
    """Return the incidents of a system, oldest first, each with the path of its recording.

    Only version 1.0 has left recordings there. Damaged descriptions are left out.
    """
    found = []
    for path in sorted(folder.glob("*/*.json"), key=lambda path: path.name):
        with contextlib.suppress(OSError, msgspec.DecodeError, UnicodeDecodeError):
            if path.stat().st_size <= _LARGEST_JSON:
                found.append((msgspec.json.decode(path.read_bytes(), type=Incident),
                              path.with_suffix(".mcap")))
    return found


def begin(folder: Path, documents: Documents) -> None:
    """Write the description of a run, or of a further part of it.

    Raises:
        OSError: it cannot be written.
    """
    path = folder / f"~{HEAD}"
    with path.open("wb") as file:
        BagWriter(file, documents).close()
    sync(path)
    path.replace(folder / HEAD)
    (folder / ENDED).unlink(missing_ok=True)


def end(folder: Path) -> None:
    """Mark a run as ended in order.

    Raises:
        OSError: the mark cannot be written.
    """
    (folder / ENDED).touch()


def settle(folder: Path, living: Collection[str] = ()) -> None:
    """Describe the end of each run of a system that was cut off; remove runs without incidents.

    A folder that cannot be written is left as it is.

    Args:
        folder: folder of the system.
        living: ids of runs that live although their folder may be unlocked.
    """
    for run in (path.parent for path in sorted(folder.glob(f"*/{HEAD}"))):
        with contextlib.suppress(OSError, BagError), _free(run, living) as is_free:
            if not is_free:
                continue
            if not (run / ENDED).exists():
                _describe_end(run)
                end(run)
            if next(run.glob("*.json"), None) is None:
                shutil.rmtree(run, ignore_errors=True)


def _describe_end(run: Path) -> None:
    """Describe the last seconds of a run as an incident, unless they belong to one.

    Raises:
        BagError: the description of the run cannot be read.
        OSError: the description cannot be written.
    """
    span = ring.span_of(run)
    if span.last_s < span.first_s:
        return
    known = _of_run(run)
    for incident in known:
        if incident.to_s > span.last_s + SLACK_S:
            describe(run, msgspec.structs.replace(
                incident, to_s=span.last_s, partial="the run was cut off"))
    if any(incident.to_s >= span.last_s for incident in known):
        return
    system = recorded_system(Summary(BagReader(run / HEAD)).files)[1].system
    from_s = max(span.first_s, span.last_s - (system.black_box or BlackBox()).before_s)
    at = ring.segments(run)[-1].stat().st_mtime
    describe(run, Incident(
        name=name_at(at), system=run.parent.name, run=run.name, at=iso(at),
        cause="the run was cut off", at_s=span.last_s, to_s=span.last_s,
        from_s=max([from_s, *(i.to_s for i in known if i.from_s <= from_s)])))


def is_over(folder: Path, incident: Incident) -> bool:
    """Return whether the black box has all messages of an incident, in the folder of its run."""
    return (folder / ENDED).exists() or ring.span_of(folder).last_s > incident.to_s


def write_recording(folder: Path, incident: Incident, path: Path) -> Incident:
    """Write the recording of an incident from the ring to a path; return its final description.

    Raises:
        BagError: the description of the run cannot be read.
        OSError: the recording cannot be written.
    """
    documents, views = _documents(folder)
    first_s, last_s = math.inf, -math.inf
    writer = BagWriter(path.open("wb"), documents, begin_s=incident.from_s, views=views,
                       time_zero_s=min(0.0, float(math.floor(incident.from_s))))
    try:
        for at_s, key, payload in ring.read(folder, incident.from_s, incident.to_s):
            writer.take(at_s, key, payload)
            first_s, last_s = min(first_s, at_s), max(last_s, at_s)
        partial = {incident.partial: None} if incident.partial else {}
        if first_s > incident.from_s + SLACK_S:
            partial["the ring began later"] = None
        if last_s < incident.to_s - SLACK_S:
            partial["the ring ended earlier"] = None
        done = msgspec.structs.replace(incident, partial=", ".join(partial))
        if first_s <= last_s:
            done = msgspec.structs.replace(done, from_s=first_s, to_s=last_s)
        writer.close({"ended": "the incident was over", "incident": done.name, "cause": done.cause,
                      "at_s": f"{done.at_s:.3f}", "at": done.at, "partial": done.partial})
    finally:
        writer.abandon()
    return done


def size(folder: Path) -> int:
    """Return the bytes of all runs of a system."""
    found = 0
    for path in folder.glob("*/*"):
        with contextlib.suppress(OSError):  # removed meanwhile
            found += path.stat().st_size
    return found


def drop_oldest(folder: Path, keep: Incident | None) -> bool:
    """Delete the oldest incident of a system, except one; return whether there was one.

    Args:
        folder: folder of the system.
        keep: the incident that stays.
    """
    for incident, path in incidents_in(folder):
        if keep is not None and incident.name == keep.name:
            continue
        path.unlink(missing_ok=True)
        path.with_suffix(".json").unlink(missing_ok=True)
        with contextlib.suppress(OSError), _free(path.parent, ()) as is_free:
            if is_free:
                keep_needed(Ring(path.parent), path.parent)
        return True
    return False


def keep_needed(kept: Ring, run: Path, from_s: float = math.inf) -> None:
    """Delete the segments of a run that no incident needs.

    Args:
        kept: ring of the run.
        run: its folder.
        from_s: simulated time from which all segments stay.
    """
    needed = [Span(incident.from_s, incident.to_s) for incident in _of_run(run)]
    needed.append(Span(from_s, math.inf))
    kept.keep(lambda span: any(
        span.first_s <= one.last_s and one.first_s <= span.last_s for one in needed))


def _of_run(run: Path) -> list[Incident]:
    return [incident for incident, _ in incidents_in(run.parent) if incident.run == run.name]


@contextlib.contextmanager
def _free(run: Path, living: Collection[str]) -> Iterator[bool]:
    """Lock the folder of a run while no black box uses it; yield whether it is locked here."""
    descriptor = None if run.name in living else lock(run)
    try:
        yield descriptor is not None
    finally:
        if descriptor is not None:
            os.close(descriptor)


def _documents(folder: Path) -> tuple[Documents, Views]:
    """Return the documents of a run from its description, and its views.

    Raises:
        BagError: it cannot be read.
    """
    head = Summary(BagReader(folder / HEAD))
    _, known = recorded_system(head.files)
    with contextlib.suppress(ValueError), tempfile.TemporaryDirectory() as restored:
        restore(head.files, Path(restored))
        known = msgspec.structs.replace(known, application=known.kind.restored(Path(restored)))
    return Documents({"rampart_version": "", **head.run}, tuple(head.files), known), known.views()
