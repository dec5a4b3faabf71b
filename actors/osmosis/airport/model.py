"""What an airport is: graph, lights, pavement, buildings, missions. Pure data and geometry.

Everything is in the `map` frame: local east-north-up, metres, yaw counter-clockwise from east.
The ground is described by what is allowed: the pavement less the prohibited polygons. All the
rest of the world is prohibited (paper, section V: the robot must not leave the pavement).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt
import shapely
from shapely.geometry import box

from rampart.actors.osmosis.airport.errors import AirportError

GoalMode = Literal["taxi", "light verification"]
GOAL_MODES: tuple[GoalMode, ...] = ("taxi", "light verification")
ObstacleShape = Literal["cylinder", "box"]
GRAPH_REACH_M = 3.0
"""A point farther than this from the graph cannot be a mission point."""
SIMPLIFICATION_M = 0.02
"""Accuracy of curved edges of the pavement: the fewer points, the faster the checks."""


class _Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of what airport files hold as it is; a misspelt key is an error, not silence."""


class MissionGoal(_Record, frozen=True):
    """One mission point and the mode in which it is reached (paper, section III)."""

    x_m: float
    y_m: float
    mode: GoalMode


class Mission(msgspec.Struct, frozen=True):
    """An ordered list of goals."""

    name: str
    goals: tuple[MissionGoal, ...]


class StartPose(_Record, frozen=True):
    """Where the robot stands at the start."""

    x_m: float
    y_m: float
    yaw_rad: float


class Light(msgspec.Struct, frozen=True):
    """An inset light; `nominal_cd` is the intensity it should have."""

    name: str
    row: str
    x_m: float
    y_m: float
    nominal_cd: float


class Surface(msgspec.Struct, frozen=True):
    """A named piece of pavement: `kind` is runway, taxiway, apron or area."""

    name: str
    kind: str
    polygon: Any


class Building(_Record, frozen=True):
    """A box on the ground: `length_m` along its own x axis, which is turned by `yaw_rad`."""

    name: str
    x_m: float
    y_m: float
    length_m: float
    width_m: float
    height_m: float
    yaw_rad: float = 0.0

    @property
    def polygon(self) -> Any:
        """Its ground plan."""
        return rectangle(self.x_m, self.y_m, self.yaw_rad, self.length_m, self.width_m)


class ObstaclePreset(_Record, frozen=True):
    """An obstacle that can be put in the robot's way.

    Args:
        name: its name in `world/obstacle` messages.
        shape: cylinder, or box of half side `radius_m` with sides along the map's axes.
        x_m: centre, east.
        y_m: centre, north.
        radius_m: radius or half side.
        present_from_s: not there before this time, s from the start of the world.
        appears_within_m: not there before the robot is as near as this; None: no such condition.
        gone_after_s: goes away this long after it appeared; None: stays.
    """

    name: str
    shape: ObstacleShape
    x_m: float
    y_m: float
    radius_m: float
    present_from_s: float = 0.0
    appears_within_m: float | None = None
    gone_after_s: float | None = None


class Attachment(msgspec.Struct, frozen=True):
    """The place on the graph nearest to a point: on edge (`a`, `b`); a == b for a lone node."""

    x_m: float
    y_m: float
    distance_m: float
    a: str
    b: str


