"""Rampart's airport format: one TOML file, as in `systems/airports/`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import shapely
from shapely.geometry import LineString, Polygon
from shapely.validation import explain_validity

from rampart.actors.osmosis.airport import model
from rampart.actors.osmosis.airport.model import (
    AirportError,
    Name,
    Point,
    Problem,
    Record,
    WorldTruth,
    readable,
)
from rampart.files import toml
from rampart.files.plain_text import shown
from rampart.files.reading import read_text
from rampart.manager.spec.reading import MisfitError, read
from rampart.manager.spec.tables import NonNegative, Positive

SurfaceKind = Literal["runway", "taxiway", "apron", "area"]
Outline = Annotated[tuple[Point, ...], msgspec.Meta(min_length=3)]
T = TypeVar("T")


class _Surface(Record, frozen=True):
    name: Name
    kind: SurfaceKind
    polygon: Outline | None = None
    centre_line: Annotated[tuple[Point, ...], msgspec.Meta(min_length=2)] | None = None
    half_width_m: Positive | None = None


class _Area(Record, frozen=True):
    name: Name
    polygon: Outline


class _Row(Record, frozen=True):
    name: Name
    nominal_cd: Positive
    first: Point | None = None
    last: Point | None = None
    count: Annotated[int, msgspec.Meta(ge=2)] | None = None
    positions: tuple[Point, ...] | None = None


class _Mission(Record, frozen=True):
    goals: tuple[model.MissionGoal, ...]


class _World(Record, frozen=True):
    light_factors: dict[str, Annotated[float, msgspec.Meta(ge=0, le=2)]] = {}


class _File(Record, frozen=True):
    name: Name
    start: model.StartPose
    nodes: dict[str, Point]
    edges: tuple[tuple[str, str], ...]
    surface: tuple[_Surface, ...]
    fillet_radius_m: NonNegative = 0.0
    prohibited: tuple[_Area, ...] = ()
    building: tuple[model.Building, ...] = ()
    row: tuple[_Row, ...] = ()
    missions: dict[str, _Mission] = {}
    obstacle: tuple[model.ObstaclePreset, ...] = ()
    world: _World = _World()


def read_airport(path: Path) -> tuple[model.Airport, WorldTruth]:
    """Read an airport and the real intensities of its lights; the caller checks the geometry.

    Raises:
        AirportError: unreadable, not TOML, or an invalid field or shape.
    """
    file, name = _convert(path, _File), str(path)
    lights = sum(max(row.count or 0, len(row.positions or ())) for row in file.row)
    if lights > model.MAX_LIGHTS:
        raise _error(name, "row", f"{lights} lights", f"expected at most {model.MAX_LIGHTS}")
    surfaces = _surfaces(file.surface, name)
    prohibited = [_polygon(area.polygon, f"prohibited[{i}].polygon", name)
                  for i, area in enumerate(file.prohibited)]
    for table in ("surface", "prohibited", "building", "row"):
        for twice in model.repeated(part.name for part in getattr(file, table)):
            raise _error(name, table, repr(twice), "duplicate name")
    solid = [building.polygon for building in file.building]
    pavement = [part.polygon for part in surfaces]
    allowed = shapely.unary_union(pavement)
    allowed = model.rounded(allowed, file.fillet_radius_m)
    allowed = allowed.difference(shapely.unary_union([*prohibited, *solid]))
    placed = tuple(light for i, row in enumerate(file.row) for light in _lights(row, i, name))
    missions = {key: model.Mission(key, mission.goals) for key, mission in file.missions.items()}
    airport = model.Airport(file.name, file.nodes, file.edges, allowed, file.start, surfaces,
                            file.building, placed, missions, file.obstacle)
    return airport, _truth(file.world, airport, name)


def read_mission(path: Path) -> model.Mission:
    """Read a mission file: `name` and `goals` as in an airport file.

    Raises:
        AirportError: as `read_airport`.
    """
    return _convert(path, model.Mission)


def _convert(path: Path, kind: type[T]) -> T:
    with readable(path, "see https://toml.io"):
        table = toml.parse(read_text(path, model.MAX_FILE_BYTES), model.MAX_FILE_BYTES)
    _check_numbers(table, "", str(path))
    try:
        return read(table, kind, "")
    except MisfitError as error:
        where, problem, value = error.finding
        said = f"{shown(value[0])}: " if value else ""
        raise AirportError(f"{path}: {where.lstrip('.') or 'file'}: {said}{problem}") from None


def _check_numbers(value: Any, path: str, file: str) -> None:
    """Refuse NaN, infinities and implausibly large numbers."""
    if isinstance(value, float) and not math.isfinite(value):
        raise _error(file, path.lstrip("."), value, "must be a finite number")
    if isinstance(value, (int, float)) and abs(value) > model.MAX_NUMBER:
        raise _error(file, path.lstrip("."), shown(value),
                     f"must be between -{model.MAX_NUMBER:g} and {model.MAX_NUMBER:g}")
    if isinstance(value, dict):
        for key, part in value.items():
            _check_numbers(part, f"{path}.{key}", file)
    elif isinstance(value, list):
        for i, part in enumerate(value):
            _check_numbers(part, f"{path}[{i}]", file)


def _surfaces(parts: tuple[_Surface, ...], file: str) -> tuple[model.Surface, ...]:
    surfaces = []
    for i, part in enumerate(parts):
        where, half_m = f"surface[{i}]", part.half_width_m
        if (part.polygon is None) == (part.centre_line is None):
            raise _error(file, where, part.name, "expected either polygon or centre_line")
        if part.polygon is not None:
            shape = _polygon(part.polygon, f"{where}.polygon", file)
        elif half_m is None:
            raise _error(file, f"{where}.half_width_m", half_m, "missing beside centre_line")
        else:
            line = LineString(part.centre_line)
            shape = line.buffer(half_m, cap_style="flat" if part.kind == "runway" else "round")
        surfaces.append(model.Surface(part.name, part.kind, shape))
    return tuple(surfaces)


def _polygon(points: tuple[Point, ...], where: str, file: str) -> Any:
    shape = Polygon(points)
    if not shape.is_valid or shape.area == 0:
        raise _error(file, where, explain_validity(shape), "must not cross itself")
    return shape


def _lights(row: _Row, i: int, file: str) -> list[model.Light]:
    where = f"row[{i}]"
    spaced = row.first is not None and row.last is not None and row.count is not None
    if spaced == (row.positions is not None):
        raise _error(file, where, row.name, "expected either first, last and count, or positions")
    points = row.positions or ()
    if row.first is not None and row.last is not None and row.count is not None:
        (ax, ay), (bx, by), gaps = row.first, row.last, row.count - 1
        points = tuple(
            (ax + (bx - ax) * k / gaps, ay + (by - ay) * k / gaps) for k in range(row.count))
    return [model.Light(f"{row.name}{k:02d}", row.name, x_m, y_m, row.nominal_cd)
            for k, (x_m, y_m) in enumerate(points, start=1)]


def _truth(world: _World, airport: model.Airport, file: str) -> WorldTruth:
    known = {light.name for light in airport.lights}
    for name in world.light_factors:
        if name not in known:
            raise _error(file, f"world.light_factors.{name}", repr(name),
                         "unknown light; expected one of a row, e.g. A01")
    return WorldTruth(world.light_factors)


def _error(file: str, where: str, value: object, remedy: str) -> AirportError:
    return AirportError(Problem(where, str(value), remedy).line(file))
