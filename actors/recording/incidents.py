"""Incidents: what happened around a decision or a failed process, kept as recordings.

The folder of a system has one folder for each run:

    head.mcap       description of the run: specification, files, versions, options
    NUMBER.ring     the last minutes (`ring`), while the run lives
    NAME.json       description of an incident (`Incident`)
    NAME.mcap       its recording, once it is over

The black box locks the folder of its run (flock(2)). A ring in an unlocked folder is from a run
that was cut off: `recover` writes the recordings from it.
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
from typing import Any

import msgspec

from rampart.actors.bus.topic import Topic
from rampart.actors.recording import ring
from rampart.actors.recording.bag_reader import BagReader, Summary
from rampart.actors.recording.bag_writer import BagError, BagWriter
from rampart.actors.recording.run_documents import (
    NOT_CHOSEN,
    Documents,
    File,
    recorded_system,
    restore,
)
from rampart.actors.recording.views import Views
from rampart.actors.system.topics import own_topics
from rampart.manager.spec.tables import BlackBox

HEAD = "head.mcap"

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
        checkpoints: state of each node at the begin, by file name; in the recording once it is
            written.
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
    checkpoints: dict[str, bytes] = {}


def state_folder(system: str) -> Path:
    """Return the folder of a system's incidents and history; it may not exist."""
    home = os.environ.get("XDG_STATE_HOME", "")
    return Path(home if home.startswith("/") else Path.home() / ".local/state", "rampart", system)


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
    path = folder / f"{incident.name}.json"
    with tempfile.NamedTemporaryFile(dir=folder, prefix=".", delete=False) as file:
        try:
            file.write(msgspec.json.format(msgspec.json.encode(incident)))
            file.flush()
            os.fsync(file.fileno())
            Path(file.name).replace(path)
        except BaseException:
            Path(file.name).unlink(missing_ok=True)
            raise


def incidents_in(folder: Path) -> list[tuple[Incident, Path]]:
    """Return the incidents of a system, oldest first, each with the path of its recording.

    The recording of an incident that is not over does not exist yet. Damaged descriptions are left
    out.
    """
    found = []
    for path in sorted(folder.glob("*/*.json"), key=lambda path: path.name):
        with contextlib.suppress(OSError, msgspec.DecodeError, UnicodeDecodeError):
            if path.stat().st_size <= _LARGEST_JSON:
                found.append((msgspec.json.decode(path.read_bytes(), type=Incident),
                              path.with_suffix(".mcap")))
    return found


def write_head(folder: Path, documents: Documents) -> None:
    """Write the description of a run.

    Raises:
        OSError: it cannot be written.
    """
    path = folder / f"~{HEAD}"
    with path.open("wb") as file:
        BagWriter(file, documents).close()
    with path.open("rb") as file:
        os.fsync(file.fileno())
    path.replace(folder / HEAD)


def record(folder: Path, incident: Incident) -> None:
    """Write the recording and the final description of an incident.

    Args:
        folder: folder of its run.
        incident: its description.

    Raises:
        BagError: the description of the run cannot be read.
        OSError: the recording cannot be written.
    """
    path = folder / f"~{incident.name}.mcap"
    try:
        done = write_recording(folder, incident, path)
        with path.open("rb") as file:
            os.fsync(file.fileno())
        path.replace(folder / f"{incident.name}.mcap")
    finally:
        path.unlink(missing_ok=True)
    describe(folder, done)


def write_recording(folder: Path, incident: Incident, path: Path) -> Incident:
    """Write the recording of an incident from the ring to a path; return its final description.

    Raises:
        BagError: the description of the run cannot be read.
        OSError: the recording cannot be written.
    """
    documents, views = _documents(folder, incident.checkpoints)
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
        done = msgspec.structs.replace(incident, checkpoints={}, partial=", ".join(partial))
        if first_s <= last_s:
            done = msgspec.structs.replace(done, from_s=first_s, to_s=last_s)
        writer.close({"ended": "the incident was over", "incident": done.name, "cause": done.cause,
                      "at_s": f"{done.at_s:.3f}", "at": done.at, "partial": done.partial})
    finally:
        writer.abandon()
    return done


