"""The formats of the paper's authors: graph as JSON, missions as lines, area as an image.

    blagnac.graph      {"nodes": [{"id": "N1", "x": 24, "y": -62}], "edges": [["N1", "N2"]]}
    MISSION_A.miss     x=20,y=-57,taxi=1      one goal per line; taxi=0 is light verification
    blagnac_area.jpg   red pixels (R > 250) are prohibited

These files have no lights and no start pose: the robot starts at the graph's first node, facing
along its first edge.

The authors' images are JPEGs: within a block (8 pixels) of an edge the red value oscillates around
the threshold. The threshold alone would add teeth of more than a metre to the pavement, so in a
JPEG a pixel that is clearly red counts as red too. A median filter removes single pixels; islands
and holes of a few pixels are dropped. The area outside the image is prohibited.
"""

from __future__ import annotations

import io
import math
import re
import warnings
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import numpy.typing as npt
import shapely
from shapely.geometry import MultiPoint, MultiPolygon, Polygon

from rampart.actors.osmosis.airport import model
from rampart.actors.osmosis.airport.model import Airport, AirportError, Mission, Point, readable
from rampart.files.plain_text import shown
from rampart.files.reading import read_bytes, read_text

RED_THRESHOLD = 250
"""Pixels with R above this are prohibited (authors' code)."""

PLAINLY_RED = 128
"""In a JPEG, a pixel whose red exceeds green and blue by more than this is prohibited."""

SPECK_PIXELS = 12
"""Smaller islands and holes are compression noise."""

MAX_IMAGE_BYTES = 32 << 20
MAX_PIXELS = 1 << 24
"""4,096 x 4,096, at the authors' scale 790 m x 890 m. The authors' image has 0.6 million."""

MAX_RUNS = 100_000
"""Runs of pixels that make up the pavement, each in one row."""


COLUMNS_PER_M, ROWS_PER_M, LEFT_M, TOP_M = 5.2, 4.6, -80.0, 80.0
"""The authors' scale: column = 5.2 * (x + 80), row = 4.6 * (80 - y)."""


def allowed_area(path: Path) -> Any:
    """Return the area that is not red as a shapely (multi)polygon in `map`, m.

    Raises:
        AirportError: not an image, or entirely prohibited.
    """
    pixels, lossy = _decoded(path)
    prohibited = pixels[:, :, 0] > RED_THRESHOLD
    if lossy:
        others = pixels[:, :, 1:].max(axis=2)
        prohibited |= (pixels[:, :, 0] > others) & (pixels[:, :, 0] - others > PLAINLY_RED)
    allowed = _without_lone_pixels(~prohibited)
    if not allowed.any():
        raise AirportError(f"{path}: area image: entirely red: expected pavement that is not red")
    runs = _runs(allowed)
    if len(runs) > MAX_RUNS:
        raise AirportError(f"{path}: area image: pavement of more than {MAX_RUNS} runs of pixels: "
                           "expected straight edges without noise")
    area = shapely.unary_union(runs)
    pixel_m = max(1 / COLUMNS_PER_M, 1 / ROWS_PER_M)
    speck_m2 = SPECK_PIXELS / (COLUMNS_PER_M * ROWS_PER_M)
    return _without_specks(shapely.simplify(area, pixel_m).buffer(0), speck_m2)


def _decoded(path: Path) -> tuple[npt.NDArray[np.uint8], bool]:
    """Return the image as rows x columns x RGB, and whether its compression is lossy."""
    from PIL import Image  # noqa: PLC0415 few airports have an image

    with readable(path, "expected a smaller one", "area image"):
        data = read_bytes(path, MAX_IMAGE_BYTES)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about its size, which is checked here
            with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as image:
                columns, rows = image.size
                if columns * rows <= MAX_PIXELS:
                    return np.asarray(image.convert("RGB")), image.format != "PNG"
    except Image.DecompressionBombError:
        columns = rows = 0
    except Exception:  # decoders raise many kinds for damaged bytes
        raise AirportError(f"{path}: area image: unreadable: expected a JPEG or PNG") from None
    size = f"{columns} x {rows}" if columns else "far too many"
    raise AirportError(f"{path}: area image: {size} pixels: expected at most {MAX_PIXELS}")


