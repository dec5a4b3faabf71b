"""Loads airports and missions by name or file, in Rampart's format or the paper authors'."""

from __future__ import annotations

import dataclasses
import difflib
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import shapely

from rampart.actors.osmosis.airport import graph_format as foreign
from rampart.actors.osmosis.airport import toml_format
from rampart.actors.osmosis.airport.model import (
    GRAPH_REACH_M,
    Airport,
    AirportError,
    Mission,
    Problem,
    WorldTruth,
    readable,
    repeated,
)

MIN_EDGE_CLEARANCE_M = 0.5
"""Least distance of an edge to the prohibited area: half the robot's width, and a margin."""


def problems(airport: Airport) -> Iterator[Problem]:
    """Yield all problems; if the graph is broken, only its own, since later checks rely on it."""
    fundamental = list(_graph(airport))
    yield from fundamental
    if any(not found.tolerable for found in fundamental):
        return
    yield from _ground(airport)
    yield from _lights(airport)
    yield from _obstacles(airport)
    for mission in airport.missions.values():
        yield from mission_problems(mission, airport)


def _graph(airport: Airport) -> Iterator[Problem]:
    if not airport.nodes:
        yield Problem("nodes", "empty", "a graph needs at least one node")
    for i, (a, b) in enumerate(airport.edges):
        for name in (a, b):
            if name not in airport.nodes:
                yield Problem(f"edges[{i}]", repr(name), "unknown node; expected one of nodes")
        if a == b:
            yield Problem(f"edges[{i}]", f"{a!r} to {b!r}", "expected two different nodes")
    for pair in repeated(frozenset(edge) for edge in airport.edges if edge[0] != edge[1]):
        yield Problem("edges", " to ".join(sorted(pair)), "duplicate edge",
                      tolerable=True)


def _ground(airport: Airport) -> Iterator[Problem]:
    if airport.allowed.is_empty:
        yield Problem("surface", "empty", "the airport needs pavement to drive on")
        return
    start = airport.start
    if airport.prohibited_distance_m(start.x_m, start.y_m) <= 0:
        yield Problem("start", f"({start.x_m:g}, {start.y_m:g})",
                      "in the prohibited area; expected on the pavement", tolerable=True)
    off_m = airport.nearest_on_graph(start.x_m, start.y_m).distance_m
    if off_m > GRAPH_REACH_M:
        yield Problem("start", f"({start.x_m:g}, {start.y_m:g})",
                      f"{off_m:.1f} m from the graph; must be within {GRAPH_REACH_M:g} m")
    off = _off_pavement(airport, list(airport.nodes.values()))
    inside = [name for name, is_off in zip(airport.nodes, off, strict=True) if is_off]
    for name in inside:
        x_m, y_m = airport.nodes[name]
        yield Problem(f"nodes.{name}", f"({x_m:g}, {y_m:g})",
                      "in the prohibited area; expected on the pavement", tolerable=True)
    yield from _edges(airport, set(inside))


def _edges(airport: Airport, inside: set[str]) -> Iterator[Problem]:
    """Yield edges over or near the prohibited area, except those of the nodes `inside` it."""
    edges = [(i, *edge) for i, edge in enumerate(airport.edges) if not inside & {*edge}]
    lines = shapely.linestrings(
        np.reshape([(airport.nodes[a], airport.nodes[b]) for _, a, b in edges], (-1, 2, 2)))
    paved = shapely.covers(airport.allowed, lines)
    rings = shapely.get_rings(shapely.get_parts(airport.allowed))
    corners = [shapely.get_coordinates(ring) for ring in rings]
    sides = shapely.linestrings(np.concatenate(
        [np.stack([ring[:-1], ring[1:]], axis=1) for ring in corners]))
    _, clear_m = shapely.STRtree(sides).query_nearest(
        lines, all_matches=False, return_distance=True)
    for (i, a, b), is_paved, distance_m in zip(edges, paved, clear_m, strict=True):
        if not is_paved:
            yield Problem(f"edges[{i}]", f"{a} to {b}", "passes through the prohibited area; "
                          "expected pavement", tolerable=True)
        elif distance_m < MIN_EDGE_CLEARANCE_M:
            yield Problem(f"edges[{i}]", f"{a} to {b}", "too near to the prohibited area; expected "
                          f"at least {MIN_EDGE_CLEARANCE_M:g} m", tolerable=True)


def _off_pavement(airport: Airport, points: Sequence[tuple[float, float]]) -> list[bool]:
    """Return for each point whether it lies in the prohibited area or on its boundary."""
    x_m, y_m = np.reshape(points, (-1, 2)).T
    return [not paved for paved in shapely.contains_xy(airport.allowed, x_m, y_m).tolist()]


def _lights(airport: Airport) -> Iterator[Problem]:
    for name in repeated(light.name for light in airport.lights):
        yield Problem("row", repr(name), "duplicate name of a light")
    off = _off_pavement(airport, [(light.x_m, light.y_m) for light in airport.lights])
    for light, is_off in zip(airport.lights, off, strict=True):
        if is_off:
            yield Problem(f"row.{light.name}", f"({light.x_m:g}, {light.y_m:g})",
                          "off the pavement; expected on it", tolerable=True)


def _obstacles(airport: Airport) -> Iterator[Problem]:
    for name in repeated(preset.name for preset in airport.obstacles):
        yield Problem("obstacle", repr(name), "duplicate name of an obstacle")
    for preset in airport.obstacles:
        near_m = math.dist((preset.x_m, preset.y_m), (airport.start.x_m, airport.start.y_m))
        if preset.appears_within_m is None and near_m < preset.radius_m + 0.5:
            yield Problem(f"obstacle.{preset.name}", f"({preset.x_m:g}, {preset.y_m:g})",
                          "on the start pose; expected at least 0.5 m beside it")


def mission_problems(mission: Mission, airport: Airport) -> Iterator[Problem]:
    """Yield the problems of a mission at an airport with a sound graph."""
    where = f"missions.{mission.name}"
    if not mission.goals:
        yield Problem(where, "empty", "a mission needs at least one goal")
    off = _off_pavement(airport, [(goal.x_m, goal.y_m) for goal in mission.goals])
    for i, goal in enumerate(mission.goals):
        at = f"({goal.x_m:g}, {goal.y_m:g})"
        spot = f"{where}.goals[{i}]"
        nearest = airport.nearest_on_graph(goal.x_m, goal.y_m)
        if nearest.distance_m > GRAPH_REACH_M:
            yield Problem(spot, at, f"{nearest.distance_m:.1f} m from the graph; a mission point "
                          f"must be within {GRAPH_REACH_M:g} m of it")
        elif nearest.a not in airport.within_reach:
            yield Problem(spot, at, "not connected to the start; expected a connected graph")
        if off[i]:
            yield Problem(spot, at, "in the prohibited area; expected on the pavement",
                          tolerable=True)


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
