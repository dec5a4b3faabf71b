"""What viewers get to see of Osmosis: where it is, what it sees, and the airport round it."""

from __future__ import annotations

import math
from functools import partial

import numpy as np

from rampart.actors.bus.bounds import MOST
from rampart.actors.bus.envelope import Header
from rampart.actors.bus.limits import Remembered
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.osmosis.readings import ray_distances
from rampart.actors.osmosis.recording import scene
from rampart.actors.recording import foxglove as fg
from rampart.actors.recording.views import View, Views, line
from rampart.actors.runtime.application import Application
from rampart.actors.runtime.run_context import NO_SYSTEM
from rampart.manager.spec.schema import SystemSpec


class OsmosisViews(Views):
    """Translates one run of Osmosis; without an airport there are no map and no lights."""

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
        self._footprint_m = (robot.length_m, robot.width_m) if robot else scene.FOOTPRINT_M
        self._odom = m.Pose(0.0, 0.0, 0.0)
        self._lights: dict[str, m.LightMeasurement] = Remembered(MOST)
        self.translators |= {
            topics.POSE: self._pose, topics.ODOMETRY: self._odometry,
            topics.SCAN: partial(_sweep, "view/scan"),
            topics.UPPER_SCAN: partial(_sweep, "view/upper_scan"),
            topics.OBSTACLES: self._obstacles, topics.ROUTE: self._route,
            topics.LIGHT_MEASURED: self._light, topics.MISSION_STATUS: self._mission,
            topics.MISSION_ORDER: self._order, topics.MISSION_ORDER_ANSWER: self._answer}

    def start(self, at_ns: int) -> list[View]:
        """Return what does not depend on any message."""
        at = fg.time_of(at_ns)
        views: list[View] = [("view/robot", scene.robot_scene(self._footprint_m, at))]
        if self._airport is not None:
            views += [("view/map", scene.map_scene(self._airport, at)),
                      ("view/lights", scene.lights_scene(self._airport, {}, at))]
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
        yaw = pose.yaw_rad - odom.yaw_rad  # of odom in map, so that map -> odom -> base_link fits
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
        return [("view/obstacles", scene.obstacles_scene(body.obstacles, fg.time_of(at_ns)))] \
            if self.is_new(key, body.obstacles) else []

    def _route(self, key: str, _header: Header, body: m.Route, at_ns: int) -> list[View]:
        return [("view/route", scene.route_scene(body, fg.time_of(at_ns)))] \
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
        return [("view/lights", scene.lights_scene(self._airport, self._lights, fg.time_of(at_ns)))]

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

    def _order(self, key: str, header: Header, body: m.MissionOrder, at_ns: int) -> list[View]:
        return self._told(key, header, body.order, at_ns,
                          f"order {body.action.value} by {body.by}: {body.reason}")

    def _answer(self, key: str, header: Header, body: m.MissionOrderAnswer, at_ns: int
                ) -> list[View]:
        return self._told(key, header, body.order, at_ns,
                          f"order {'obeyed' if body.accepted else 'refused'}: {body.reason}")

    def _told(self, key: str, header: Header, order: str, at_ns: int, text: str) -> list[View]:
        """Return a line of the log for an order that nothing was told of on that key."""
        return [line(at_ns, fg.LogLevel.INFO, header.source, text)] \
            if self.is_new(key, order) else []


def _finite(pose: m.Pose) -> bool:
    return all(map(math.isfinite, (pose.x_m, pose.y_m, pose.yaw_rad)))


def _sweep(channel: str, _key: str, _header: Header, sweep: m.LaserScan, at_ns: int) -> list[View]:
    count = len(sweep.ranges_f32) // 4
    distances = ray_distances(sweep.ranges_f32, sweep.range_max_m)
    # No echo: at the laser itself, where the robot hides it. JSON has no number that says "none".
    seen = np.round(np.where(np.isfinite(distances), distances, 0.0), 3)
    end_rad = sweep.angle_min_rad + max(0, count - 1) * sweep.angle_increment_rad
    if not (math.isfinite(sweep.angle_min_rad) and math.isfinite(end_rad)):
        return []
    return [(channel, fg.LaserScan(
        fg.time_of(at_ns), "base_link", fg.pose_at(0.0, 0.0, 0.2), sweep.angle_min_rad, end_rad,
        seen.tolist(), []))]
