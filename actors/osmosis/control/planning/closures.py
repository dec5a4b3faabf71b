"""Closures: parts of the airport's graph that are blocked for a while.

Of an edge that passes a blocked place only the part within `gap_m` of the place is removed. So the
robot in front of the place stays on the graph, and a goal behind it can be reached from the other
side.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import msgspec

from rampart.actors.bus.limits import Remembered
from rampart.actors.osmosis.airport.model import Point
from rampart.actors.osmosis.control.planning.route_search import Edge

MOST_PLACES = 32
"""Most closed places; a further one reopens the oldest."""

_LEAST_STUB_M = 0.05
"""Least length of the remainder of an edge."""


class Closures(msgspec.Struct):
    """Blocked places, each for a limited time.

    Args:
        gap_m: radius of a closure.
        lasts_s: duration of a closure.
    """

    gap_m: float = 1.0
    lasts_s: float = 60.0
    _until_s: dict[Point, float] = msgspec.field(default_factory=lambda: Remembered(MOST_PLACES))

    def close(self, place: Point, now_s: float) -> None:
        """Close the graph around a place in `map`, or renew the closure of a place near it."""
        for known in self._until_s:
            if math.dist(known, place) <= self.gap_m:
                self._until_s[known] = now_s + self.lasts_s
                return
        self._until_s[place] = now_s + self.lasts_s

    def reopen(self) -> None:
        """Remove all closures."""
        self._until_s.clear()

    def closed(self, now_s: float) -> tuple[Point, ...]:
        """Return the places closed now."""
        for place in [p for p, until_s in self._until_s.items() if until_s <= now_s]:
            del self._until_s[place]
        return tuple(self._until_s)


def without(nodes: Mapping[str, Point], edges: Iterable[Edge], places: Iterable[Point],
            gap_m: float) -> tuple[dict[str, Point], list[Edge]]:
    """Return the graph without the parts within `gap_m` of the places.

    The remainders of a cut edge end in new nodes, named after the edge.
    """
    left, kept = dict(nodes), list(edges)
    for place in places:
        cut: list[Edge] = []
        for a, b in kept:
            span = _within(place, left[a], left[b], gap_m)
            if span is None:
                cut.append((a, b))
                continue
            length_m = math.dist(left[a], left[b])
            for end, share in ((a, span[0]), (b, span[1])):
                rest_m = share * length_m if end == a else (1.0 - share) * length_m
                if rest_m > _LEAST_STUB_M:
                    name = f"{a}|{b}#{len(left)}"
                    left[name] = _between(left[a], left[b], share)
                    cut.append((end, name))
        kept = cut
    return left, kept


def _within(place: Point, a: Point, b: Point, gap_m: float) -> tuple[float, float] | None:
    """Return the range of shares from a to b within `gap_m` of a place, or None."""
    (dx, dy), (px, py) = (b[0] - a[0], b[1] - a[1]), (place[0] - a[0], place[1] - a[1])
    square = dx * dx + dy * dy
    if square == 0.0:
        return (0.0, 1.0) if math.hypot(px, py) <= gap_m else None
    middle = (px * dx + py * dy) / square
    aside_square = max(px * px + py * py - middle * middle * square, 0.0)
    if aside_square > gap_m * gap_m:
        return None
    half = math.sqrt((gap_m * gap_m - aside_square) / square)
    first, last = max(middle - half, 0.0), min(middle + half, 1.0)
    return (first, last) if first < last else None


def _between(a: Point, b: Point, share: float) -> Point:
    return a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])

