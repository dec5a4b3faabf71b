"""Checks whether a route may be driven, before a node uses it.

A route can be checked without planning: it begins at the robot, ends at the goal, follows edges of
the graph, and keeps clear of the prohibited area. Only the approach to the graph and the turn-off
to the goal follow no edge; they are short and checked against the prohibited area too. The check
needs the airport alone, so Osmosis Control and DM10 each have an independent instance.
"""

from __future__ import annotations

import itertools
import math
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import shapely

from rampart.actors.ftm.plausible import is_sane
from rampart.actors.osmosis.airport.model import Airport, Point, show

Points = npt.NDArray[np.float64]

# Limits of a valid route, in metres.
CLEARANCE_M = 0.6
"""From each leg to the prohibited area: half the robot's diagonal and a margin."""

START_M = 3.0
"""From the robot to the nearest point of the route."""

END_M = 0.2
"""From the last waypoint to the goal."""

ASIDE_M = 0.6
"""From a leg to the nearest edge; a straightened row is off by up to half a metre."""

LAST_ASIDE_M = 1.6
"""The same for the last leg: the planner goes from the last node straight to a goal within a metre
of the graph."""

APPROACH_M = 12.5
"""Longest approach from the robot to the graph."""

TURNOFF_M = 3.2
"""Longest turn-off from the graph to the goal."""

STEP_M = 0.5
"""Spacing of the samples on a leg."""


class RouteCheck:
    """Checks routes on one airport; stateless but for a cache.

    Args:
        airport: map and graph.
    """

    def __init__(self, airport: Airport) -> None:
        self._allowed = airport.allowed
        self._boundary = airport.allowed.boundary
        ends = np.reshape(
            [(*airport.nodes[a], *airport.nodes[b]) for a, b in airport.edges], (-1, 4))
        self._from, self._along = ends[:, :2], ends[:, 2:] - ends[:, :2]
        self._of_shape = lru_cache(maxsize=8)(self._find_in_shape)

    def fault(self, waypoints: tuple[Point, ...], robot: Point | None, goal: Point | None) -> str:
        """Return the fault of a route, or "".

        Args:
            waypoints: in `map`.
            robot: position of the robot; None: the beginning is not checked.
            goal: the goal; None: the end is not checked.
        """
        if not waypoints:
            return "the route has no waypoints"
        if not all(is_sane(*waypoint) for waypoint in waypoints):
            return "a waypoint is not finite or implausibly far away"
        if goal is not None and not math.dist(waypoints[-1], goal) <= END_M:
            return (f"the route ends at {show(waypoints[-1])},"
                    f" {math.dist(waypoints[-1], goal):.1f} m from the goal {show(goal)}")
        if robot is not None:
            way = shapely.linestrings(waypoints if len(waypoints) > 1 else waypoints * 2)
            off_m = float(shapely.distance(way, shapely.points(robot)))
            if not off_m <= START_M:
                return f"the robot at {show(robot)} is {off_m:.1f} m from the route"
        return self._of_shape(waypoints)

    def _find_in_shape(self, waypoints: tuple[Point, ...]) -> str:
        legs = list(itertools.pairwise(waypoints))
        for number, (a, b) in enumerate(legs, start=1):
            fault = self._ground(a, b) or self._off_graph(
                a, b, first=number == 1, last=number == len(legs))
            if fault:
                return f"leg {number} from {show(a)} to {show(b)} {fault}"
        return ""

    def _ground(self, a: Point, b: Point) -> str:
        line = shapely.linestrings([a, b])
        if not shapely.covers(self._allowed, line):
            return "crosses the prohibited area"
        clearance_m = float(shapely.distance(self._boundary, line))
        if clearance_m < CLEARANCE_M:
            return (f"passes {clearance_m:.2f} m from the prohibited area,"
                    f" expected at least {CLEARANCE_M:.2f} m")
        return ""

    def _off_graph(self, a: Point, b: Point, *, first: bool, last: bool) -> str:
        """Return how a leg leaves the graph for longer than allowed, or ""."""
        length_m = math.dist(a, b)
        count = 1 + max(1, math.ceil(length_m / STEP_M))
        share = np.linspace(0.0, 1.0, count)[:, None]
        aside_m = self._aside_m(np.array(a) + share * (np.array(b) - np.array(a)))
        on = aside_m <= (LAST_ASIDE_M if last else ASIDE_M)
        if bool(on.all()):
            return ""
        if not bool(on.any()):
            # From beside the graph straight to a goal beside it, at the same edge.
            most_m = TURNOFF_M if first and last else 0.0
            return "" if length_m <= most_m else "follows no edge of the graph"
        begins, ends = int(np.argmax(on)), count - 1 - int(np.argmax(on[::-1]))
        if not bool(on[begins:ends + 1].all()):
            return "leaves the graph on the way"
        if begins > 0 and not (first and begins * length_m / (count - 1) <= APPROACH_M):
            return "begins off the graph"
        if ends < count - 1 and not (last and (count - 1 - ends) * length_m / (count - 1)
                                     <= TURNOFF_M):
            return "ends off the graph"
        return ""

    def _aside_m(self, points: Points) -> Points:
        """Return the distance of each point to the nearest edge, shape (n,)."""
        if not len(self._from):
            return np.full(len(points), math.inf)
        relative = points[:, None, :] - self._from[None, :, :]
        square = np.maximum((self._along**2).sum(axis=1), 1e-18)
        at = np.clip(np.einsum("nei,ei->ne", relative, self._along) / square, 0.0, 1.0)
        off = relative - at[:, :, None] * self._along[None, :, :]
        return np.asarray(np.sqrt((off**2).sum(axis=2)).min(axis=1))
