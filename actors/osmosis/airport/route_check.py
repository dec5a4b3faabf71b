"""Route check: may this route be driven? Asked before it is used, by whoever is going to use it.

A route is a promise by the Graph Planner that can be checked without planning: it begins where the
robot is, ends at the goal, runs along edges of the graph, and keeps clear of the prohibited area.
Only the way to the graph and the way off it to the goal have no edge to lie on; they are short, and
the area is looked at there too. The check has the airport's map and graph and no state, so that
Osmosis Control and a detection module with a copy of its own can both ask it.
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

# What a good route keeps to, in metres.
CLEARANCE_M = 0.6
"""From each leg to the prohibited area; half the robot's diagonal and a little."""

START_M = 3.0
"""From the robot to the nearest point of the route."""

END_M = 0.2
"""From the last waypoint to the goal."""

ASIDE_M = 0.6
"""From a leg to the nearest edge; a straightened row is off by up to half a metre."""

LAST_ASIDE_M = 1.6
"""The same for the last leg: a goal within a metre of the graph is headed for from the last node
on."""

APPROACH_M = 12.5
"""Longest way from the robot to the graph."""

TURNOFF_M = 3.2
"""Longest way from the graph to the goal."""

STEP_M = 0.5
"""How densely legs are looked at."""


class RouteCheck:
    """Checks routes on one airport. It keeps no state but the last answers.

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
        """Return what is wrong with a route, or "".

        Args:
            waypoints: in `map`.
            robot: where the robot is; None leaves the route's beginning unchecked.
            goal: where it shall go; None leaves the route's end unchecked.
        """
        if not waypoints:
            return "the route has no waypoints"
        if not all(is_sane(*waypoint) for waypoint in waypoints):
            return "a waypoint is not finite, or farther away than anything can be"
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
                    f" {CLEARANCE_M:.2f} m is the least")
        return ""

    def _off_graph(self, a: Point, b: Point, *, first: bool, last: bool) -> str:
        """Why a leg is no part of the graph: it leaves it for longer than it may."""
        length_m = math.dist(a, b)
        count = 1 + max(1, math.ceil(length_m / STEP_M))
        share = np.linspace(0.0, 1.0, count)[:, None]
        aside_m = self._aside_m(np.array(a) + share * (np.array(b) - np.array(a)))
        on = aside_m <= (LAST_ASIDE_M if last else ASIDE_M)
        if bool(on.all()):
            return ""
        if not bool(on.any()):
            # From off the graph straight to a goal off the graph: both at the same edge.
            most_m = TURNOFF_M if first and last else 0.0
            return "" if length_m <= most_m else "lies on no edge of the graph"
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
        """Distance of points to the nearest edge, shape (n,)."""
        if not len(self._from):
            return np.full(len(points), math.inf)
        relative = points[:, None, :] - self._from[None, :, :]
        square = np.maximum((self._along**2).sum(axis=1), 1e-18)
        at = np.clip(np.einsum("nei,ei->ne", relative, self._along) / square, 0.0, 1.0)
        off = relative - at[:, :, None] * self._along[None, :, :]
        return np.asarray(np.sqrt((off**2).sum(axis=2)).min(axis=1))
