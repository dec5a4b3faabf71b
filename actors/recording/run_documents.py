"""What a recording keeps of its run, so that a replay needs nothing else: plan, system, airport."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path, PurePosixPath
from typing import Any

import msgspec

from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.airport.graph_format import IMAGE_SUFFIXES
from rampart.files import toml
from rampart.files.reading import FileError, read_bytes

FORMAT = "1"
SYSTEM = "system.toml"
AIRPORT = "airport/"
"""Directory of attachments with the airport's files."""

_MEDIA = {".toml": "application/toml", ".graph": "application/json", ".png": "image/png",
          ".jpg": "image/jpeg", ".jpeg": "image/jpeg"}
MAX_FILE_BYTES = 64 << 20

File = tuple[str, str, bytes]
"""Name in the recording, media type, content."""


class Documents(msgspec.Struct, frozen=True):
    """What was run.

    Attributes:
        run_id: unique name of the run.
        title: for people.
        rate: simulated seconds per second.
        nodes: names of the nodes.
        plan: the run's plan (`run_plan.RunPlan`), as plain data.
        started: wall time at which the recording began, ISO 8601; empty in virtual time.
        files: system, airport and mission as files.
        version: of the program.
    """

    run_id: str
    title: str
    rate: float
    nodes: tuple[str, ...]
    plan: Mapping[str, Any]
    started: str
    files: tuple[File, ...] = ()
    version: str = ""

    def metadata(self) -> dict[str, str]:
        """Return what stands in the metadata record."""
        told = {name: str(self.plan.get(name, "")) for name in (
            "airport", "mission", "strategy", "shadow", "seed", "obstacles", "ftm")}
        told["airport"], told["mission"] = (
            PurePosixPath(told[name]).name for name in ("airport", "mission"))
        return {
            "format": FORMAT, "run_id": self.run_id, "title": self.title,
            "rate": f"{self.rate:g}", "started": self.started, "rampart_version": self.version,
            "nodes": json.dumps(self.nodes), **told}


def collect(plan: Mapping[str, Any], **known: Any) -> Documents:
    """Return the documents of a run, with the files that its plan names.

    A file that cannot be read is left out: the messages are what counts.

    Args:
        plan: as plain data.
        known: the other attributes of `Documents`.
    """
    files: list[File] = []
    for name, path in _paths(plan):
        try:
            data = read_bytes(path, MAX_FILE_BYTES)
        except (OSError, FileError):
            continue
        files.append((name, _MEDIA.get(path.suffix.lower(), "text/plain"), data))
    return Documents(plan=plan, files=tuple(files), version=own_version(), **known)


def own_version() -> str:
    """Return the version of the installed program."""
    try:
        return version("rampart")
    except PackageNotFoundError:
        return "unknown"


def footprint_m(files: Sequence[File]) -> tuple[float, float] | None:
    """Return length and width of the robot that the system's file states, None if it does not."""
    for name, _media, data in files:
        if name == SYSTEM:
            try:
                robot = toml.parse(data.decode())["robot"]
                return float(robot["length_m"]), float(robot["width_m"])
            except (ValueError, KeyError, TypeError, OverflowError):
                return None
    return None


def restore(files: Sequence[File], directory: Path) -> Path | None:
    """Write the airport's files into a directory and return the one to load it from.

    Names that would lead out of the directory are not followed.
    """
    found: list[Path] = []
    for name, _media, data in files:
        short = PurePosixPath(name).name
        if name != f"{AIRPORT}{short}" or short in ("", ".", ".."):
            continue
        path = directory / short
        path.write_bytes(data)
        found.append(path)
    return next((p for suffix in (".toml", ".graph") for p in found if p.suffix == suffix), None)


def _airport_file(name: str) -> Path | None:
    try:
        return Path(load_airport(name).source) if name else None
    except (ValueError, OSError):
        return None


def _paths(plan: Mapping[str, Any]) -> list[tuple[str, Path]]:
    paths = [(SYSTEM, Path(str(plan.get("system_file", ""))))]
    source = _airport_file(str(plan.get("airport") or ""))
    if source is not None:
        beside = [source]
        if source.suffix == ".graph":
            beside += sorted(p for p in source.parent.iterdir()
                             if p.suffix.lower() in (*IMAGE_SUFFIXES, ".miss"))
            own = [p for p in beside if p.stem.startswith(source.stem)
                   and p.suffix.lower() in IMAGE_SUFFIXES]
            if own:  # as `rampart.actors.osmosis.airport.graph_format` chooses among several images
                beside = [p for p in beside
                          if p in own or p.suffix.lower() not in IMAGE_SUFFIXES]
        paths += [(f"{AIRPORT}{path.name}", path) for path in beside]
    mission = Path(str(plan.get("mission") or ""))
    if mission.suffix in (".miss", ".toml") and mission.is_file():
        paths.append((f"mission/{mission.name}", mission))
    return paths
