"""The airport as drawn on the page, bounded in size. Pure.

Each page receives it once, when it opens. A map that is too large loses detail and then items; the
page shows the number of items that are left out.
"""

from __future__ import annotations

from itertools import islice

import msgspec

from rampart.actors.operator.picture import MAX_NAME
from rampart.actors.osmosis.airport.drawing import AirportDrawing, draw
from rampart.actors.osmosis.airport.model import Airport, Light
from rampart.files.plain_text import one_line

MAX_PATHS_BYTES = 150_000
"""Size of the prohibited area, the pavement and the buildings together."""

MAX_GRAPH = 2500
"""Most nodes, and most edges."""

MAX_LIGHTS = 1500
"""Most lights: an SVG with more is slow on a phone."""

_FINEST_M, _COARSER = 0.02, 4.0
"""Initial tolerance of the outlines, and the factor by which it grows until they fit."""


class PageMap(msgspec.Struct, frozen=True):
    """An encoded map.

    Attributes:
        encoded: an `AirportDrawing` as JSON.
        left_out: kind of item and number left out.
    """

    encoded: msgspec.Raw
    left_out: dict[str, int]


def page_map(airport: Airport) -> PageMap:
    """Return the map of an airport with the finest tolerance that fits."""
    tolerance_m = _FINEST_M
    while _paths_bytes(drawn := draw(airport, tolerance_m)) > MAX_PATHS_BYTES:
        tolerance_m *= _COARSER
    shown = msgspec.structs.replace(
        drawn, name=one_line(drawn.name, MAX_NAME),
        surfaces=tuple(filter(_is_seen, drawn.surfaces)),
        buildings=tuple((one_line(name, MAX_NAME), path)
                        for name, path in filter(_is_seen, drawn.buildings)),
        nodes={one_line(name, MAX_NAME): at for name, at in islice(drawn.nodes.items(), MAX_GRAPH)},
        edges=drawn.edges[:MAX_GRAPH],
        lights=tuple(islice(filter(_is_plain, drawn.lights), MAX_LIGHTS)))
    missing = {"pieces of pavement": len(drawn.surfaces) - len(shown.surfaces),
               "buildings": len(drawn.buildings) - len(shown.buildings),
               "nodes of the graph": len(drawn.nodes) - len(shown.nodes),
               "edges of the graph": len(drawn.edges) - len(shown.edges),
               "lights": len(drawn.lights) - len(shown.lights)}
    return PageMap(msgspec.Raw(msgspec.json.encode(shown)),
                   {what: count for what, count in missing.items() if count})


def _is_seen(named: tuple[str, str]) -> bool:
    """Whether a shape is visible at the drawing's tolerance."""
    return bool(named[1])


def lights_shown(airport: Airport) -> frozenset[str]:
    """Return the names of the lights on the map of an airport."""
    return frozenset(light.name for light in islice(filter(_is_plain, airport.lights), MAX_LIGHTS))


def _is_plain(light: Light) -> bool:
    """Whether the page can show a light's name unchanged, since the name is its key."""
    return all(name == one_line(name, MAX_NAME) for name in (light.name, light.row))


def _paths_bytes(drawn: AirportDrawing) -> int:
    return len(drawn.prohibited) + sum(
        len(kind) + len(path) + _SHAPE_BYTES
        for kind, path in filter(_is_seen, (*drawn.surfaces, *drawn.buildings)))


_SHAPE_BYTES = 6
"""JSON around a name and a path."""
