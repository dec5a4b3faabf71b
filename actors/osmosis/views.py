"""Foxglove views of Osmosis: frames, pose, sweeps, log, and the airport as a 3D scene.

Scenes are in the `map` frame, metres.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np
import shapely

from rampart.actors.bus.bounds import MOST
from rampart.actors.bus.envelope import Header
from rampart.actors.bus.limits import Remembered
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.model import Airport
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.osmosis.readings import ray_distances
from rampart.actors.recording import foxglove as fg
from rampart.actors.recording.views import View, Views, line
from rampart.actors.runtime.application import Application
from rampart.actors.runtime.run_context import NO_SYSTEM
from rampart.manager.spec.schema import SystemSpec

MARGIN_M = 4.0
"""Width of the prohibited strip drawn around the airport."""

_APRON = (0.0, fg.Color(0.42, 0.44, 0.47, 1.0))
_GROUND = {"taxiway": (0.01, fg.Color(0.36, 0.38, 0.41, 1.0)),
           "runway": (0.02, fg.Color(0.25, 0.26, 0.29, 1.0))}
"""Height in m and colour of surfaces; other kinds are drawn like the apron."""

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
"""Length and width of a Summit XL, for a system without them."""

_HEIGHT_M = 0.4


class OsmosisViews(Views):
    """Translates a run of Osmosis; without an airport there is no map and there are no lights."""

    channels = {**Views.channels,
        "view/tf": fg.FrameTransforms, "view/pose": fg.PoseInFrame, "view/scan": fg.LaserScan,
        "view/upper_scan": fg.LaserScan, "view/map": fg.SceneUpdate, "view/lights": fg.SceneUpdate,
        "view/obstacles": fg.SceneUpdate, "view/route": fg.SceneUpdate,
        "view/robot": fg.SceneUpdate}

    def __init__(self, application: Application | None = None,
                 system: SystemSpec = NO_SYSTEM) -> None:
        super().__init__(application, system)
        robot = system.mobile
        self._airport = application.airport if isinstance(application, Osmosis) else None
        self._footprint_m = (robot.length_m, robot.width_m) if robot else FOOTPRINT_M
        self._odom = m.Pose(0.0, 0.0, 0.0)
        self._lights: dict[str, m.LightMeasurement] = Remembered(MOST)
        self.translators |= {
            topics.POSE: self._pose, topics.ODOMETRY: self._odometry,
            topics.SCAN: partial(_sweep, "view/scan"),
            topics.UPPER_SCAN: partial(_sweep, "view/upper_scan"),
            topics.OBSTACLES: self._obstacles, topics.ROUTE: self._route,
            topics.LIGHT_MEASURED: self._light, topics.MISSION_STATUS: self._mission}

    def start(self, at_ns: int) -> list[View]:
        """Return the views that depend on no message."""
        at = fg.time_of(at_ns)
        views: list[View] = [("view/robot", robot_scene(self._footprint_m, at))]
        if self._airport is not None:
            views += [("view/map", map_scene(self._airport, at)),
                      ("view/lights", lights_scene(self._airport, {}, at))]
        return views

    # -- where things are -----------------------------------------------------------------------

    def _odometry(self, _key: str, _header: Header, body: m.Odometry, _at_ns: int) -> list[View]:
        if _finite(body.pose):
            self._odom = body.pose
        return []

    def _pose(self, _key: str, _header: Header, pose: m.Pose, at_ns: int) -> list[View]:
        if not _finite(pose):
            return []
        at, odom = fg.time_of(at_ns), self._odom
        yaw = pose.yaw_rad - odom.yaw_rad  # of odom in map, for map -> odom -> base_link
        cos, sin = math.cos(yaw), math.sin(yaw)
        x_m = pose.x_m - (cos * odom.x_m - sin * odom.y_m)
        y_m = pose.y_m - (sin * odom.x_m + cos * odom.y_m)
        return [
            ("view/tf", fg.FrameTransforms((
                fg.FrameTransform(at, "map", "odom", fg.Vector3(x_m, y_m, 0.0), fg.turned(yaw)),
                fg.FrameTransform(at, "odom", "base_link", fg.Vector3(odom.x_m, odom.y_m, 0.0),
                                  fg.turned(odom.yaw_rad))))),
            ("view/pose", fg.PoseInFrame(
                at, "map", fg.pose_at(pose.x_m, pose.y_m, 0.0, pose.yaw_rad)))]

    # -- the scene ------------------------------------------------------------------------------

    def _obstacles(self, key: str, _header: Header, body: m.ObstacleList, at_ns: int) -> list[View]:
        return [("view/obstacles", obstacles_scene(body.obstacles, fg.time_of(at_ns)))] \
            if self.is_new(key, body.obstacles) else []

    def _route(self, key: str, _header: Header, body: m.Route, at_ns: int) -> list[View]:
        return [("view/route", route_scene(body, fg.time_of(at_ns)))] \
            if self.is_new(key, (body.active, body.waypoints)) else []

    def _light(self, _key: str, _header: Header, body: m.LightMeasurement, at_ns: int
               ) -> list[View]:
        return self._measured((body,), at_ns)

    def _measured(self, lights: tuple[m.LightMeasurement, ...], at_ns: int) -> list[View]:
        new = {light.light: light for light in lights if self._lights.get(light.light) != light}
        if not new or self._airport is None:
            return []
        for name, light in new.items():
            self._lights[name] = light
        return [("view/lights", lights_scene(self._airport, self._lights, fg.time_of(at_ns)))]

    # -- the log --------------------------------------------------------------------------------

    def _mission(self, key: str, header: Header, body: m.MissionStatus, at_ns: int) -> list[View]:
        views = self._measured(body.lights, at_ns)
        if body.goals and self.is_new(key, (body.mission_id, body.phase, body.step, body.reason)):
            why = f": {body.reason}" if body.reason else ""
            failed = body.phase in (m.MissionPhase.FAILED, m.MissionPhase.CANCELLED)
            views.append(line(
                at_ns, fg.LogLevel.WARNING if failed else fg.LogLevel.INFO, header.source,
                f"mission {body.name} {body.phase.value}, {body.step} of {len(body.goals)} goals "
                f"reached{why}"))
        return views


def _finite(pose: m.Pose) -> bool:
    return all(map(math.isfinite, (pose.x_m, pose.y_m, pose.yaw_rad)))


def _sweep(channel: str, _key: str, _header: Header, sweep: m.LaserScan, at_ns: int) -> list[View]:
    count = len(sweep.ranges_f32) // 4
    distances = ray_distances(sweep.ranges_f32, sweep.range_max_m)
    # No echo: 0, where the robot hides the point, since JSON has no infinity.
    seen = np.round(np.where(np.isfinite(distances), distances, 0.0), 3)
    end_rad = sweep.angle_min_rad + max(0, count - 1) * sweep.angle_increment_rad
    if not (math.isfinite(sweep.angle_min_rad) and math.isfinite(end_rad)):
        return []
    return [(channel, fg.LaserScan(
        fg.time_of(at_ns), "base_link", fg.pose_at(0.0, 0.0, 0.2), sweep.angle_min_rad, end_rad,
        seen.tolist(), []))]


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
    """Return the lights, coloured by verdict; unmeasured ones are grey."""
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
    """Return the present obstacles."""
    return _scene(_entity("obstacles", at, cylinders=tuple(
        fg.CylinderPrimitive(fg.pose_at(o.x_m, o.y_m, 0.5),
                             fg.Vector3(2 * o.radius_m, 2 * o.radius_m, 1.0), 1.0, 1.0, _OBSTACLE)
        for o in obstacles if o.present)))


def route_scene(route: m.Route, at: fg.Time) -> fg.SceneUpdate:
    """Return the route to the current goal, if there is one."""
    points = tuple(fg.Vector3(x, y, 0.06) for x, y in route.waypoints) if route.active else ()
    return _scene(_entity("route", at, lines=(fg.LinePrimitive(
        fg.LineType.LINE_STRIP, _HERE, 3.0, True, points, _ROUTE),)))


def robot_scene(footprint_m: tuple[float, float], at: fg.Time) -> fg.SceneUpdate:
    """Return the robot as a box with an arrow; it moves with `base_link`."""
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
