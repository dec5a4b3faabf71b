"""An airport: graph, lights, pavement, buildings, missions. Pure data and geometry.

Everything is in the `map` frame: local east-north-up, metres, yaw counter-clockwise from east.
The allowed area is the pavement without the prohibited polygons. Everything else is prohibited
(paper, section V: the robot must not leave the pavement).
"""

from __future__ import annotations

import contextlib
import math
from collections import Counter
from collections.abc import Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt
import shapely
from shapely.geometry import box

from rampart.files.plain_text import one_line
from rampart.files.reading import FileError
from rampart.manager.spec.tables import NonNegative, Positive


class AirportError(ValueError):
    """An airport or mission file is invalid: one line with file, field, value and remedy."""

    def __init__(self, line: str) -> None:
        super().__init__(one_line(line))


class Problem(msgspec.Struct, frozen=True):
    """A problem of an airport.

    Args:
        field: path into the file, such as `missions.AB.goals[2]`.
        value: the invalid value, as text.
        remedy: what is expected.
        tolerable: only a warning in the formats of the paper's authors.
    """

    field: str
    value: str
    remedy: str
    tolerable: bool = False

    def line(self, file: str) -> str:
        """Return the one-line message for `file`."""
        return one_line(f"{file}: {self.field}: {self.value}: {self.remedy}")


@contextlib.contextmanager
def readable(file: str | Path, remedy: str, what: str = "file") -> Iterator[None]:
    """Turn the errors of reading a file into `AirportError`.

    Args:
        file: named in the message.
        remedy: what is expected of the content.
        what: kind of file.
    """
    try:
        yield
    except OSError as error:
        raise AirportError(f"{file}: cannot be read: {error.strerror}: expected a readable file"
                           ) from None
    except FileError as error:
        raise AirportError(f"{file}: {what}: {error}: {remedy}") from None


# Bounds of an airport's files, far above real airports.
MAX_FILE_BYTES = 4 << 20
MAX_LIGHTS = 100_000
"""Lights of all rows; a row of a few characters can define any number."""

MAX_NUMBER = 1e6
"""Largest number: 1,000 km from the origin, 1,000,000 cd, eleven days."""

MAX_NAME = 200
"""Characters of a name."""

