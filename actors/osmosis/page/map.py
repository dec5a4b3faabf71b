"""The airport as the page draws it: at once, and no more of it than a page can hold. Pure.

It is sent to each page that opens, once. A map with more in it than a person can see is drawn with
less detail, then without what there is most of, and how much is missing is counted and shown.
"""

from __future__ import annotations

from itertools import islice

import msgspec

from rampart.actors.operator.bounds import MAX_NAME
from rampart.actors.osmosis.airport.drawing import AirportDrawing, draw
from rampart.actors.osmosis.airport.model import Airport, Light
from rampart.files.plain_text import one_line

MAX_PATHS_BYTES = 150_000
"""Of the prohibited area, the pavement and the buildings together."""

MAX_GRAPH = 2500
"""Nodes, and edges."""

MAX_LIGHTS = 1500
"""So many lights are shown of an airport: an SVG with more is slow on a telephone."""

_FINEST_M, _COARSER = 0.02, 4.0
"""Tolerance of the outlines, and by how much it grows until they fit."""


class PageMap(msgspec.Struct, frozen=True):
    """A map as it is sent.

    Attributes:
        encoded: an `AirportDrawing` as JSON.
        left_out: what is missing, and how many of it.
    """

    encoded: msgspec.Raw
    left_out: dict[str, int]


def page_map(airport: Airport) -> PageMap:
    """Return the map of an airport, as fine as there is room for."""
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
    """Tell whether something is left of a shape at the drawing's tolerance."""
    return bool(named[1])


def lights_shown(airport: Airport) -> frozenset[str]:
    """Return the names of the lights that are on the map of an airport."""
    return frozenset(light.name for light in islice(filter(_is_plain, airport.lights), MAX_LIGHTS))


def _is_plain(light: Light) -> bool:
    """Tell whether the page can show a light's name as it is: by that the light is known."""
    return all(name == one_line(name, MAX_NAME) for name in (light.name, light.row))


def _paths_bytes(drawn: AirportDrawing) -> int:
    return len(drawn.prohibited) + sum(
        len(kind) + len(path) + _SHAPE_BYTES
        for kind, path in filter(_is_seen, (*drawn.surfaces, *drawn.buildings)))


_SHAPE_BYTES = 6
"""Of JSON around a name and a path."""
