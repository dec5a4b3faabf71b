"""Airport, robot, lights and obstacles as entities of a 3D scene, in the `map` frame, metres."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import shapely

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.airport.model import Airport
from rampart.actors.recording import foxglove as fg

MARGIN_M = 4.0
"""Strip of prohibited ground that is drawn round the airport."""

_APRON = (0.0, fg.Color(0.42, 0.44, 0.47, 1.0))
_GROUND = {"taxiway": (0.01, fg.Color(0.36, 0.38, 0.41, 1.0)),
           "runway": (0.02, fg.Color(0.25, 0.26, 0.29, 1.0))}
"""Height in m and colour of the pavement; of any other kind it is like the apron."""

_PROHIBITED = fg.Color(0.75, 0.15, 0.15, 0.45)
_EDGE = fg.Color(0.9, 0.2, 0.2, 1.0)
_GRAPH = fg.Color(0.95, 0.8, 0.2, 0.7)
_BUILDING = fg.Color(0.6, 0.6, 0.65, 1.0)
_ROBOT = fg.Color(0.15, 0.45, 0.85, 1.0)
_OBSTACLE = fg.Color(0.9, 0.5, 0.1, 1.0)
_ROUTE = fg.Color(0.2, 0.8, 0.9, 1.0)
_VERDICT = {None: fg.Color(0.6, 0.6, 0.6, 1.0), m.LightVerdict.OK: fg.Color(0.2, 0.8, 0.3, 1.0),
            m.LightVerdict.DIM: fg.Color(0.95, 0.75, 0.1, 1.0),
            m.LightVerdict.OUT: fg.Color(0.9, 0.15, 0.15, 1.0)}
_EVER = fg.Time(0, 0)
_HERE = fg.pose_at(0.0, 0.0)

FOOTPRINT_M = (0.72, 0.614)
"""Length and width of a Summit XL, if the system does not say otherwise."""

_HEIGHT_M = 0.4


def map_scene(airport: Airport, at: fg.Time) -> fg.SceneUpdate:
    """Return pavement, prohibited area, graph and buildings."""
    ground = tuple(_surface(s.polygon, *_GROUND.get(s.kind, _APRON)) for s in airport.surfaces)
    prohibited = _surface(airport.prohibited_polygon(MARGIN_M), -0.01, _PROHIBITED)
    edges = tuple(_outline(ring) for ring in shapely.get_rings(
        shapely.get_parts(shapely.simplify(airport.allowed, 0.05))))
    graph = fg.LinePrimitive(
        fg.LineType.LINE_LIST, _HERE, 1.0, True,
        tuple(fg.Vector3(*airport.nodes[name], 0.04) for edge in airport.edges for name in edge),
        _GRAPH)
    buildings = tuple(
        fg.CubePrimitive(fg.pose_at(b.x_m, b.y_m, b.height_m / 2, b.yaw_rad),
                         fg.Vector3(b.length_m, b.width_m, b.height_m), _BUILDING)
        for b in airport.buildings)
    return _scene(_entity("ground", at, triangles=ground),
                  _entity("prohibited", at, triangles=(prohibited,), lines=edges),
                  _entity("graph", at, lines=(graph,)), _entity("buildings", at, cubes=buildings))


def lights_scene(airport: Airport, measured: Mapping[str, m.LightMeasurement], at: fg.Time
                 ) -> fg.SceneUpdate:
    """Return the lights, coloured by verdict; grey if not measured."""
    cylinders, texts = [], []
    for light in airport.lights:
        result = measured.get(light.name)
        text = light.name if result is None else (
            f"{light.name} {result.verdict.value} {result.ratio:.0%}")
        colour = _VERDICT[result.verdict if result else None]
        cylinders.append(fg.CylinderPrimitive(
            fg.pose_at(light.x_m, light.y_m, 0.05), fg.Vector3(0.4, 0.4, 0.1), 1.0, 1.0, colour))
        texts.append(fg.TextPrimitive(
            fg.pose_at(light.x_m, light.y_m, 0.8), True, 12.0, True, colour, text))
    return _scene(_entity("lights", at, cylinders=tuple(cylinders), texts=tuple(texts)))


def obstacles_scene(obstacles: Iterable[m.ObstacleCommand], at: fg.Time) -> fg.SceneUpdate:
    """Return the obstacles that are there now."""
    return _scene(_entity("obstacles", at, cylinders=tuple(
        fg.CylinderPrimitive(fg.pose_at(o.x_m, o.y_m, 0.5),
                             fg.Vector3(2 * o.radius_m, 2 * o.radius_m, 1.0), 1.0, 1.0, _OBSTACLE)
        for o in obstacles if o.present)))


def route_scene(route: m.Route, at: fg.Time) -> fg.SceneUpdate:
    """Return the way to the current goal; nothing if there is none."""
    points = tuple(fg.Vector3(x, y, 0.06) for x, y in route.waypoints) if route.active else ()
    return _scene(_entity("route", at, lines=(fg.LinePrimitive(
        fg.LineType.LINE_STRIP, _HERE, 3.0, True, points, _ROUTE),)))


def robot_scene(footprint_m: tuple[float, float], at: fg.Time) -> fg.SceneUpdate:
    """Return the robot as a box with an arrow ahead; it moves with `base_link`."""
    length_m, width_m = footprint_m
    arrow = fg.ArrowPrimitive(
        fg.pose_at(0.0, 0.0, _HEIGHT_M + 0.1), 0.6 * length_m, 0.06, 0.3 * length_m, 0.18, _ROBOT)
    box = fg.CubePrimitive(
        fg.pose_at(0.0, 0.0, _HEIGHT_M / 2), fg.Vector3(length_m, width_m, _HEIGHT_M), _ROBOT)
    return _scene(
        fg.SceneEntity(at, "base_link", "robot", _EVER, True, arrows=(arrow,), cubes=(box,)))


def _scene(*entities: fg.SceneEntity) -> fg.SceneUpdate:
    return fg.SceneUpdate((), entities)


def _entity(name: str, at: fg.Time, **primitives: Any) -> fg.SceneEntity:
    return fg.SceneEntity(at, "map", name, _EVER, False, **primitives)


def _surface(shape: Any, z_m: float, colour: fg.Color) -> fg.TriangleListPrimitive:
    """Return a polygon with holes as triangles."""
    points: list[fg.Vector3] = []
    for part in shapely.get_parts(shapely.simplify(shape, 0.05)):
        if part.geom_type != "Polygon" or part.is_empty:
            continue
        for triangle in shapely.get_parts(shapely.constrained_delaunay_triangles(part)):
            points += [_rounded(x, y, z_m) for x, y in triangle.exterior.coords[:3]]
    return fg.TriangleListPrimitive(_HERE, tuple(points), colour)


def _outline(ring: Any) -> fg.LinePrimitive:
    return fg.LinePrimitive(fg.LineType.LINE_LOOP, _HERE, 2.0, True,
                            tuple(_rounded(x, y, 0.03) for x, y in ring.coords[:-1]), _EDGE)


def _rounded(x_m: float, y_m: float, z_m: float) -> fg.Vector3:
    return fg.Vector3(round(float(x_m), 3), round(float(y_m), 3), z_m)