Name = Annotated[str, msgspec.Meta(max_length=MAX_NAME)]
Point = tuple[float, float]
GoalMode = Literal["taxi", "light verification"]
ObstacleShape = Literal["cylinder", "box"]
GRAPH_REACH_M = 3.0
"""Largest distance of a mission point from the graph."""
SIMPLIFICATION_M = 0.02
"""Accuracy of the pavement's curved edges: fewer points make the checks faster."""
H = TypeVar("H", bound=Hashable)


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of the tables of airport files; an unknown key is an error."""


class MissionGoal(Record, frozen=True):
    """A mission point and the mode in which the robot reaches it (paper, section III)."""

    x_m: float
    y_m: float
    mode: GoalMode


class Mission(Record, frozen=True):
    """An ordered list of goals."""

    name: Name
    goals: tuple[MissionGoal, ...]


class StartPose(Record, frozen=True):
    """Initial pose of the robot."""

    x_m: float
    y_m: float
    yaw_rad: float


class Light(msgspec.Struct, frozen=True):
    """An inset light with its nominal intensity."""

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


class Building(Record, frozen=True):
    """A box on the ground; `length_m` is along its x axis, which is rotated by `yaw_rad`."""

    name: str
    x_m: float
    y_m: float
    length_m: Positive
    width_m: Positive
    height_m: Positive
    yaw_rad: float = 0.0

    @property
    def polygon(self) -> Any:
        """Ground plan."""
        return rectangle(self.x_m, self.y_m, self.yaw_rad, self.length_m, self.width_m)


class ObstaclePreset(Record, frozen=True):
    """An obstacle that a run can place in the robot's way.

    Args:
        name: its name in `world/obstacle` messages.
        shape: cylinder, or box of half side `radius_m` with sides along the map's axes.
        x_m: centre, east.
        y_m: centre, north.
        radius_m: radius or half side.
        present_from_s: earliest appearance, s from the start of the world.
        appears_within_m: appears when the robot is this near; None: at any distance.
        gone_after_s: disappears this long after it appeared; None: stays.
    """

    name: str
    shape: ObstacleShape
    x_m: float
    y_m: float
    radius_m: Annotated[float, msgspec.Meta(ge=0.05, le=5.0)]
    present_from_s: NonNegative = 0.0
    appears_within_m: NonNegative | None = None
    gone_after_s: NonNegative | None = None


class Attachment(msgspec.Struct, frozen=True):
    """Nearest place on the graph to a point: on edge (`a`, `b`), or on a node if a == b."""

    point: Point
    distance_m: float
    a: str
    b: str


@dataclass(frozen=True)
class Airport:
    """An airport. `formats.load_airport` loads and checks one.

    Args:
        name: display name, also used in file names.
        nodes: node name to (x, y), m.
        edges: pairs of node names, undirected.
        allowed: allowed area as a shapely (multi)polygon.
        surfaces: named pieces of pavement, for maps.
        buildings: solid boxes.
        lights: inset lights with nominal intensities.
        start: initial pose.
        missions: missions by name.
        obstacles: presets; a run uses the first ones.
        warnings: problems tolerated at load, one line each.
        source: file of the airport; empty if it was made in memory.
    """

    name: str
    nodes: Mapping[str, Point]
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
        """Neighbours of each node with the length of the edge, m."""
        table: dict[str, list[tuple[str, float]]] = {name: [] for name in self.nodes}
        for a, b in self.edges:
            length_m = math.dist(self.nodes[a], self.nodes[b])
            table[a].append((b, length_m))
            table[b].append((a, length_m))
        return {name: tuple(found) for name, found in table.items()}

    def nearest_on_graph(self, x_m: float, y_m: float) -> Attachment:
        """Return the place on an edge or node nearest to a point."""
        at, nodes = (x_m, y_m), self.nodes
        name = min(nodes, key=lambda node: math.dist(nodes[node], at))
        best = Attachment(nodes[name], math.dist(nodes[name], at), name, name)
        for a, b in self.edges:
            point = foot(at, nodes[a], nodes[b])
            off_m = math.dist(point, at)
            if off_m < best.distance_m - 1e-9:
                best = Attachment(point, off_m, a, b)
        return best

    @cached_property
    def within_reach(self) -> frozenset[str]:
        """Nodes that can be reached from the start pose."""
        todo = [self.nearest_on_graph(self.start.x_m, self.start.y_m).a]
        reached = set(todo)
        while todo:
            beyond = {other for other, _ in self.neighbours[todo.pop()]} - reached
            reached |= beyond
            todo += beyond
        return frozenset(reached)

    # -- ground ---------------------------------------------------------------------------------

    def prohibited_distance_m(self, x_m: float, y_m: float) -> float:
        """Signed distance from a point to the boundary of the prohibited area; negative inside."""
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
        return np.asarray(np.where(inside, distances, -distances))

    @cached_property
    def _boundary(self) -> tuple[npt.NDArray[np.float64], ...]:
        """Segments of the boundary: start, direction, squared length; faster than GEOS."""
        rings = shapely.get_rings(shapely.get_parts(self.allowed))
        points = [shapely.get_coordinates(ring) for ring in rings]
        a = np.concatenate([ring[:-1] for ring in points])
        d = np.concatenate([np.diff(ring, axis=0) for ring in points])
        square = np.maximum((d * d).sum(axis=1), 1e-18)
        return tuple(np.ascontiguousarray(v) for v in (*a.T, *d.T, square))

    def footprint_in_prohibited(self, polygon: Any) -> bool:
        """Whether a footprint (shapely polygon in `map`) overlaps the prohibited area."""
        return not shapely.covers(self.allowed, polygon)

    @property
    def bounds_m(self) -> tuple[float, float, float, float]:
        """Bounding box of pavement and buildings: (min x, min y, max x, max y)."""
        shapes = [self.allowed, *(building.polygon for building in self.buildings)]
        return tuple(float(v) for v in shapely.total_bounds(shapes))  # type: ignore[return-value]

    def prohibited_polygon(self, margin_m: float = 5.0) -> Any:
        """The prohibited area as a polygon, clipped `margin_m` beyond the airport; for maps."""
        x0, y0, x1, y1 = self.bounds_m
        frame = box(x0 - margin_m, y0 - margin_m, x1 + margin_m, y1 + margin_m)
        return frame.difference(self.allowed)

    def mission(self, name: str) -> Mission:
        """Return a mission by name.

        Raises:
            AirportError: the airport has no such mission.
        """
        if name not in self.missions:
            known = ", ".join(self.missions) or "none"
            raise AirportError(
                f"{self.name}: missions: {name!r}: unknown mission; known: {known}")
        return self.missions[name]


def repeated(names: Iterable[H]) -> list[H]:
    """Return the items that occur more than once."""
    return [name for name, times in Counter(names).items() if times > 1]


def foot(point: Point, a: Point, b: Point) -> Point:
    """Return the point of the segment from a to b that is nearest to a point."""
    along = (b[0] - a[0], b[1] - a[1])
    square = along[0] ** 2 + along[1] ** 2
    if square == 0.0:
        return a
    share = ((point[0] - a[0]) * along[0] + (point[1] - a[1]) * along[1]) / square
    share = min(max(share, 0.0), 1.0)
    return a[0] + share * along[0], a[1] + share * along[1]


def show(point: Point) -> str:
    """Return a point as text."""
    return f"({point[0]:.1f}, {point[1]:.1f})"


def rectangle(x_m: float, y_m: float, yaw_rad: float, length_m: float, width_m: float) -> Any:
    """Return a rectangle centred at (x, y), with `length_m` along its x axis, as a polygon."""
    cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
    half = ((length_m / 2, width_m / 2), (-length_m / 2, width_m / 2),
            (-length_m / 2, -width_m / 2), (length_m / 2, -width_m / 2))
    return shapely.polygons([(x_m + u * cos - v * sin, y_m + u * sin + v * cos) for u, v in half])


def rounded(area: Any, fillet_radius_m: float) -> Any:
    """Round inner corners to the fillet radius, as on taxiways, and simplify."""
    if fillet_radius_m > 0:
        area = area.buffer(fillet_radius_m).buffer(-fillet_radius_m)
    return area.simplify(SIMPLIFICATION_M)

class WorldTruth(msgspec.Struct, frozen=True):
    """Real intensity of the lights, as factors of the nominal ones; 1 if not listed.

    Only the simulator reads it, from the section `[world]` of the airport's file.
    """

    light_factors: Mapping[str, float] = {}

    def intensity_cd(self, airport: Airport) -> dict[str, float]:
        """Return the real intensity of each light by name, cd."""
        return {light.name: light.nominal_cd * self.light_factors.get(light.name, 1.0)
                for light in airport.lights}