@dataclass(frozen=True)
class Airport:
    """An airport. Build it with `formats.load_airport`, which checks it.

    Args:
        name: for people and file names.
        nodes: node name to (x, y), m.
        edges: pairs of node names; traffic in both directions.
        allowed: where the robot may be, as a shapely (multi)polygon.
        surfaces: named pieces of pavement, for maps.
        buildings: solid boxes.
        lights: inset lights with nominal intensities.
        start: initial pose.
        missions: missions by name.
        obstacles: presets, the first ones are used first.
        warnings: what was tolerated at load, one line each.
        source: the file it was read from; empty if it was made in memory.
    """

    name: str
    nodes: Mapping[str, tuple[float, float]]
    edges: tuple[tuple[str, str], ...]
    allowed: Any
    start: StartPose
    surfaces: tuple[Surface, ...] = ()
    buildings: tuple[Building, ...] = ()
    lights: tuple[Light, ...] = ()
    missions: Mapping[str, Mission] = field(default_factory=dict)
    obstacles: tuple[ObstaclePreset, ...] = ()
    warnings: tuple[str, ...] = ()
    source: str = ""

    def __post_init__(self) -> None:
        shapely.prepare(self.allowed)

    # -- graph ----------------------------------------------------------------------------------

    @cached_property
    def neighbours(self) -> Mapping[str, tuple[tuple[str, float], ...]]:
        """For each node its neighbours with the length of the edge, m."""
        table: dict[str, list[tuple[str, float]]] = {name: [] for name in self.nodes}
        for a, b in self.edges:
            length_m = math.dist(self.nodes[a], self.nodes[b])
            table[a].append((b, length_m))
            table[b].append((a, length_m))
        return {name: tuple(found) for name, found in table.items()}

    def nearest_node(self, x_m: float, y_m: float) -> tuple[str, float]:
        """Return the node nearest to a point, and its distance, m."""
        return min(((name, math.dist(at, (x_m, y_m))) for name, at in self.nodes.items()),
                   key=lambda found: found[1])

    def nearest_on_graph(self, x_m: float, y_m: float) -> Attachment:
        """Return the place on an edge, or lone node, nearest to a point."""
        name, distance_m = self.nearest_node(x_m, y_m)
        best = Attachment(*self.nodes[name], distance_m, name, name)
        for a, b in self.edges:
            (ax, ay), (bx, by) = self.nodes[a], self.nodes[b]
            dx, dy = bx - ax, by - ay
            square = dx * dx + dy * dy
            share = ((x_m - ax) * dx + (y_m - ay) * dy) / square if square else 0.0
            share = min(1.0, max(0.0, share))
            px, py = ax + share * dx, ay + share * dy
            off_m = math.dist((px, py), (x_m, y_m))
            if off_m < best.distance_m - 1e-9:
                best = Attachment(px, py, off_m, a, b)
        return best

    @cached_property
    def within_reach(self) -> frozenset[str]:
        """All nodes that can be reached from the start pose."""
        return self.component(self.nearest_on_graph(self.start.x_m, self.start.y_m).a)

    def component(self, node: str) -> frozenset[str]:
        """Return all nodes that can be reached from `node`, itself included."""
        reached, todo = {node}, [node]
        while todo:
            for other, _ in self.neighbours[todo.pop()]:
                if other not in reached:
                    reached.add(other)
                    todo.append(other)
        return frozenset(reached)

    # -- ground ---------------------------------------------------------------------------------

    def prohibited_distance_m(self, x_m: float, y_m: float) -> float:
        """Distance from a point to the prohibited area: positive outside it, negative inside.

        Inside, the magnitude is the way back to the pavement.
        """
        return float(self.prohibited_distances_m(((x_m, y_m),))[0])

    def prohibited_distances_m(self, points: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Return `prohibited_distance_m` for several points at once."""
        at = np.asarray(points, dtype=float)
        ax, ay, dx, dy, square = self._boundary
        px, py = at[:, :1] - ax, at[:, 1:] - ay
        share = np.minimum(np.maximum((px * dx + py * dy) / square, 0.0), 1.0)
        px -= share * dx
        py -= share * dy
        distances = np.sqrt((px * px + py * py).min(axis=1))
        inside = shapely.contains_xy(self.allowed, at[:, 0], at[:, 1])
        signed: npt.NDArray[np.float64] = np.where(inside, distances, -distances)
        return signed

    @cached_property
    def _boundary(self) -> tuple[npt.NDArray[np.float64], ...]:
        """Segments of the boundary: start, direction, squared length. GEOS is slower here."""
        rings = shapely.get_rings(shapely.get_parts(self.allowed))
        points = [shapely.get_coordinates(ring) for ring in rings]
        a = np.concatenate([ring[:-1] for ring in points])
        d = np.concatenate([np.diff(ring, axis=0) for ring in points])
        square = np.maximum((d * d).sum(axis=1), 1e-18)
        return tuple(np.ascontiguousarray(v) for v in (*a.T, *d.T, square))

    def footprint_in_prohibited(self, polygon: Any) -> bool:
        """Whether any part of a footprint (shapely polygon in `map`) is in the prohibited area."""
        return not shapely.covers(self.allowed, polygon)

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """Smallest rectangle round pavement and buildings: (min x, min y, max x, max y)."""
        shapes = [self.allowed, *(building.polygon for building in self.buildings)]
        return tuple(float(v) for v in shapely.total_bounds(shapes))  # type: ignore[return-value]

    def prohibited_polygon(self, margin_m: float = 5.0) -> Any:
        """The prohibited area as a polygon, cut `margin_m` round the airport; for maps."""
        x0, y0, x1, y1 = self.bounds_m
        frame = box(x0 - margin_m, y0 - margin_m, x1 + margin_m, y1 + margin_m)
        return frame.difference(self.allowed)

    def mission(self, name: str) -> Mission:
        """Return a mission by name.

        Raises:
            AirportError: the airport has no such mission.
        """
        try:
            return self.missions[name]
        except KeyError:
            known = ", ".join(self.missions) or "none"
            raise AirportError(
                f"{self.name}: missions: {name!r}: no such mission, there are: {known}") from None


def rectangle(x_m: float, y_m: float, yaw_rad: float, length_m: float, width_m: float) -> Any:
    """Return a rectangle about (x, y), `length_m` along its own x axis, as a shapely polygon."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    half = ((length_m / 2, width_m / 2), (-length_m / 2, width_m / 2),
            (-length_m / 2, -width_m / 2), (length_m / 2, -width_m / 2))  # fmt: skip
    return shapely.polygons([(x_m + u * cos - v * sin, y_m + u * sin + v * cos) for u, v in half])


def union(polygons: Iterable[Any]) -> Any:
    """Merge polygons."""
    return shapely.unary_union(list(polygons))


def rounded(area: Any, fillet_radius_m: float) -> Any:
    """Round inner corners sharper than the fillet radius, as on taxiways, and simplify."""
    if fillet_radius_m > 0:
        area = area.buffer(fillet_radius_m).buffer(-fillet_radius_m)
    return area.simplify(SIMPLIFICATION_M)
