"""How large an airport may be: far above real ones, and small enough to be checked in a second.

A file of a few kilobytes can ask for a thousand million lights, or for outlines that cross each
other a million times. What is counted here is counted before the work is done: shapes, points,
lights, and for the geometry the pairs of pieces that come near each other, because that is what
unions and buffers take their time for.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from rampart.actors.osmosis.airport.errors import AirportError

MAX_NUMBER = 1e6
"""Of any number in an airport's file: 1,000 km from the origin, 1,000,000 cd, eleven days."""

MAX_NAME = 200
"""Characters of a name."""

MAX_FILE_BYTES = 4 << 20
"""Of an airport's file."""

MAX_COUNTS = {"surface": 5000, "prohibited": 1000, "building": 5000, "row": 5000, "obstacle": 1000,
              "missions": 1000, "nodes": 5000, "edges": 10_000}
"""Of the tables and lists of an airport's file."""

MAX_LIGHTS = 100_000
MAX_GOALS = 1000
"""Of all missions together."""

MAX_GOALS_BY_EDGES = 1_000_000
"""The place on the graph is looked for edge by edge, for each goal."""

MAX_POINTS = 50_000
"""Corners of all outlines, and points of all centre lines."""

MAX_NEAR_IN_STRIPS = 50_000
"""Pairs of pieces of a centre line that are nearer to each other than the strip is wide."""

MAX_CROSSINGS = 150_000
"""Pairs of sides that touch or cross, of all that is united; neighbouring sides touch."""

MAX_NEAR_IN_FILLET = 500_000
"""Pairs of sides of the pavement that are nearer to each other than twice the fillet radius."""

MAX_WARNINGS = 50
"""Shown of what is tolerated in a foreign file."""

_BATCH = 64
"""Pieces looked up at a time: no more pairs than this many per piece wait in memory."""


def check_count(file: str, where: str, count: int, most: int) -> None:
    """Refuse more of something than there may be.

    Raises:
        AirportError: there is more.
    """
    if count > most:
        raise AirportError(f"{file}: {where}: {count}: at most {most} are right")


def check_nearness(file: str, where: str, shapes: Sequence[Any], reach_m: float, most: int) -> int:
    """Refuse lines and polygons of which too many sides come near each other.

    Args:
        file: for the message.
        where: what the shapes are of, for the message.
        shapes: lines or polygons.
        reach_m: how near is near; 0 for touching.
        most: pairs of sides, each counted from both ends, a side with itself too.

    Returns:
        How many pairs there are.

    Raises:
        AirportError: there are more.
    """
    pieces = sides(shapes)
    tree = shapely.STRtree(pieces)
    found = 0
    for start in range(0, len(pieces), _BATCH):
        batch = pieces[start:start + _BATCH]
        near = (tree.query(batch, predicate="dwithin", distance=reach_m) if reach_m > 0
                else tree.query(batch, predicate="intersects"))
        found += near.shape[1]
        if found > most:
            raise AirportError(
                f"{file}: {where}: {len(pieces)} sides: too many of them lie within "
                f"{reach_m:g} m of each other; fewer points are right")
    return found


def sides(shapes: Sequence[Any]) -> npt.NDArray[np.object_]:
    """Return the sides of polygons and pieces of lines, each as a line of two points."""
    parts = shapely.get_parts(list(shapes))
    lines = [*shapely.get_rings(parts), *(part for part in parts
                                          if part.geom_type in ("LineString", "LinearRing"))]
    points = [shapely.get_coordinates(line) for line in lines]
    ends = [np.stack([line[:-1], line[1:]], axis=1) for line in points]
    return np.asarray(shapely.linestrings(np.concatenate(ends or [np.zeros((0, 2, 2))])))
