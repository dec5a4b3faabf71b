"""The formats of the paper's authors: graph as JSON, missions as lines, area as an image.

    blagnac.graph      {"nodes": [{"id": "N1", "x": 24, "y": -62}], "edges": [["N1", "N2"]]}
    MISSION_A.miss     x=20,y=-57,taxi=1      one goal per line; taxi=0 is light verification
    blagnac_area.jpg   red pixels (R > 250) are prohibited (`airport.mask`)

These files have no lights and no start pose: the robot starts at the graph's first node, facing
along its first edge.
"""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import shapely
from shapely.geometry import MultiPoint, MultiPolygon

from rampart.actors.osmosis.airport import model
from rampart.actors.osmosis.airport.errors import AirportError, readable
from rampart.actors.osmosis.airport.mask import allowed_area
from rampart.actors.osmosis.airport.model import Airport, Mission, Point
from rampart.files.plain_text import shown
from rampart.files.reading import read_text

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
MAX_TEXT_BYTES = 1 << 20
"""Size of a graph or mission file; 5,000 nodes and 10,000 edges take half of it."""

_FIELD = re.compile(r"\s*(x|y|taxi)\s*=\s*(\S+)\s*")


def read_airport(graph: Path) -> Airport:
    """Read a `.graph` file with the area image and the missions beside it.

    Raises:
        AirportError: a file is missing or malformed.
    """
    nodes, edges = read_graph(graph)
    images = images_beside(graph)
    if len(images) != 1:
        listed = ", ".join(p.name for p in images) or "none"
        raise AirportError(
            f"{graph}: area image: {listed}: expected exactly one, {graph.stem}_area.jpg or .png")
    allowed = _reached_by(nodes, allowed_area(images[0]))
    first = next(iter(nodes))
    second = next((b if a == first else a for a, b in edges if first in (a, b)), first)
    (x_m, y_m), (to_x, to_y) = nodes[first], nodes[second]
    missions: dict[str, Mission] = {}
    for path in sorted(graph.parent.glob("*.miss")):
        mission = read_mission(path)
        if mission.name in missions:
            raise AirportError(f"{path}: mission name: {mission.name!r}: duplicate name")
        missions[mission.name] = mission
    return Airport(graph.stem, nodes, edges, allowed,
                   model.StartPose(x_m, y_m, math.atan2(to_y - y_m, to_x - x_m)),
                   (model.Surface(graph.stem, "area", allowed),), missions=missions)


def images_beside(graph: Path) -> list[Path]:
    """Return the candidates for a graph's area image: those named after it, else all beside it."""
    images = sorted(p for p in graph.parent.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES)
    return [p for p in images if p.stem.startswith(graph.stem)] or images


def _reached_by(nodes: dict[str, Point], area: Any) -> Any:
    """Drop pavement without a node, such as marks at the image's edge."""
    at = MultiPoint(list(nodes.values()))
    parts = [part for part in shapely.get_parts(area) if part.intersects(at)]
    return MultiPolygon(parts) if parts else area


def read_graph(path: Path) -> tuple[dict[str, Point], tuple[tuple[str, str], ...]]:
    """Read nodes and edges of a `.graph` file.

    Raises:
        AirportError: not JSON, or an invalid node or edge.
    """
    try:
        table = json.loads(_text(path))
    except (ValueError, RecursionError) as error:  # a number of thousands of digits; nesting
        raise AirportError(f"{path}: not JSON: {error}: expected a graph") from None
    if not isinstance(table, dict) or not all(
            isinstance(table.get(key), list) for key in ("nodes", "edges")):
        raise AirportError(f"{path}: file: {shown(table)}: expected the lists nodes and edges")
    nodes: dict[str, Point] = {}
    for i, entry in enumerate(table["nodes"]):
        name, at = _node(entry, f"{path}: nodes[{i}]")
        if name in nodes:
            raise AirportError(f"{path}: nodes[{i}].id: {name!r}: duplicate id")
        nodes[name] = at
    edges = []
    for i, entry in enumerate(table["edges"]):
        if not (isinstance(entry, list) and len(entry) == 2
                and all(isinstance(end, str) for end in entry)):
            raise AirportError(f'{path}: edges[{i}]: {shown(entry)}: expected ["N1", "N2"]')
        for end in entry:
            if end not in nodes:
                raise AirportError(f"{path}: edges[{i}]: {end!r}: unknown node; expected one of "
                                   "nodes")
        edges.append((entry[0], entry[1]))
    if not nodes:
        raise AirportError(f"{path}: nodes: empty: a graph needs at least one node")
    return nodes, tuple(edges)


def read_mission(path: Path) -> Mission:
    """Read a mission file; `MISSION_A.miss` is mission "A".

    Raises:
        AirportError: an invalid line, or no goals.
    """
    goals = []
    for number, line in enumerate(_text(path).splitlines(), start=1):
        if line.strip():
            goals.append(_goal(line, f"{path}: line {number}"))
    if not goals:
        raise AirportError(f"{path}: goals: empty: expected lines such as x=20,y=-57,taxi=1")
    return Mission(path.stem.removeprefix("MISSION_"), tuple(goals))


def _goal(line: str, where: str) -> model.MissionGoal:
    found = [_FIELD.fullmatch(part) for part in line.split(",")]
    fields = {match.group(1): match.group(2) for match in found if match}
    if len(found) != 3 or fields.keys() != {"x", "y", "taxi"}:
        raise AirportError(f"{where}: {shown(line.strip())}: expected x=20,y=-57,taxi=1")
    if fields["taxi"] not in ("0", "1"):
        raise AirportError(f"{where}: taxi={fields['taxi'][:20]}: expected 1 (taxi) or 0 "
                           "(light verification)")
    x_m, y_m = (_number(fields[axis], f"{where}: {axis}") for axis in ("x", "y"))
    return model.MissionGoal(x_m, y_m, "taxi" if fields["taxi"] == "1" else "light verification")


def _node(entry: Any, where: str) -> tuple[str, Point]:
    if not (isinstance(entry, dict) and isinstance(entry.get("id"), str)):
        raise AirportError(f'{where}: {shown(entry)}: expected {{"id": "N1", "x": 0, "y": 0}}')
    name = entry["id"]
    if not name.isprintable() or len(name) > model.MAX_NAME:
        raise AirportError(f"{where}.id: {shown(name)}: expected at most "
                           f"{model.MAX_NAME} printable characters")
    return name, (_number(entry.get("x"), f"{where}.x"), _number(entry.get("y"), f"{where}.y"))


def _number(value: Any, where: str) -> float:
    try:
        if isinstance(value, bool):
            raise TypeError
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise AirportError(f"{where}: {shown(value)}: must be a finite number of metres")
    if abs(number) > model.MAX_NUMBER:
        raise AirportError(
            f"{where}: {shown(value)}: must be within {model.MAX_NUMBER:,.0f} m of 0")
    return number


def _text(path: Path) -> str:
    with readable(path, "expected text"):
        return read_text(path, MAX_TEXT_BYTES)
