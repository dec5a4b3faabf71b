"""State that the page of Osmosis shows in addition: pose, lasers, route, mission, lights. Pure."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Iterable, Sequence
from typing import Any

import numpy as np

from rampart.actors.operator.picture import MAX_NAME, Bounds
from rampart.actors.operator.state import Heard, HmiState
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.messages import LaserScan
from rampart.actors.osmosis.page.map import MAX_LIGHTS
from rampart.actors.osmosis.readings import ray_distances

POINTS = 91
"""Most points of a sweep on the page."""

MAX_RANGE_M = 1000.0
"""Largest plausible echo."""

TRACK_STEP_M = 0.25
"""Distance between two points of the track."""

TRACK_POINTS = 4000

_ROUTE = Bounds(items=1000)
_LIGHTS = Bounds(items=MAX_LIGHTS)


class OsmosisState(HmiState):
    """The state of Osmosis as the operator sees it.

    Args:
        lights: names of the lights on the map; None for any, up to `MAX_LIGHTS`.

    Attributes:
        track: past positions, (x, y) in `map`.
    """

    def __init__(self, lights: Collection[str] | None = None) -> None:
        super().__init__()
        self._lights = None if lights is None else frozenset(lights)
        self._mission_id = ""
        self.track: deque[tuple[float, float]] = deque(maxlen=TRACK_POINTS)
        self.aged("control", "pilot", "pose")
        self.aged("laser", "upper_laser", show=_sweep)
        self.aged("mission", show=_mission)
        self.picture.section("route", (), _route, _ROUTE)
        self.picture.section("obstacles", ())
        self.picture.section("lights", {}, bounds=_LIGHTS)

    def pose(self, pose: m.Pose, stamp_s: float, now_s: float) -> None:
        """Keep the pose, and a point of the track if the robot has moved."""
        self.put("pose", Heard(pose, False, round(stamp_s, 4)), now_s)
        at = (pose.x_m, pose.y_m)
        if all(map(math.isfinite, at)) and (
                not self.track or math.dist(self.track[-1], at) >= TRACK_STEP_M):
            self.track.append((round(pose.x_m, 2), round(pose.y_m, 2)))

    def laser(self, which: str, scan: m.LaserScan, now_s: float) -> None:
        """Keep a sweep of "laser" or "upper_laser"."""
        self.put(which, Heard(scan), now_s)

    def route(self, route: m.Route) -> None:
        """Keep the route to the goal, if there is a goal."""
        self.picture.put("route", route.waypoints if route.active else ())

    def obstacles(self, obstacles: m.ObstacleList) -> None:
        """Keep the present obstacles."""
        self.picture.put("obstacles", tuple(o for o in obstacles.obstacles if o.present))

    def mission(self, status: m.MissionStatus, now_s: float) -> None:
        """Keep the mission's state; a new mission starts with unmeasured lights."""
        if status.mission_id and status.mission_id != self._mission_id:
            self._mission_id = status.mission_id
            self.picture.put("lights", {})
        self.keep("mission", status, now_s)
        self.lights(status.lights)

    def lights(self, measured: Iterable[m.LightMeasurement]) -> None:
        """Keep the measurements of lights on the map."""
        rows = dict(self.picture.value("lights"))
        for each in measured:
            name = each.light
            is_shown = name in rows or (len(rows) < MAX_LIGHTS and len(name) <= MAX_NAME)
            if is_shown and (self._lights is None or name in self._lights):
                rows[name] = {"verdict": each.verdict, "ratio": round(each.ratio, 3),
                              "intensity_cd": round(each.intensity_cd, 1)}
        self.picture.put("lights", rows)


def _sweep(heard: Heard | None) -> dict[str, Any] | None:
    return None if heard is None or heard.stale else thin(heard.value)


def _route(waypoints: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    return [(round(x, 2), round(y, 2)) for x, y in waypoints]


def _mission(heard: Heard | None) -> dict[str, Any] | None:
    if heard is None:
        return None
    status: m.MissionStatus = heard.value
    return {"name": status.name, "phase": status.phase, "step": status.step, "goals": status.goals,
            "times_s": status.step_times_s, "reason": status.reason, "stale": heard.stale,
            "orders": status.orders, "skipped": status.skipped}


def thin(scan: LaserScan | None) -> dict[str, Any] | None:
    """Return a sweep reduced to `POINTS` for the page, in `base_link`.

    A point is the nearest echo of neighbouring rays and not their mean: an obstacle that only one
    ray has hit must not vanish.

    Returns:
        `from_rad` and `step_rad`, the angle of the first point and between two; `max_m`, the range
        of the laser; `cm`, the ranges in whole centimetres, -1 without an echo. None for an invalid
        sweep and for no sweep.
    """
    if scan is None or len(scan.ranges_f32) % 4 or len(scan.ranges_f32) < 8 \
            or not all(map(math.isfinite, (scan.angle_min_rad, scan.angle_increment_rad))) \
            or not 0 < scan.range_max_m < math.inf:
        return None
    ranges = ray_distances(scan.ranges_f32, scan.range_max_m)
    rays = -(-len(ranges) // POINTS)
    padded = np.full(-(-len(ranges) // rays) * rays, np.inf)
    padded[:len(ranges)] = np.nan_to_num(ranges, nan=np.inf, posinf=np.inf)
    nearest = padded.reshape(-1, rays).min(axis=1)
    echo = nearest < min(scan.range_max_m, MAX_RANGE_M) - 0.005
    centimetres = np.where(echo, np.round(100 * np.where(echo, nearest, 0)), -1).astype(int)
    return {"from_rad": round(scan.angle_min_rad + scan.angle_increment_rad * (rays - 1) / 2, 5),
            "step_rad": round(scan.angle_increment_rad * rays, 6), "max_m": scan.range_max_m,
            "cm": centimetres.tolist()}
