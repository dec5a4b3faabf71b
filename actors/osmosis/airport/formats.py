"""Loads airports and missions by name or file, in Rampart's format or the paper authors'."""

from __future__ import annotations

import dataclasses
import difflib
from pathlib import Path

from rampart.actors.osmosis.airport import graph_format as foreign
from rampart.actors.osmosis.airport import toml_format
from rampart.actors.osmosis.airport.checks import mission_problems, problems
from rampart.actors.osmosis.airport.errors import AirportError, readable
from rampart.actors.osmosis.airport.model import Airport, Mission, WorldTruth

SHIPPED = Path(__file__).resolve().parents[3] / "systems" / "airports"
"""Folder of the shipped airports."""

MAX_WARNINGS = 50
"""Most warnings about one file."""


def shipped_airports() -> tuple[str, ...]:
    """Return the names of the shipped airports."""
    return tuple(sorted(path.stem for path in SHIPPED.glob("*.toml")))


def load_airport(name_or_path: str | Path) -> Airport:
    """Load and check an airport.

    Args:
        name_or_path: a shipped name, a `.toml` file, a `.graph` file with its image beside it,
            or a folder that holds one `.toml` or one `.graph`.

    Returns:
        The airport; in the authors' formats, tolerable problems become its `warnings`.

    Raises:
        AirportError: one line with file, field, value and what is expected.
    """
    return load_with_truth(name_or_path)[0]


def load_mission(name_or_path: str | Path, airport: Airport) -> Mission:
    """Load a mission and check it at `airport`.

    Args:
        name_or_path: a mission of the airport, or a `.miss` or `.toml` file.
        airport: where the robot drives it.

    Raises:
        AirportError: as `load_airport`.
    """
    text, path = str(name_or_path), Path(name_or_path)
    readers = {".miss": foreign.read_mission, ".toml": toml_format.read_mission}
    if text in airport.missions or path.suffix not in readers:
        return airport.mission(text)
    mission = readers[path.suffix](path)
    for problem in mission_problems(mission, airport):
        raise AirportError(problem.line(str(path)))
    return mission


def files_of(source: Path) -> list[Path]:
    """Return the files of an airport: `source`, and the images and missions beside a graph."""
    if source.suffix != ".graph":
        return [source]
    return [source, *sorted([*foreign.images_beside(source), *source.parent.glob("*.miss")])]


def load_with_truth(name_or_path: str | Path) -> tuple[Airport, WorldTruth]:
    """Load an airport, and for the simulator the real intensities of its lights.

    Raises:
        AirportError: as `load_airport`.
    """
    with readable(name_or_path, "expected an existing file"):
        path = _find(name_or_path)
        own = path.suffix == ".toml"
        airport, truth = toml_format.read_airport(path) if own else (
            foreign.read_airport(path), WorldTruth())
    warnings = []
    for problem in problems(airport):
        if own or not problem.tolerable:
            raise AirportError(problem.line(str(path)))
        warnings.append(problem.line(path.name))
    if len(warnings) > MAX_WARNINGS:
        warnings[MAX_WARNINGS:] = [
            f"{path.name}: {len(warnings) - MAX_WARNINGS} more warnings"]
    if not airport.lights:
        warnings.append(f"{path.name}: lights: none: there is nothing to inspect")
    return dataclasses.replace(airport, warnings=tuple(warnings), source=str(path)), truth


def _find(name_or_path: str | Path) -> Path:
    text = str(name_or_path)
    if text in shipped_airports():
        return SHIPPED / f"{text}.toml"
    path = Path(name_or_path)
    if path.is_dir():
        found = sorted([*path.glob("*.toml"), *path.glob("*.graph")])
        if len(found) != 1:
            listed = ", ".join(p.name for p in found) or "none"
            raise AirportError(
                f"{path}: airport file: {listed}: expected exactly one .toml or .graph")
        return found[0]
    if path.suffix in (".toml", ".graph"):
        if not path.is_file():
            raise AirportError(f"{path}: file: missing: expected an existing file")
        return path
    known = shipped_airports()
    near = difflib.get_close_matches(text, known, n=1)
    hint = f"did you mean {near[0]!r}?" if near else f"shipped: {', '.join(known)}"
    raise AirportError(f"{text}: airport: unknown name, folder, .toml or .graph: {hint}")
