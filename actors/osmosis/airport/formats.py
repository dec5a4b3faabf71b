"""Loads airports and missions by name or file, in our own format or the paper authors'."""

from __future__ import annotations

import dataclasses
import difflib
from pathlib import Path

from rampart.actors.osmosis.airport import graph_format as foreign
from rampart.actors.osmosis.airport import toml_format
from rampart.actors.osmosis.airport.checks import mission_problems, problems
from rampart.actors.osmosis.airport.errors import AirportError, readable
from rampart.actors.osmosis.airport.limits import MAX_WARNINGS
from rampart.actors.osmosis.airport.mask import MaskScale
from rampart.actors.osmosis.airport.model import Airport, Mission
from rampart.actors.osmosis.airport.world import WorldTruth

SHIPPED = Path(__file__).resolve().parents[3] / "systems" / "airports"
"""Folder of the shipped airports."""


def shipped_airports() -> tuple[str, ...]:
    """Return the names of the shipped airports."""
    return tuple(sorted(path.stem for path in SHIPPED.glob("*.toml")))


def load_airport(name_or_path: str | Path, scale: MaskScale | None = None) -> Airport:
    """Load and check an airport.

    Args:
        name_or_path: a shipped name, a `.toml` file, a `.graph` file with its image beside it,
            or a folder that holds one `.toml` or one `.graph`.
        scale: pixels to metres of an area image; default the authors'.

    Returns:
        The airport; for the authors' formats with `warnings` about what was tolerated.

    Raises:
        AirportError: one line that names file, field, value and what would be right.
    """
    return load_with_truth(name_or_path, scale)[0]


def load_mission(name_or_path: str | Path, airport: Airport) -> Mission:
    """Load a mission and check that it can be driven at `airport`.

    Args:
        name_or_path: a mission of the airport, or a `.miss` or `.toml` file.
        airport: where it is to be driven.

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
    """Return all files that an airport is read from: itself, and of a graph what lies beside it.

    Args:
        source: the airport's file.
    """
    if source.suffix != ".graph":
        return [source]
    return [source, *sorted([*foreign.images_beside(source), *source.parent.glob("*.miss")])]


def load_with_truth(name_or_path: str | Path,
                    scale: MaskScale | None = None) -> tuple[Airport, WorldTruth]:
    """Load an airport as `load_airport`, and the truth about its lights, for the simulator only.

    Raises:
        AirportError: as `load_airport`.
    """
    with readable(name_or_path, "give a file that exists"):
        path = _find(name_or_path)
        own = path.suffix == ".toml"
        airport, truth = toml_format.read_airport(path) if own else (
            foreign.read_airport(path, scale), WorldTruth())
    warnings = []
    for problem in problems(airport):
        if own or not problem.tolerable:
            raise AirportError(problem.line(str(path)))
        warnings.append(problem.line(path.name))
    if len(warnings) > MAX_WARNINGS:
        warnings[MAX_WARNINGS:] = [
            f"{path.name}: and {len(warnings) - MAX_WARNINGS} more: mend these first"]
    if not airport.lights:
        warnings.append(f"{path.name}: lights: none: nothing will be measured")
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
            raise AirportError(f"{path}: airport file: {listed}: need exactly one .toml or .graph")
        return found[0]
    if path.suffix in (".toml", ".graph"):
        if not path.is_file():
            raise AirportError(f"{path}: file: missing: give a file that exists")
        return path
    known = shipped_airports()
    near = difflib.get_close_matches(text, known, n=1)
    hint = f"did you mean {near[0]!r}?" if near else f"shipped are: {', '.join(known)}"
    raise AirportError(f"{text}: airport: no such name, folder, .toml or .graph: {hint}")
