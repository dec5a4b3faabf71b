"""Route search: A* over the airport's graph, from any pose to any point near it.

Start and goal need not be nodes: each is snapped to the nearest edge, or to a node that is about as
near, and added as a temporary node. The heuristic is the straight distance, which never
overestimates, so the route is a shortest one (Hart, Nilsson, Raphael 1968; paper, section III).
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Iterable, Mapping

import msgspec

from rampart.actors.bus.limits import Remembered
from rampart.actors.osmosis.airport.model import Attachment, Point, foot, show

Edge = tuple[str, str]

MOST_PLACES = 32
"""Most closed places; a further one reopens the oldest."""

_LEAST_STUB_M = 0.05
"""Least length of the remainder of an edge."""


class Closures(msgspec.Struct):
    """Blocked places of the airport's graph, each for a limited time.

    Args:
        gap_m: radius of a closure.
        lasts_s: duration of a closure.
    """

    gap_m: float = 1.0
    lasts_s: float = 60.0
    _until_s: dict[Point, float] = msgspec.field(default_factory=lambda: Remembered(MOST_PLACES))

    def close(self, place: Point, now_s: float) -> None:
        """Close the graph around a place in `map`."""
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

    So the robot in front of a place stays on the graph, and a goal behind it can be reached from
    the other side.
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


NODE_SNAP_M = 0.3
"""A node is preferred if it is at most this much farther than the nearest edge."""

START_REACH_M = 12.0
"""Greatest distance of the robot from the graph."""

GOAL_REACH_M = 3.0
"""Greatest distance of a goal from the graph."""

APPROACH_M = 2.0
"""Distance from the graph above which the start is a waypoint."""

CUT_M = 1.0
"""Distance from the graph up to which the robot goes straight to the goal; to a farther goal it
turns off at the nearest place, to stay on the pavement."""

STRAIGHT_M = 0.5
"""Greatest distance of the inner points of a straight row to its line."""

ROW_BEGINS_M = 1.0
"""Greatest distance of the first node at which a row begins there."""


class PlannedRoute(msgspec.Struct, frozen=True):
    """Result of a search: waypoints in `map` from start to goal, or a reason."""

    waypoints: tuple[Point, ...]
    reason: str


def plan_route(nodes: Mapping[str, Point], edges: Iterable[Edge], start: Point, goal: Point, *,
               straight: bool = False) -> PlannedRoute:
    """Return a shortest route over the graph.

    Args:
        nodes: name to position in `map`, metres.
        edges: pairs of node names, undirected.
        start: position of the robot.
        goal: end of the route.
        straight: light verification: inner waypoints of a straight row are removed, and the row
            begins at its node if that is near, since a slanted line from the robot would miss the
            first light.
    """
    if not all(map(math.isfinite, (*start, *goal))):
        return PlannedRoute((), f"start {show(start)} or goal {show(goal)} is not finite")
    usable = sorted({(min(edge), max(edge)) for edge in edges if edge[0] != edge[1]})
    joined: list[Attachment] = []
    reaches = ((start, "start", START_REACH_M), (goal, "goal", GOAL_REACH_M))
    for point, what, reach_m in reaches:
        snap = _snap(nodes, usable, point)
        if snap is None:
            return PlannedRoute((), "the graph has no open edge")
        if snap.distance_m > reach_m:
            return PlannedRoute((), f"{what} {show(point)} is {snap.distance_m:.1f} m from the "
                                    f"graph, expected at most {reach_m:.1f} m")
        joined.append(snap)
    path = _search(nodes, usable, joined[0], joined[1])
    if path is None:
        return PlannedRoute((), f"no route in the graph from {show(start)} to {show(goal)}")
    if joined[1].distance_m <= CUT_M:
        path[-1] = goal
    else:
        path.append(goal)
    if joined[0].distance_m > APPROACH_M:
        path.insert(0, start)
    waypoints = _without_repeats(path)
    if straight:
        if len(waypoints) > 2 and math.dist(*waypoints[:2]) <= ROW_BEGINS_M:
            del waypoints[0]
        waypoints = _straightened(waypoints)
    return PlannedRoute(tuple(waypoints), "")


def _snap(nodes: Mapping[str, Point], edges: list[Edge], point: Point) -> Attachment | None:
    """Return the nearest place on the open part of the graph."""
    best: Attachment | None = None
    for a, b in edges:
        place = foot(point, nodes[a], nodes[b])
        distance_m = math.dist(point, place)
        if best is None or distance_m < best.distance_m:
            best = Attachment(place, distance_m, a, b)
    if best is None:
        return None
    for name in sorted({name for edge in edges for name in edge}):
        distance_m = math.dist(point, nodes[name])
        if distance_m <= best.distance_m + (NODE_SNAP_M if best.a != best.b else 0.0):
            best = Attachment(nodes[name], distance_m, name, name)
    return best


def _search(nodes: Mapping[str, Point], edges: list[Edge], start: Attachment,
            goal: Attachment) -> list[Point] | None:
    """A* between two snapped points. Temporary nodes are 0 (start) and 1 (goal)."""
    places: dict[str | int, Point] = {0: start.point, 1: goal.point}
    places.update(nodes.items())
    ways: dict[str | int, list[str | int]] = {name: [] for name in places}

    def join(a: str | int, b: str | int) -> None:
        ways[a].append(b)
        ways[b].append(a)

    for a, b in edges:
        join(a, b)
    for temporary, snap in ((0, start), (1, goal)):
        for name in dict.fromkeys((snap.a, snap.b)):
            join(temporary, name)
    if start.a != start.b and (start.a, start.b) == (goal.a, goal.b):
        join(0, 1)

    cost: dict[str | int, float] = {0: 0.0}
    came: dict[str | int, str | int] = {}
    ties = itertools.count(1)
    queue: list[tuple[float, int, str | int]] = [(math.dist(start.point, goal.point), 0, 0)]
    while queue:
        _, _, place = heapq.heappop(queue)
        if place == 1:
            path = [places[place]]
            while place in came:
                place = came[place]
                path.append(places[place])
            return path[::-1]
        for beyond in ways[place]:
            total = cost[place] + math.dist(places[place], places[beyond])
            if total < cost.get(beyond, math.inf):
                cost[beyond] = total
                came[beyond] = place
                guess = total + math.dist(places[beyond], goal.point)
                heapq.heappush(queue, (guess, next(ties), beyond))
    return None


def _without_repeats(path: list[Point]) -> list[Point]:
    kept = path[:1]
    for point in path[1:]:
        if math.dist(point, kept[-1]) > 1e-6:
            kept.append(point)
    return kept


def _straightened(path: list[Point]) -> list[Point]:
    """Return only the ends of a straight row, else the path."""
    first, last = path[0], path[-1]
    if all(math.dist(point, foot(point, first, last)) <= STRAIGHT_M for point in path[1:-1]):
        return [first, last] if len(path) > 1 else path
    return path
