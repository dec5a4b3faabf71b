"""Core of Osmosis Control and its standby: from route, pose and sweep to the command. Pure.

It takes messages and the time, and returns commands, measurements and the status. Extensions to the
paper's node are optional parts: a check of routes, dead reckoning, a loop on the turn rate.

Its checkpoint holds the lights and the route with its progress. The Graph Planner repeats the
route, but the saved one identifies a resumed route, and the start of a row of lights that a new
route joins in the middle.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec
import numpy as np

from rampart.actors.bus.bounds import clip
from rampart.actors.ftm.plausible import is_sane
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.airport.model import Airport
from rampart.actors.osmosis.airport.route_check import RouteCheck
from rampart.actors.osmosis.control.following.dead_reckoning import DeadReckoning
from rampart.actors.osmosis.control.following.light_ledger import LightsKept, RowInspection
from rampart.actors.osmosis.control.following.light_row import LightRow, RowLimits
from rampart.actors.osmosis.control.following.motion_loop import MotionLoop
from rampart.actors.osmosis.control.following.path_follower import Motion, PathFollower
from rampart.actors.osmosis.control.limits_from_spec import hull_of, motion_of, reach_of
from rampart.actors.osmosis.control.pilot.laser_pair import LaserPair
from rampart.actors.osmosis.control.polyline import Array, Point, Polyline, Pose2, to_map
from rampart.actors.osmosis.messages import Blockage
from rampart.actors.osmosis.readings import is_odometry, is_pose
from rampart.actors.runtime.checkpoint import StateFormat
from rampart.manager.spec.schema import SystemSpec

BLOCKED_AFTER_S, PROGRESS_M = 3.0, 0.3
"""Time without progress that counts as a blockage, and least progress along the route."""

BLOCKAGE_M, BLOCKAGE_RAD = 3.0, math.radians(60)
"""Greatest distance of its echo from the robot's centre, and greatest bearing."""


class BlockageWatch:
    """Detects whether something on one route blocks the robot, and since when.

    The criterion is progress along the route, and not the state of the follower or the Safety
    Pilot: a robot that turns back and forth in front of a crate is blocked too. An echo ahead is
    required: a robot that a recovery holds on an empty runway is not blocked. Times are simulated
    seconds.
    """

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """Restart for another route."""
        self._best_m = math.inf
        self._since_s: float | None = None
        self._place: Point | None = None

    def update(self, to_go_m: float, pose: Pose2, points: Array, now_s: float) -> Blockage | None:
        """Return the blockage, or None.

        Args:
            to_go_m: distance to the goal along the route.
            pose: (x, y, yaw) in `map`.
            points: laser echoes in `base_link`, shape (n, 2).
            now_s: now.
        """
        if self._since_s is None or to_go_m < self._best_m - PROGRESS_M:
            self._best_m, self._since_s, self._place = to_go_m, now_s, None
            return None
        if now_s - self._since_s < BLOCKED_AFTER_S:
            return None
        # The first echo stays the blockage, so that its place is stable while the robot turns.
        self._place = self._place or nearest_ahead(points, pose)
        if self._place is None:
            return None
        return Blockage(*self._place, self._since_s)


def nearest_ahead(points: Array, pose: Pose2) -> Point | None:
    """Return the nearest echo ahead of the robot as a point in `map`, or None."""
    distance_m = np.hypot(points[:, 0], points[:, 1])
    ahead = np.abs(np.arctan2(points[:, 1], points[:, 0])) <= BLOCKAGE_RAD
    near = np.flatnonzero(ahead & (distance_m <= BLOCKAGE_M))
    if not len(near):
        return None
    first = near[int(np.argmin(distance_m[near]))]
    x_m, y_m = to_map(points[first:first + 1], *pose)[0].tolist()
    return x_m, y_m


PERIOD_S = 0.05

_ASIDE_M = 0.1
"""Change of the lateral offset that is published at once if there is a standby."""
_ACTIVE_SILENT_S = 0.6
"""Time without a status, three periods, after which the standby's loop is the active one."""
JOIN_M = 0.5
"""Greatest distance of the row's start from the line of a route that joins the row later."""


