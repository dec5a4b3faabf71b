"""What a recording keeps of its run, so that a replay needs nothing else: plan, system, files."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping, Sequence
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
from rampart.actors.system.topics import own_topics
from rampart.files import working_folder
from rampart.files.reading import FileError, read_bytes
from rampart.manager.spec.specification import SystemSpec

FORMAT = "1"
SYSTEM = "system.toml"

_MEDIA = {".toml": "application/toml", ".graph": "application/json", ".png": "image/png",
          ".jpg": "image/jpeg", ".jpeg": "image/jpeg"}
MAX_FILE_BYTES = 64 << 20

File = tuple[str, str, bytes]
"""Name in the recording, media type, content."""


class Known(msgspec.Struct, frozen=True):
    """What could be loaded of a run: a viewer or recorder makes do without the rest.

    Attributes:
        system: its spec.
        kind: class of its application.
        application: of the run; None if an option of it cannot be had.
    """

    system: SystemSpec = NO_SYSTEM
    kind: type[Application] = Application
    application: Application | None = None

    @property
    def topics(self) -> tuple[Topic[Any], ...]:
        """The topics of the engine and of the application."""
        return (*topics.ALL, *self.kind.topics)

    def views(self) -> Views:
        """Return what translates the run for viewers."""
        return import_class(self.kind.views, Views, "views")(self.application, self.system)


class Documents(msgspec.Struct, frozen=True):
    """What was run.

    Attributes:
        run_id: unique name of the run.
        title: for people.
        rate: simulated seconds per second.
        nodes: names of the nodes.
        plan: the run's plan (`RunPlan.description`), as plain data.
        started: wall time at which the recording began, ISO 8601; empty in virtual time.
        files: system, and what the application names, as files.
        version: of the program.
        known: system and application.
        own: topics that the system's actors declare themselves.
    """

    run_id: str
    title: str
    rate: float
    nodes: tuple[str, ...]
    plan: Mapping[str, Any]
    started: str
    files: tuple[File, ...] = ()
    version: str = ""
    known: Known = Known()
    own: tuple[Topic[Any], ...] = ()

    def metadata(self) -> dict[str, str]:
        """Return what stands in the metadata record; of a file that was chosen its name."""
        chosen = self.known.application.options if self.known.application else None
        options = {**self.plan, **(msgspec.structs.asdict(chosen) if chosen else {})}
        told = {name: PurePosixPath(str(value)).name or str(value)
                for name, value in options.items() if name != "system_file"}
        return {**told, "format": FORMAT, "run_id": self.run_id, "title": self.title,
                "rate": f"{self.rate:g}", "started": self.started,
                "rampart_version": self.version, "nodes": json.dumps(self.nodes)}


NOT_CHOSEN = ("format", "run_id", "title", "rate", "started", "rampart_version", "nodes",
              "time_zero_s")
"""What stands in the metadata record besides the choices of the plan."""


def collect(plan: Mapping[str, Any], **described: Any) -> Documents:
    """Return the documents of a run, with the files that belong to it.

    A file that cannot be read is left out: the messages are what counts.

    Args:
        plan: as plain data.
        described: the other attributes of `Documents`.
    """
    system_file = Path(str(plan.get("system_file", "")))
    working_folder.admit(system_file.parent)
    known = known_of(plan)
    own: tuple[Topic[Any], ...] = ()
    with contextlib.suppress(ValueError):  # an actor whose module is missing
        own = own_topics(known.system)
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
    return Documents(plan=plan, files=tuple(files), version=own_version, known=known, own=own,
                     **described)


def known_of(plan: Mapping[str, Any]) -> Known:
    """Return system and application of a run, as far as they can be loaded.

    Args:
        plan: as plain data.
    """
    system, kind = NO_SYSTEM, Application
    try:
        run = RunPlan(system_file=str(plan.get("system_file", "")))
        system = load_system(run)
        kind = application_class(system)
        options = {field.name: msgspec.convert(plan[field.name], field.type, strict=False)
                   for field in msgspec.structs.fields(kind.Options)
                   if plan.get(field.name, "") != ""}
        return Known(system, kind, load_application(
            msgspec.structs.replace(run, options=options), system))
    except (OSError, ValueError):
        return Known(system, kind)


def restore(files: Sequence[File], directory: Path) -> None:
    """Write the files of a run's application into a directory, each into a folder there.

    Names that would lead out of the directory are not followed.
    """
    for name, _media, data in files:
        parts = PurePosixPath(name).parts
        if len(parts) != 2 or "/".join(parts) != name or ".." in parts:
            continue
        path = directory.joinpath(*parts)
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(data)