def recover(folder: Path, living: Collection[str] = ()) -> None:
    """Write the incidents of the runs of a system that were cut off.

    A folder that cannot be written is left as it is.

    Args:
        folder: folder of the system.
        living: ids of runs that live although their folder may be unlocked.
    """
    for run in _runs(folder):
        descriptor = None
        with contextlib.suppress(OSError, BagError):
            if run.name in living or (descriptor := lock(run)) is None:
                continue
            _recover_run(folder.name, run)
        if descriptor is not None:
            os.close(descriptor)


def _recover_run(name: str, run: Path) -> None:
    ends = ring.ends(run)
    system = recorded_system(Summary(BagReader(run / HEAD)).files)[1].system
    before_s = (system.black_box or BlackBox()).before_s
    known = [incident for incident, _ in incidents_in(run.parent) if incident.run == run.name]
    if ends is not None:
        from_s, to_s = max(ends[0], ends[1] - before_s), ends[1]
        if not any(incident.to_s >= to_s for incident in known):
            from_s = max([from_s, *(i.to_s for i in known if i.from_s <= from_s)])
            last = ring.segments(run)[-1].stat().st_mtime
            incident = Incident(
                name=name_at(last), system=name, run=run.name,
                at=iso(last),
                cause="the run was cut off", at_s=to_s, from_s=from_s, to_s=to_s)
            describe(run, incident)
            known.append(incident)
    for incident in known:
        if not (run / f"{incident.name}.mcap").exists() and ends is not None:
            record(run, msgspec.structs.replace(
                incident, partial=incident.partial or (
                    "the run was cut off" if incident.to_s > ends[1] + SLACK_S else "")))
    for path in (*ring.segments(run), *run.glob("~*"), *run.glob(".tmp*")):
        path.unlink(missing_ok=True)


def size(folder: Path) -> int:
    """Return the bytes of all runs of a system."""
    found = 0
    for path in folder.glob("*/*"):
        with contextlib.suppress(OSError):  # removed meanwhile
            found += path.stat().st_size
    return found


def drop_oldest(folder: Path, keep: Collection[str]) -> bool:
    """Delete the oldest incident of a system, except some; return whether there was one.

    Args:
        folder: folder of the system.
        keep: names of incidents that stay.
    """
    for incident, path in incidents_in(folder):
        if incident.name not in keep:
            path.unlink(missing_ok=True)
            path.with_suffix(".json").unlink(missing_ok=True)
            return True
    return False


def remove_empty(folder: Path) -> None:
    """Remove the folders of ended runs that have no incident."""
    for run in _runs(folder):
        with contextlib.suppress(OSError):
            if next(run.glob("*.json"), None) is None and (descriptor := lock(run)) is not None:
                shutil.rmtree(run, ignore_errors=True)
                os.close(descriptor)


def _runs(folder: Path) -> Iterator[Path]:
    return (path.parent for path in sorted(folder.glob(f"*/{HEAD}")))


def _documents(folder: Path, checkpoints: dict[str, bytes]) -> tuple[Documents, Views]:
    """Return the documents of a run from its description, and its views.

    Raises:
        BagError: it cannot be read.
    """
    head = Summary(BagReader(folder / HEAD))
    _, known = recorded_system(head.files)
    own: tuple[Topic[Any], ...] = ()
    with contextlib.suppress(ValueError), tempfile.TemporaryDirectory() as restored:
        restore(head.files, Path(restored))
        known = msgspec.structs.replace(known, application=known.kind.restored(Path(restored)))
    with contextlib.suppress(ValueError):  # an actor whose module is missing
        own = own_topics(known.system)
    files: list[File] = [*head.files, *(
        (f"checkpoints/{name}", "application/octet-stream", data)
        for name, data in checkpoints.items())]
    run = head.run
    try:
        nodes = msgspec.json.decode(run.get("nodes", "[]"), type=tuple[str, ...])
        rate = float(run.get("rate", "1"))
    except ValueError as error:
        raise BagError(f"{folder / HEAD}: {error}") from None
    plan = {name: value for name, value in run.items() if name not in NOT_CHOSEN}
    plain = msgspec.structs.replace(known, application=None)  # its options are in the plan
    return Documents(
        run_id=run.get("run_id", ""), title=run.get("title", ""), rate=rate, nodes=nodes, plan=plan,
        started=run.get("started", ""), files=tuple(files), version=run.get("rampart_version", ""),
        known=plain, own=own), known.views()