def _without_lone_pixels(allowed: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Apply a 3 x 3 median filter."""
    padded = np.pad(allowed, 1, mode="edge").astype(np.int8)
    rows, columns = allowed.shape
    votes = sum(padded[i:i + rows, j:j + columns] for i in range(3) for j in range(3))
    return np.asarray(votes) >= 5


def _runs(allowed: npt.NDArray[np.bool_]) -> npt.NDArray[np.object_]:
    """Return a rectangle in `map` for each run of allowed pixels in a row."""
    steps = np.diff(np.pad(allowed, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    rows, begins = np.nonzero(steps == 1)
    _, ends = np.nonzero(steps == -1)
    x0, x1 = (LEFT_M + columns / COLUMNS_PER_M for columns in (begins, ends))
    y0, y1 = (TOP_M - row / ROWS_PER_M for row in (rows + 1, rows))
    return np.asarray(shapely.box(x0, y0, x1, y1))


def _without_specks(area: Any, speck_m2: float) -> Any:
    parts = []
    for part in shapely.get_parts(area):
        if part.area >= speck_m2:
            holes = [hole for hole in part.interiors if Polygon(hole).area >= speck_m2]
            parts.append(Polygon(part.exterior, holes))
    return parts[0] if len(parts) == 1 else MultiPolygon(parts)


IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png")
MAX_TEXT_BYTES = 1 << 20
"""Size of a graph or mission file; 5,000 nodes and 10,000 edges take half of it."""

Metres = Annotated[float, msgspec.Meta(ge=-model.MAX_NUMBER, le=model.MAX_NUMBER)]

_EXAMPLE = '{"nodes": [{"id": "N1", "x": 0, "y": 0}], "edges": [["N1", "N2"]]}'
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
    missions = [read_mission(path) for path in sorted(graph.parent.glob("*.miss"))]
    return Airport(graph.stem, nodes, edges, allowed,
                   model.StartPose(x_m, y_m, math.atan2(to_y - y_m, to_x - x_m)),
                   (model.Surface(graph.stem, "area", allowed),),
                   missions={mission.name: mission for mission in missions})


def images_beside(graph: Path) -> list[Path]:
    """Return the candidates for a graph's area image: those named after it, else all beside it."""
    images = sorted(p for p in graph.parent.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES)
    return [p for p in images if p.stem.startswith(graph.stem)] or images


def _reached_by(nodes: dict[str, Point], area: Any) -> Any:
    """Drop pavement without a node, such as marks at the image's edge."""
    at = MultiPoint(list(nodes.values()))
    parts = [part for part in shapely.get_parts(area) if part.intersects(at)]
    return MultiPolygon(parts) if parts else area


class _Node(msgspec.Struct):
    id: model.Name
    x: Metres
    y: Metres


class _Graph(msgspec.Struct):
    nodes: Annotated[list[_Node], msgspec.Meta(min_length=1)]
    edges: list[tuple[str, str]]


def read_graph(path: Path) -> tuple[dict[str, Point], tuple[tuple[str, str], ...]]:
    """Read nodes and edges of a `.graph` file.

    Raises:
        AirportError: not JSON, or an invalid node or edge.
    """
    try:
        graph = msgspec.json.decode(_text(path), type=_Graph)
    except (msgspec.DecodeError, RecursionError) as error:
        raise AirportError(f"{path}: {error}: expected a graph, {_EXAMPLE}") from None
    nodes = {node.id: (node.x, node.y) for node in graph.nodes}
    for name in model.repeated(node.id for node in graph.nodes):
        raise AirportError(f"{path}: nodes: {name!r}: duplicate id")
    for i, edge in enumerate(graph.edges):
        for end in edge:
            if end not in nodes:
                raise AirportError(
                    f"{path}: edges[{i}]: {end!r}: unknown node; expected one of nodes")
    return nodes, tuple(graph.edges)


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


def _number(text: str, where: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not abs(number) <= model.MAX_NUMBER:
        raise AirportError(f"{where}: {shown(text)}: must be a finite number of metres, within "
                           f"{model.MAX_NUMBER:,.0f} m of 0")
    return number


def _text(path: Path) -> str:
    with readable(path, "expected text"):
        return read_text(path, MAX_TEXT_BYTES)
