"""An airport as lines and rings to draw: for the operator's page and the inspection report.

Coordinates are in the `map` frame (metres, y north); the reader flips y. Pavement and prohibited
area are SVG path data, because only a path with holes can show a taxiway around a patch of grass.
"""

from __future__ import annotations

from typing import Any

import msgspec
import shapely

from rampart.actors.osmosis.airport.model import Airport, Light

FRAME_M = 4.0
"""Width of the prohibited strip drawn around the airport."""

_DECIMALS = 2


class AirportDrawing(msgspec.Struct, frozen=True):
    """The drawing of an airport.

    Args:
        name: name of the airport.
        bounds_m: (min x, min y, max x, max y) of the drawing.
        prohibited: SVG path of the prohibited area within the bounds (fill rule evenodd).
        surfaces: kind and SVG path of each surface; runways last, so that they are on top.
        buildings: name and SVG path of each building.
        nodes: graph node name to (x, y).
        edges: (x1, y1, x2, y2) of each edge of the graph.
        lights: all inset lights.
        start: initial position (x, y).
    """

    name: str
    bounds_m: tuple[float, float, float, float]
    prohibited: str
    surfaces: tuple[tuple[str, str], ...]
    buildings: tuple[tuple[str, str], ...]
    nodes: dict[str, tuple[float, float]]
    edges: tuple[tuple[float, float, float, float], ...]
    lights: tuple[Light, ...]
    start: tuple[float, float]


def draw(airport: Airport, tolerance_m: float = 0.02) -> AirportDrawing:
    """Return the drawing of an airport, simplified within the tolerance."""
    x0, y0, x1, y1 = airport.bounds_m
    nodes = {name: (round(float(x), _DECIMALS), round(float(y), _DECIMALS))
             for name, (x, y) in airport.nodes.items()}
    return AirportDrawing(
        name=airport.name,
        bounds_m=(x0 - FRAME_M, y0 - FRAME_M, x1 + FRAME_M, y1 + FRAME_M),
        prohibited=svg_path(airport.prohibited_polygon(FRAME_M), tolerance_m),
        surfaces=tuple((s.kind, svg_path(s.polygon, tolerance_m)) for s in sorted(
            airport.surfaces, key=lambda surface: surface.kind == "runway")),
        buildings=tuple((b.name, svg_path(b.polygon, tolerance_m)) for b in airport.buildings),
        nodes=nodes, edges=tuple((*nodes[a], *nodes[b]) for a, b in airport.edges),
        lights=airport.lights,
        start=(airport.start.x_m, airport.start.y_m))


def svg_path(shape: Any, tolerance_m: float = 0.02) -> str:
    """Return SVG path data, in metres, of a shapely geometry made of polygons.

    Parts and holes smaller than a square of the tolerance are left out, as are lines that a union
    may leave.
    """
    rings: list[str] = []
    for part in shapely.get_parts(shapely.simplify(shape, tolerance_m)):
        if part.geom_type == "Polygon" and not part.is_empty:
            rings += [_ring(ring) for ring in (part.exterior, *part.interiors)
                      if shapely.Polygon(ring).area >= tolerance_m**2]
    return "".join(rings)


def _ring(ring: Any) -> str:
    points = [f"{round(x, _DECIMALS):g} {round(y, _DECIMALS):g}" for x, y in ring.coords[:-1]]
    return f"M{'L'.join(points)}Z"
