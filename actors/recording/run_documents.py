"""Plan, system and files of a run in its recording, so that a replay needs nothing else."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path, PurePosixPath
from typing import Any

import msgspec

from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import topics
from rampart.actors.recording.views import Views
from rampart.actors.runtime.application import Application
from rampart.actors.runtime.run_context import NO_SYSTEM
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.system.members import application_class, import_class, load_application
from rampart.files import working_folder
from rampart.files.reading import FileError, read_bytes
from rampart.manager.spec.specification import SystemSpec, check_document, read_document

FORMAT = "1"
SYSTEM = "system.toml"

_MEDIA = {".toml": "application/toml", ".graph": "application/json", ".png": "image/png",
          ".jpg": "image/jpeg", ".jpeg": "image/jpeg"}
MAX_FILE_BYTES = 64 << 20

File = tuple[str, str, bytes]
"""Name in the recording, media type, content."""


class RunContents(msgspec.Struct, frozen=True):
    """System and application of a run, as far as they can be loaded.

    Attributes:
        system: the specification.
        kind: class of the application.
        application: of the run; None if it cannot be loaded.
    """

    system: SystemSpec = NO_SYSTEM
    kind: type[Application] = Application
    application: Application | None = None

    @property
    def topics(self) -> tuple[Topic[Any], ...]:
        """The topics of the engine and of the application."""
        return (*topics.ALL, *self.kind.topics)

    def views(self) -> Views:
        """Return the translation of the run for viewers."""
        return import_class(self.kind.views, Views, "views")(self.application, self.system)


class Documents(msgspec.Struct, frozen=True):
    """Description of a run in its recording.

    Attributes:
        run: metadata record; of an option with a path it has the name of the file only.
        files: the system, and files that the application names.
        known: system and application.
    """

    run: dict[str, str]
    files: tuple[File, ...] = ()
    known: RunContents = RunContents()

    @property
    def run_id(self) -> str:
        """Unique name of the run."""
        return self.run["run_id"]


NOT_CHOSEN = ("format", "run_id", "title", "rate", "started", "rampart_version", "nodes",
              "time_zero_s")
"""Fields of the metadata record that are not options of the plan."""


def collect(plan: Mapping[str, Any], *, run_id: str, title: str, rate: float,
            nodes: Sequence[str], started: str) -> Documents:
    """Return the documents of a run with its files; files that cannot be read are left out.

    Args:
        plan: plan of the run (`RunPlan.description`), as plain data.
        run_id: unique name of the run.
        title: title for people.
        rate: simulated seconds per real second.
        nodes: names of the nodes.
        started: wall time at which the recording began, ISO 8601; empty in virtual time.
    """
    system_file = Path(str(plan.get("system_file", "")))
    working_folder.admit(system_file.parent)
    known = known_of(plan)
    paths = [(SYSTEM, system_file)]
    with contextlib.suppress(OSError):  # a folder that cannot be listed
        paths += known.application.documents() if known.application else []
    files: list[File] = []
    for name, path in paths:
        try:
            data = read_bytes(path, MAX_FILE_BYTES)
        except (OSError, FileError):
            continue
        files.append((name, _MEDIA.get(path.suffix.lower(), "text/plain"), data))
    try:
        own_version = version("rampart-robot")
    except PackageNotFoundError:
        own_version = "unknown"
    chosen = msgspec.structs.asdict(known.application.options) if known.application else {}
    options = {name: PurePosixPath(str(value)).name or str(value)
               for name, value in {**plan, **chosen}.items() if name != "system_file"}
    return Documents({
        **options, "format": FORMAT, "run_id": run_id, "title": title, "rate": f"{rate:g}",
        "started": started, "rampart_version": own_version, "nodes": json.dumps(nodes),
    }, tuple(files), known)


def known_of(plan: Mapping[str, Any]) -> RunContents:
    """Return system and application of a run, as far as they can be loaded.

    Args:
        plan: plan of the run, as plain data.
    """
    system, kind = NO_SYSTEM, Application
    try:
        run = RunPlan(system_file=str(plan.get("system_file", "")))
        system = load_system(run)
        kind = application_class(system)
        options = {field.name: msgspec.convert(plan[field.name], field.type, strict=False)
                   for field in msgspec.structs.fields(kind.Options)
                   if plan.get(field.name, "") != ""}
        return RunContents(system, kind, load_application(
            msgspec.structs.replace(run, options=options), system))
    except (OSError, ValueError):
        return RunContents(system, kind)


def recorded_system(files: Iterable[File]) -> tuple[dict[str, Any], RunContents]:
    """Return the specification of a recording and its system, as far as they can be read.

    Args:
        files: those attached to the recording.
    """
    document: dict[str, Any] = {}
    found = NO_SYSTEM
    with contextlib.suppress(StopIteration, ValueError):
        text = next(data for name, _, data in files if name == SYSTEM).decode()
        document = read_document(text, SYSTEM)
        found = check_document(document, SYSTEM)
    try:
        return document, RunContents(found, application_class(found))
    except ValueError:  # an application that is not installed here
        return document, RunContents(found)


def restore(files: Sequence[File], directory: Path) -> None:
    """Write the files of a run's application into folders of a directory.

    A name that would lead out of the directory is ignored.
    """
    for name, _media, data in files:
        parts = PurePosixPath(name).parts
        if len(parts) != 2 or "/".join(parts) != name or ".." in parts:
            continue
        path = directory.joinpath(*parts)
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(data)