class ControlKept(msgspec.Struct, frozen=True):
    """State of Osmosis Control.

    Attributes:
        lights: ledger of the mission.
        route: current route.
        progress_m: arc length along it; None before the first step.
        row_start: first waypoint of the first route to the current goal, in `map`.
    """

    lights: LightsKept = LightsKept()
    route: m.Route | None = None
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
    """Return the row from its start if the route joins it later, else the route."""
    if row_start is None or len(waypoints) < 2:
        return waypoints
    line = Polyline(waypoints)
    foot = line.project(*row_start)
    (x_m, y_m), heading = waypoints[0], line.heading_at(0.0)
    behind_m = math.cos(heading) * (x_m - row_start[0]) + math.sin(heading) * (y_m - row_start[1])
    aside_m = math.cos(heading) * (y_m - row_start[1]) - math.sin(heading) * (x_m - row_start[0])
    joins = foot.s_m < 1e-6 and behind_m > 0.0 and abs(aside_m) <= JOIN_M
    return (row_start, *waypoints) if joins else waypoints


class RouteControl:
    """Follows the current route. Times are simulated seconds.

    Without `bridge` it computes from the last pose, however old, as in the paper: FTM6 handles a
    stale pose.

    Args:
        system: the robot, and whether checkpoints are used.
        airport: the airport.
        report: reports a problem: context, reason, offender.
        now_s: now.
        row: parameters for rows of lights.
        lights: the inspection; without lights for a standby.
        check: checks a route before it is followed. After a refusal the robot stands, or keeps its
            good route to the same goal.
        bridge: gives the pose while localization is stale; beyond its bound the robot stops.
        loop: corrects the turn rate.
        has_standby: whether a standby follows, which needs changes of the lateral offset at once.

    Attributes:
        status: the newest status.
    """

    def __init__(
        self, system: SystemSpec, airport: Airport, report: Callable[[str, str, str], None],
        now_s: float, row: RowLimits, *, lights: RowInspection,
        check: RouteCheck | None = None, bridge: DeadReckoning | None = None,
        loop: MotionLoop | None = None, has_standby: bool = False,
    ) -> None:
        self._airport, self._report = airport, report
        self._hull, self._limits, self._row = hull_of(system), motion_of(system), row
        self._resumes = system.layers.checkpoints
        self._lights, self._check, self._bridge, self._loop = lights, check, bridge, loop
        self._has_standby = has_standby
        self._lasers = LaserPair(reach_of(system))
        self._watch = BlockageWatch()
        self._pose: Pose2 | None = None
        self._points: Array | None = None
        self._goal: m.GoalOrder | None = None
        self._route: m.Route | None = None
        self._refused: m.Route | None = None
        self._why_refused = ""
        self._follower: PathFollower | LightRow | None = None
        self._motion: Motion | None = None
        self._blocked: m.Blockage | None = None
        self._row_start: tuple[float, float] | None = None
        self._last = ControlKept()
        self._stepped_s = now_s
        self._begun = False
        self.status = m.ControlStatus("", 0, m.ControlPhase.IDLE, 0, 0.0)

    # -- checkpoint -----------------------------------------------------------------------------

    @property
    def kept(self) -> ControlKept | None:
        """State for a successor; None if there is nothing to save."""
        route = self._route
        if route is None or not self._resumes:
            return None
        return ControlKept(
            self._lights.ledger.kept, route,
            self._follower.progress_m if self._follower else None, self._row_start)

    def restore(self, kept: ControlKept) -> None:
        """Restore the state of a predecessor; the robot continues when the route arrives."""
        self._last, self._row_start = kept, kept.row_start
        self._lights.ledger.restore(kept.lights)

    # -- inputs ---------------------------------------------------------------------------------

    def pose(self, pose: m.Pose, stamp_s: float, now_s: float) -> None:
        """Take a pose in `map`."""
        if not is_pose(pose):
            return
        place = (pose.x_m, pose.y_m, pose.yaw_rad)
        if self._bridge:
            self._bridge.pose(stamp_s, place, now_s)
        self._pose = place
        self._lights.inspection.pose(stamp_s, *place)
        if self._loop:
            self._loop.pose(stamp_s, *place)

    def odometry(self, odometry: m.Odometry, stamp_s: float, now_s: float) -> None:
        """Take odometry."""
        pose = odometry.pose
        if self._bridge and is_odometry(odometry):
            self._bridge.odometry(stamp_s, (pose.x_m, pose.y_m, pose.yaw_rad), now_s)

    def scan(self, laser: int, sweep: m.LaserScan, stamp_s: float, now_s: float) -> None:
        """Take a sweep of one laser."""
        view = self._lasers.take(laser, sweep, stamp_s, now_s)
        if view is not None and not view.fault:  # without a view the Safety Pilot stops the robot
            self._points = view.points

    def goal(self, order: m.GoalOrder) -> bool:
        """Take the goal, and check a refused route again against it.

        Returns:
            Whether the route changes.
        """
        if order == self._goal:
            return False
        self._goal = order
        return self._refused is not None and self.route(self._refused)

    def route(self, route: m.Route) -> bool:
        """Take a route; after a refusal the robot may stand.

        Returns:
            Whether the route changes.
        """
        previous = self._route
        if route == previous:
            self._why_refused, self._refused = "", None
            return False
        if not all(is_sane(*waypoint) for waypoint in route.waypoints):
            self._report("route", "a waypoint is not finite or implausibly far away",
                         route.mission_id)
            return False
        self._why_refused = clip(self._fault_of(route))
        self._refused = route if self._why_refused else None
        if self._refused is not None:
            self._report("route refused", self._why_refused, route.mission_id)
            if previous is not None and previous.active and _same_goal(previous, route):
                return False  # the current route leads to the same goal
            # The robot stands; mission and step are the new ones.
            route = msgspec.structs.replace(route, active=False, waypoints=())
        before = previous or self._last.route
        if before is None or not _same_goal(before, route):
            self._row_start = None
        if self._row_start is None and route.waypoints:
            self._row_start = route.waypoints[0]
        self._route = route
        self._follower = self._follower_of(route)
        self._lights.begin(
            route, self._follower if isinstance(self._follower, LightRow) else None)
        self._watch.restart()
        self._blocked = None
        self._last = ControlKept()
        return True

    def _follower_of(self, route: m.Route) -> PathFollower | LightRow | None:
        if not route.active or not route.waypoints:
            return None
        resumed_at_m = self._last.progress_m if route == self._last.route else None
        if route.mode is m.Mode.TAXI:
            return PathFollower(route.waypoints, self._hull, self._limits, near_s_m=resumed_at_m)
        waypoints = whole_row(self._row_start, route.waypoints) if self._resumes \
            else route.waypoints
        return LightRow(waypoints, self._hull, self._limits, self._row,
                        self._airport.prohibited_distance_m, near_s_m=resumed_at_m)

    def _fault_of(self, route: m.Route) -> str:
        """Return why a route must not be followed, or ""."""
        if self._check is None or not route.active or not route.waypoints:
            return ""
        pose, order = self._pose, self._goal
        known = order is not None and order.active and order.which == route.which
        return self._check.fault(route.waypoints, pose[:2] if pose else None,
                                 (order.goal.x_m, order.goal.y_m) if known and order else None)

    def adopt(self, active: m.ControlStatus, stamp_s: float) -> None:
        """Take over the intent of the active instance from its status of `stamp_s`."""
        if self._loop and math.isfinite(active.turn_added_radps):
            self._loop.adopt(active.turn_added_radps, stamp_s + _ACTIVE_SILENT_S)
        route, follower = self._route, self._follower
        if route is None or route.which != active.which:
            return
        if isinstance(follower, LightRow):
            follower.adopt(active.back_to[0] if active.back_to else None, passing=active.passing)
        elif isinstance(follower, PathFollower) and active.phase is m.ControlPhase.FOLLOWING:
            follower.adopt_aside(active.aside_m)

    # -- outputs --------------------------------------------------------------------------------

    def begins(self) -> bool:
        """Whether all inputs are present for the first time, so that a restart costs no period."""
        blind = self._pose is None or self._points is None
        if self._begun or self._route is None or (self._follower is not None and blind):
            return False
        self._begun = True
        return True

    def step(self, now_s: float) -> m.Twist:
        """Return the command; zero without a route."""
        dt_s = min(max(now_s - self._stepped_s, PERIOD_S / 5), PERIOD_S * 4)
        self._stepped_s = now_s
        self._motion = motion = self._follow(dt_s, now_s)
        if motion is None:
            return m.Twist(0.0, 0.0)
        turn_radps = motion.angular_radps
        if self._loop:
            turn_radps = self._loop.turn(motion.linear_mps, turn_radps, dt_s)
        return m.Twist(motion.linear_mps, turn_radps)

    def _follow(self, dt_s: float, now_s: float) -> Motion | None:
        follower, points = self._follower, self._points
        pose = self._bridge.estimate(now_s) if self._bridge else self._pose
        if follower is None or pose is None or points is None:
            return None
        motion = follower.step(*pose, points, dt_s)
        if isinstance(follower, LightRow) and follower.back_to is not None:
            self._watch.restart()  # no progress is expected
        self._blocked = None if motion.arrived else self._watch.update(
            motion.distance_to_go_m, pose, points, now_s)
        return motion

    def measure(self, now_s: float) -> list[m.LightMeasurement]:
        """Return the measurements of the last step, to be saved before they are sent.

        They are sent before the arrival is reported.
        """
        if self._motion is None or not isinstance(self._follower, LightRow):
            return []
        return self._lights.measure(now_s, arrived=self._motion.arrived)

    def report(self) -> bool:
        """Update the status, and go back for a light that the last step has missed.

        Returns:
            Whether the status is to be published at once.
        """
        is_incomplete = self._look_back()
        before, self.status = self.status, self._status(is_incomplete=is_incomplete)
        return _news(before) != _news(self.status) or (
            self._has_standby and abs(before.aside_m - self.status.aside_m) > _ASIDE_M)

    def _look_back(self) -> bool:
        """Go back for a missed light; return whether a light of the row is still missing."""
        motion, row, lights = self._motion, self._follower, self._lights
        if motion is None or not isinstance(row, LightRow):
            return False
        light = lights.look_back(row, arrived=motion.arrived)
        if light:
            self._report("light inspection", "passed without a measurement, going back", light)
        return lights.is_incomplete

    def _status(self, *, is_incomplete: bool) -> m.ControlStatus:
        motion, follower, route = self._motion, self._follower, self._route
        mission_id, step = route.which if route else ("", 0)
        if motion is None:
            phase = m.ControlPhase.WAITING if follower else (
                m.ControlPhase.REFUSED if self._why_refused else m.ControlPhase.IDLE)
            return m.ControlStatus(mission_id, step, phase, 0, 0.0, reason=self._why_refused)
        row = follower if isinstance(follower, LightRow) else None
        phase = m.ControlPhase.FOLLOWING
        if motion.waiting or is_incomplete:
            phase = m.ControlPhase.WAITING
        elif motion.arrived:
            phase = m.ControlPhase.ARRIVED
        return m.ControlStatus(
            mission_id, step, phase, motion.waypoint, motion.distance_to_go_m,
            (self._blocked,) if self._blocked else (), self._why_refused,
            self._lights.missed if motion.arrived else (),
            (row.back_to,) if row and row.back_to is not None else (),
            row.is_passing if row else False,
            follower.aside_m if isinstance(follower, PathFollower) else 0.0,
            round(self._loop.added_radps, 4) if self._loop else 0.0)


def _same_goal(one: m.Route, other: m.Route) -> bool:
    return (one.which, one.mode) == (other.which, other.mode)


def _news(status: m.ControlStatus) -> tuple[object, ...]:
    return status.which, status.phase, status.back_to, status.passing
