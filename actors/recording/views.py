"""What viewers get to see: the robot's own messages translated, channel by channel.

The robot's messages are recorded as they are, whatever becomes of their translation here. A scene
has one channel per subject, and each message on it holds all of it: a viewer that jumps to a time
is given the last message of each channel before it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.bounds import MANY, MOST
from rampart.actors.bus.envelope import Header
from rampart.actors.bus.limits import Remembered
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.model import Airport
from rampart.actors.recording import foxglove as fg
from rampart.actors.recording import scene
from rampart.manager.strategies.decision_words import decision_in_words

View = tuple[str, fg.Record]
"""Channel and what is to be seen on it."""

CHANNELS: dict[str, type[fg.Record]] = {
    "view/tf": fg.FrameTransforms, "view/pose": fg.PoseInFrame, "view/scan": fg.LaserScan,
    "view/upper_scan": fg.LaserScan, "view/map": fg.SceneUpdate, "view/lights": fg.SceneUpdate,
    "view/obstacles": fg.SceneUpdate, "view/route": fg.SceneUpdate,
    "view/robot": fg.SceneUpdate, "view/log": fg.Log}
"""All channels, with the type of their messages."""

_ROUTINE = ("started", "running")
_GOOD_NEWS = ("respawned", "resumed", "adopted")


class Views:
    """Translates one run, message by message.

    Args:
        airport: for map and lights; None draws neither.
        footprint_m: length and width of the robot; None for a Summit XL's.
    """

    def __init__(self, airport: Airport | None = None,
                 footprint_m: tuple[float, float] | None = None) -> None:
        self._airport = airport
        self._footprint_m = footprint_m or scene.FOOTPRINT_M
        self._odom = m.Pose(0.0, 0.0, 0.0)
        self._lights: dict[str, m.LightMeasurement] = Remembered(MOST)
        self._seen: dict[str, Any] = Remembered(MANY)
        self._translators: dict[str, Callable[[str, Header, Any, int], list[View]]] = {
            topics.POSE.key: self._pose, topics.ODOMETRY.key: self._odometry,
            topics.SCAN.key: self._scan, topics.UPPER_SCAN.key: self._upper_scan,
            topics.OBSTACLES.key: self._obstacles, topics.ROUTE.key: self._route,
            topics.LIGHT_MEASURED.key: self._light, topics.MISSION_STATUS.key: self._mission,
            ftm_topics.DECISION.key: self._decision, ftm_topics.PROCESS_EVENT.key: self._process,
            bus_topics.DIAGNOSTIC.key: self._diagnostic, ftm_topics.DETECTION.key: self._detection,
            bus_topics.INJECTION_REPORT.key: self._injection,
            topics.MISSION_ORDER.key: self._order,
            topics.MISSION_ORDER_ANSWER.key: self._answer}

    def start(self, at_ns: int) -> list[View]:
        """Return what does not depend on any message."""
        at = fg.time_of(at_ns)
        views: list[View] = [("view/robot", scene.robot_scene(self._footprint_m, at))]
        if self._airport is not None:
            views += [("view/map", scene.map_scene(self._airport, at)),
                      ("view/lights", scene.lights_scene(self._airport, {}, at))]
        return views

    def of(self, topic: Topic[Any], key: str, header: Header, body: Any, at_ns: int
           ) -> list[View]:
        """Return what a message makes visible.

        Args:
            topic: which.
            key: full key.
            header: of the message.
            body: of the message.
            at_ns: time of the recording.
        """
        translate = self._translators.get(topic.key)
        if translate is None:
            return []
        return translate(key, header, body, at_ns)

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

    def _scan(self, _key: str, _header: Header, sweep: m.LaserScan, at_ns: int) -> list[View]:
        return _sweep("view/scan", sweep, at_ns)

    def _upper_scan(self, _key: str, _header: Header, sweep: m.LaserScan, at_ns: int
                    ) -> list[View]:
        return _sweep("view/upper_scan", sweep, at_ns)

    # -- the scene ------------------------------------------------------------------------------

    def _obstacles(self, key: str, _header: Header, body: m.ObstacleList, at_ns: int
                   ) -> list[View]:
        if not self._is_new(key, body.obstacles):
            return []
        return [("view/obstacles", scene.obstacles_scene(body.obstacles, fg.time_of(at_ns)))]

    def _route(self, key: str, _header: Header, body: m.Route, at_ns: int) -> list[View]:
        if not self._is_new(key, (body.active, body.waypoints)):
            return []
        return [("view/route", scene.route_scene(body, fg.time_of(at_ns)))]

    def _light(self, _key: str, _header: Header, body: m.LightMeasurement, at_ns: int
               ) -> list[View]:
        return self._measured((body,), at_ns)

    def _measured(self, lights: tuple[m.LightMeasurement, ...], at_ns: int) -> list[View]:
        new = {light.light: light for light in lights if self._lights.get(light.light) != light}
        if not new or self._airport is None:
            return []
        for name, light in new.items():
            self._lights[name] = light
        return [("view/lights", scene.lights_scene(
            self._airport, self._lights, fg.time_of(at_ns)))]

    # -- the log --------------------------------------------------------------------------------

    def _mission(self, key: str, header: Header, body: m.MissionStatus, at_ns: int) -> list[View]:
        views = self._measured(body.lights, at_ns)
        if body.goals and self._is_new(key, (body.mission_id, body.phase, body.step, body.reason)):
            why = f": {body.reason}" if body.reason else ""
            failed = body.phase in (m.MissionPhase.FAILED, m.MissionPhase.CANCELLED)
            views.append(_line(
                at_ns, fg.LogLevel.WARNING if failed else fg.LogLevel.INFO, header.source,
                f"mission {body.name} {body.phase.value}, {body.step} of {len(body.goals)} goals "
                f"reached{why}"))
        return views

    def _decision(self, key: str, header: Header, body: fm.DecisionRecord, at_ns: int
                  ) -> list[View]:
        words = decision_in_words(body.active, body.rule, body.recoveries, body.strategy)
        level = fg.LogLevel.WARNING if body.active else fg.LogLevel.INFO
        return self._event(key, header, at_ns, level, f"decision {body.decision}: {words}")

    def _process(self, key: str, header: Header, body: fm.ProcessEvent, at_ns: int) -> list[View]:
        if body.event in _ROUTINE:
            return []
        level = fg.LogLevel.INFO if body.event in _GOOD_NEWS else fg.LogLevel.WARNING
        by = f" by {body.by}" if body.by else ""
        detail = f": {body.detail}" if body.detail else ""
        return self._event(key, header, at_ns, level, f"{body.node} {body.event}{by}{detail}")

    def _diagnostic(self, key: str, header: Header, body: bm.Diagnostic, at_ns: int) -> list[View]:
        return self._event(key, header, at_ns, fg.LogLevel.ERROR,
                           f"{body.context}: {body.reason} [{body.offender}]")

    def _detection(self, key: str, header: Header, body: fm.DetectionReport, at_ns: int
                   ) -> list[View]:
        was = self._seen.get(key)
        if not self._is_new(key, body.state) or (
                was is None and body.state is fm.DetectionState.IDLE):
            return []
        active = body.state is fm.DetectionState.ACTIVE
        return [_line(at_ns, fg.LogLevel.WARNING if active else fg.LogLevel.INFO, header.source,
                      f"detects: {body.reason}" if active else "is idle again")]

    def _injection(self, key: str, header: Header, body: bm.InjectionReport, at_ns: int
                   ) -> list[View]:
        if not self._is_new(f"{key} {body.injection}", (body.affected > 0, body.finished)):
            return []
        what = "is over" if body.finished else "is in force"
        why = f": {body.reason}" if body.reason else ""
        return [_line(at_ns, fg.LogLevel.WARNING, header.source,
                      f"injection {body.injection} {what}, {body.affected} affected{why}")]

    def _order(self, key: str, header: Header, body: m.MissionOrder, at_ns: int) -> list[View]:
        if not self._is_new(key, body.order):
            return []
        return [_line(at_ns, fg.LogLevel.INFO, header.source,
                      f"order {body.action.value} by {body.by}: {body.reason}")]

    def _answer(self, key: str, header: Header, body: m.MissionOrderAnswer, at_ns: int
                ) -> list[View]:
        if not self._is_new(key, body.order):
            return []
        return [_line(at_ns, fg.LogLevel.INFO, header.source,
                      f"order {'obeyed' if body.accepted else 'refused'}: {body.reason}")]

    def _event(self, key: str, header: Header, at_ns: int, level: fg.LogLevel, text: str
               ) -> list[View]:
        """Return a line for a message that counts, once for all its copies."""
        if not self._is_new(key, (header.source, header.incarnation, header.sequence)):
            return []
        return [_line(at_ns, level, header.source, text)]

    def _is_new(self, what: str, value: Any) -> bool:
        if what in self._seen and self._seen[what] == value:
            return False
        self._seen[what] = value
        return True


def _finite(pose: m.Pose) -> bool:
    return all(map(math.isfinite, (pose.x_m, pose.y_m, pose.yaw_rad)))


def _sweep(channel: str, sweep: m.LaserScan, at_ns: int) -> list[View]:
    count = len(sweep.ranges_f32) // 4
    ranges = np.frombuffer(sweep.ranges_f32, dtype="<f4", count=count)
    # No echo: at the laser itself, where the robot hides it. JSON has no number that says "none".
    with np.errstate(over="ignore", invalid="ignore"):  # a range may be anything
        echo = np.isfinite(ranges) & (ranges < sweep.range_max_m)
    seen = np.round(np.where(echo, ranges, 0.0).astype(np.float64), 3)
    end_rad = sweep.angle_min_rad + max(0, count - 1) * sweep.angle_increment_rad
    if not (math.isfinite(sweep.angle_min_rad) and math.isfinite(end_rad)):
        return []
    return [(channel, fg.LaserScan(
        fg.time_of(at_ns), "base_link", fg.pose_at(0.0, 0.0, 0.2), sweep.angle_min_rad, end_rad,
        seen.tolist(), []))]


def _line(at_ns: int, level: fg.LogLevel, name: str, text: str) -> View:
    return "view/log", fg.Log(fg.time_of(at_ns), level, text, name)


encode: Callable[[fg.Record], bytes] = msgspec.json.Encoder().encode
"""Returns what stands in the file."""
