"""What Osmosis Control keeps: the lights, the route, and how far along it the robot was.

The lights are what must not be forgotten. The route is not needed to go on, the Graph Planner
repeats it; but together with the progress along it, it tells a route that is resumed from another
one, and where the row of lights began that a new route may join in the middle.
"""

from __future__ import annotations

import math

import msgspec

from rampart.actors.osmosis.control.following.light_ledger import LightsKept
from rampart.actors.osmosis.control.polyline import Point, Polyline
from rampart.actors.osmosis.messages import Route
from rampart.actors.runtime.checkpoint import StateFormat

JOIN_M = 0.5
"""A row is prolonged to where it began if that lies within this distance of its straight line."""


class ControlKept(msgspec.Struct, frozen=True):
    """State of Osmosis Control.

    Attributes:
        lights: of the mission.
        route: the one being followed.
        progress_m: arc length along it; None before the first step.
        row_start: first waypoint of the first route to the present goal, in `map`.
    """

    lights: LightsKept = LightsKept()
    route: Route | None = None
    progress_m: float | None = None
    row_start: tuple[float, float] | None = None


def _objection(kept: ControlKept) -> str:
    names = [light.light for light in kept.lights.measured]
    if len(set(names)) < len(names):
        return "a light is measured twice"
    waypoints = kept.route.waypoints if kept.route else ()
    numbers = [*(v for point in waypoints for v in point), *(kept.row_start or ()),
               kept.progress_m or 0.0, *(light.ratio for light in kept.lights.measured)]
    if not all(map(math.isfinite, numbers)):
        return "a number is not finite"
    if kept.route and kept.lights.mission_id != kept.route.mission_id:
        return (f"lights of mission {kept.lights.mission_id!r}, "
                f"route of {kept.route.mission_id!r}")
    return ""


CONTROL_STATE = StateFormat(ControlKept, version=1, objection=_objection)


def whole_row(row_start: Point | None, waypoints: tuple[Point, ...]) -> tuple[Point, ...]:
    """Return a row from where it began, if the route joins it further on; else the route."""
    if row_start is None or len(waypoints) < 2:
        return waypoints
    line = Polyline(waypoints)
    foot = line.project(*row_start)
    (x_m, y_m), heading = waypoints[0], line.heading_at(0.0)
    behind_m = math.cos(heading) * (x_m - row_start[0]) + math.sin(heading) * (y_m - row_start[1])
    aside_m = math.cos(heading) * (y_m - row_start[1]) - math.sin(heading) * (x_m - row_start[0])
    joins = foot.s_m < 1e-6 and behind_m > 0.0 and abs(aside_m) <= JOIN_M
    return (row_start, *waypoints) if joins else waypoints
