"""Osmosis Control: from route, pose and scan to the velocity command, 20 times a second.

It commands always, zero without a route, because silence is for DM2 to detect. It goes on
computing from the last pose it has, however old, as the paper's does: that a stale pose stops
the robot is the business of FTM6, not something to hide here.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

import msgspec

from rampart.actors.bus.bounds import clip
from rampart.actors.bus.topic import Topic
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.model import Airport
from rampart.actors.osmosis.airport.route_check import RouteCheck
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.osmosis.control.following.blockage import BlockageWatch
from rampart.actors.osmosis.control.following.control_checkpoint import (
    CONTROL_STATE,
    ControlKept,
    whole_row,
)
from rampart.actors.osmosis.control.following.light_inspection import LightInspection, RowLight
from rampart.actors.osmosis.control.following.light_ledger import LightLedger
from rampart.actors.osmosis.control.following.light_row import LightRow, RowLimits
from rampart.actors.osmosis.control.following.motion_loop import MotionLoop
from rampart.actors.osmosis.control.following.path_follower import Motion, PathFollower
from rampart.actors.osmosis.control.pilot.laser_pair import LOWER, UPPER, LaserPair
from rampart.actors.osmosis.control.plausible import is_sane
from rampart.actors.osmosis.control.polyline import Array, Polyline
from rampart.actors.osmosis.control.settings import hull_of, motion_of, reach_of
from rampart.actors.osmosis.messages import (
    Blockage,
    ControlPhase,
    ControlStatus,
    GoalOrder,
    LaserScan,
    LightMeasurement,
    LightSample,
    LightVerdict,
    MissionStatus,
    Mode,
    Pose,
    Route,
    Twist,
)
from rampart.actors.runtime.actor import Actor, Context, Header, every, on
from rampart.manager.spec.schema import NonNegative

_PERIOD_S = 0.05
_ASIDE_M = 0.1
"""A step of the way aside by this much is told at once, where a standby has to know."""
_OVER_M = 0.5
"""A light this near to the row's line is one of the row."""


class OsmosisControl(Actor):
    """Wires `PathFollower`, `LightRow` and `LightInspection` to their topics.

    Class attributes:
        command_topic: where the command goes; a standby's has a topic of its own.
    """

    class Parameters(Actor.Parameters, frozen=True):
        """What it does beyond the paper's.

        Attributes:
            check_route: whether a route is checked before it is followed. A bad one is refused:
                the robot stands, or follows the good one that it has for the same goal.
            pass_after_s: how long the robot waits in a row before it drives round an obstacle, s;
                for ever if 0.
            has_standby: whether a standby listens, which is told at once where the robot means to
                be.
            yaw_loop: whether the turn rate is controlled in a closed loop (`motion_loop`); if not,
                the base is trusted to turn as it is told.
        """

        check_route: bool = False
        pass_after_s: NonNegative = 0.0
        has_standby: bool = False
        yaw_loop: bool = False

    parameters: Parameters
    command_topic: ClassVar[Topic[Twist]] = topics.COMMAND
    outputs: ClassVar[tuple[Topic[Any], ...]] = (
        topics.COMMAND, topics.CONTROL_STATUS, topics.LIGHT_MEASURED)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        system, airport = context.run.system, Osmosis.of(context).airport
        self._hull = hull_of(system)
        self._motion = motion_of(system)
        self._lights = row_lights(airport)
        self._inspection = LightInspection(self._lights)
        self._pose: Pose | None = None
        self._points: Array | None = None
        self._lasers = LaserPair(reach_of(system))
        self._route: Route | None = None
        self._follower: PathFollower | LightRow | None = None
        self._status = ControlStatus("", 0, ControlPhase.IDLE, 0, 0.0)
        self._loop = MotionLoop(self._motion.max_angular_radps) \
            if self.parameters.yaw_loop else None
        self._ticked_s = context.clock.now()
        self._begun = False
        self._airport: Airport = airport
        self._check = RouteCheck(airport) if self.parameters.check_route else None
        self._row = RowLimits(pass_after_s=self.parameters.pass_after_s or math.inf)
        self._goal: GoalOrder | None = None
        self._refused: Route | None = None
        self._why_refused = ""
        self._due: dict[str, None] = {}
        self._watch = BlockageWatch()
        self._blocked: Blockage | None = None
        self._resumes = system.layers.checkpoints
        self._ledger = LightLedger(self._lights)
        self._row_lights: tuple[tuple[float, str], ...] = ()
        self._last = ControlKept()
        self._row_start: tuple[float, float] | None = None
        self._is_incomplete = False

    def on_start(self) -> None:
        """Find out what was measured; the robot goes on when the route is there."""
        kept = self.kept(CONTROL_STATE)
        if kept is not None:
            self._last = kept
            self._row_start = kept.row_start
            self._ledger.restore(kept.lights)

    @on(topics.MISSION_STATUS)
    def mission(self, message: MissionStatus, _header: Header) -> None:
        """Hear which lights the Mission Manager has, to go back for none of them."""
        if self._resumes:
            self._ledger.hear(message)
            self._inspection.judged |= self._ledger.judged

    @on(topics.POSE)
    def pose(self, message: Pose, header: Header) -> None:
        """Keep the latest pose."""
        if is_sane(message.x_m, message.y_m, message.yaw_rad):
            self._pose = message
            self._inspection.pose(header.stamp, message.x_m, message.y_m, message.yaw_rad)
            if self._loop is not None:
                self._loop.pose(header.stamp, message.x_m, message.y_m, message.yaw_rad)
            self._begin()

    @on(topics.SCAN)
    def scan(self, message: LaserScan, header: Header) -> None:
        """Keep what can be seen."""
        self._see(LOWER, message, header)

    @on(topics.UPPER_SCAN)
    def upper_scan(self, message: LaserScan, header: Header) -> None:
        """Keep what the second laser sees, on a robot that has one."""
        self._see(UPPER, message, header)

    def _see(self, laser: int, message: LaserScan, header: Header) -> None:
        view = self._lasers.take(laser, message, header.stamp, self.clock.now())
        if view is not None and not view.fault:  # the Safety Pilot stops who sees nothing
            self._points = view.points
            self._begin()

    @on(topics.LIGHT)
    def light(self, message: LightSample, header: Header) -> None:
        """Keep a reading of the light sensor."""
        self._inspection.sample(header.stamp, message.illuminance_lux)

    @on(topics.GOAL)
    def goal(self, message: GoalOrder, _header: Header) -> None:
        """Keep the goal, to check the route's end by; a route refused for it is looked at again."""
        if message != self._goal:
            self._goal = message
            if self._refused is not None:
                self.route(self._refused, _header)

    @on(topics.ROUTE)
    def route(self, message: Route, _header: Header) -> None:
        """Take a route, if it is another one; the follower finds its place on it by itself."""
        previous = self._route
        if message == previous:
            self._why_refused, self._refused = "", None
            return
        if not all(is_sane(*waypoint) for waypoint in message.waypoints):
            self.report_diagnostic("route", "a waypoint is not finite, or farther away than "
                                   "anything can be", message.mission_id)
            return
        self._why_refused = clip(self._fault_of(message))
        self._refused = message if self._why_refused else None
        if self._refused is not None:
            self.report_diagnostic("route refused", self._why_refused, message.mission_id)
            if previous is not None and previous.active and _same_goal(previous, message):
                return  # the way that is being followed leads there as well
            # The mission and step are the new ones, and the robot stands.
            message = msgspec.structs.replace(message, active=False, waypoints=())
        if previous is None or message.mission_id != previous.mission_id:
            self._ledger.begin(message.mission_id)
            self._inspection = LightInspection(self._lights, judged=self._ledger.judged)
        before = previous or self._last.route
        if before is None or not _same_goal(before, message):
            self._due = {}
            self._row_start = None
        if self._row_start is None and message.waypoints:
            self._row_start = message.waypoints[0]
        if message.mode is Mode.LIGHT_VERIFICATION and message.waypoints:
            self._due |= dict.fromkeys(
                light.name for light in lights_along(self._lights, message.waypoints))
        self._route = message
        self._follower = None
        self._watch.restart()
        self._blocked = None
        if message.active and message.waypoints:
            resumed_at_m = self._last.progress_m if message == self._last.route else None
            self._follower = (
                PathFollower(message.waypoints, self._hull, self._motion, near_s_m=resumed_at_m)
                if message.mode is Mode.TAXI else self._row_of(message, resumed_at_m))
        self._last = ControlKept()
        self._remember()
        self._begin()

    def _row_of(self, route: Route, resumed_at_m: float | None) -> LightRow:
        waypoints = whole_row(self._row_start, route.waypoints) if self._resumes \
            else route.waypoints
        row = LightRow(waypoints, self._hull, self._motion, self._row,
                       self._airport.prohibited_distance_m, near_s_m=resumed_at_m)
        self._row_lights = self._ledger.on_row(row.line)
        return row

    @every(0.5)
    def _remember(self) -> None:
        """Keep what a successor needs; before what follows from it is sent."""
        if self._resumes and self._route is not None:
            self.keep(CONTROL_STATE, ControlKept(
                self._ledger.kept, self._route,
                self._follower.progress_m if self._follower else None, self._row_start))

    def _begin(self) -> None:
        """Command at once when all inputs are there, so that a respawn costs no extra period."""
        blind = self._pose is None or self._points is None
        if self._begun or self._route is None or (self._follower is not None and blind):
            return
        self._begun = True
        self.control()

    def _fault_of(self, route: Route) -> str:
        """Return why a route must not be followed, or ""."""
        if self._check is None or not route.active or not route.waypoints:
            return ""
        pose, order = self._pose, self._goal
        known = order is not None and order.active and (
            (order.mission_id, order.step) == (route.mission_id, route.step))
        return self._check.fault(
            route.waypoints, (pose.x_m, pose.y_m) if pose else None,
            (order.goal.x_m, order.goal.y_m) if known and order else None)

    @every(_PERIOD_S)
    def control(self) -> None:
        """Publish the command for now."""
        now = self.clock.now()
        dt_s = min(max(now - self._ticked_s, _PERIOD_S / 5), _PERIOD_S * 4)
        self._ticked_s = now
        motion = self._step(dt_s)
        if motion is None:
            self.publish(self.command_topic, Twist(0.0, 0.0))
        else:
            turn_radps = motion.angular_radps
            if self._loop is not None:
                turn_radps = self._loop.turn(motion.linear_mps, turn_radps, dt_s)
            self.publish(self.command_topic, Twist(motion.linear_mps, turn_radps))
        self._inspect(motion)
        self._report(motion)

    @every(0.2)
    def repeat(self) -> None:
        """Repeat the status for whoever joined late."""
        self.publish(topics.CONTROL_STATUS, self._status)
        for light in self._ledger.to_send_again(self.clock.now()) if self._resumes else ():
            self.publish(topics.LIGHT_MEASURED, light)

    def _where(self) -> Pose | None:
        """Return the pose to compute from: the last one, as in the paper; a hook."""
        return self._pose

    def _step(self, dt_s: float) -> Motion | None:
        follower, pose, points = self._follower, self._where(), self._points
        if follower is None or pose is None or points is None:
            return None
        motion = follower.step(pose.x_m, pose.y_m, pose.yaw_rad, points, dt_s)
        if isinstance(follower, LightRow) and follower.back_to is not None:
            self._watch.restart()  # no progress is meant
        self._blocked = None if motion.arrived else self._watch.update(
            motion.distance_to_go_m, (pose.x_m, pose.y_m, pose.yaw_rad), points,
            self.clock.now())
        return motion

    def _inspect(self, motion: Motion | None) -> None:
        """Publish measurements; before the arrival is reported, so that none comes too late."""
        self._is_incomplete = False
        if motion is None or not isinstance(self._follower, LightRow):
            return
        measured = [
            LightMeasurement(
                found.light, found.intensity_cd, found.ratio, LightVerdict(found.verdict))
            for found in self._inspection.take(ended=motion.arrived)]
        now = self.clock.now()
        fresh = [light for light in measured if self._ledger.add(light, now)]
        if fresh:
            self._remember()
        for light in fresh:
            self.publish(topics.LIGHT_MEASURED, light)
        if self._resumes:
            self._look_back(self._follower, arrived=motion.arrived)

    def _look_back(self, row: LightRow, *, arrived: bool) -> None:
        """Go back for a light that was passed without a measurement, before the row is left."""
        s_m = row.progress_m
        if s_m is None or row.back_to is not None:
            return
        if row.is_off_course:
            self._ledger.leave_out(self._row_lights, s_m)
            return
        detour = self._ledger.detour(self._row_lights, s_m, ended=arrived)
        if detour is not None:
            self.report_diagnostic(
                "light inspection", "passed without a measurement, going back", detour.light)
            row.go_back(detour.to_s_m)
        # Without a word from the Mission Manager it is not known whether a light is missing.
        self._is_incomplete = arrived and not self._ledger.is_complete(self._row_lights)

    def _report(self, motion: Motion | None) -> None:
        route = self._route
        mission_id, step = (route.mission_id, route.step) if route else ("", 0)
        if motion is None:
            waiting = self._follower is not None
            phase = ControlPhase.WAITING if waiting else ControlPhase.IDLE
            phase = ControlPhase.REFUSED if self._why_refused and not waiting else phase
            status = ControlStatus(mission_id, step, phase, 0, 0.0, reason=self._why_refused)
        else:
            phase = ControlPhase.FOLLOWING
            if motion.arrived:
                phase = ControlPhase.WAITING if self._is_incomplete else ControlPhase.ARRIVED
            elif motion.waiting:
                phase = ControlPhase.WAITING
            status = ControlStatus(
                mission_id, step, phase, motion.waypoint, motion.distance_to_go_m,
                (self._blocked,) if self._blocked else (), self._why_refused,
                self._missed() if motion.arrived else (), *self._intent(),
                self._follower.aside_m if isinstance(self._follower, PathFollower) else 0.0,
                round(self._loop.added_radps, 4) if self._loop else 0.0)
        before, self._status = self._status, status
        if (before.mission_id, before.step, before.phase, before.back_to, before.passing) != (
                mission_id, step, phase, status.back_to, status.passing) or (
                self.parameters.has_standby
                and abs(before.aside_m - status.aside_m) > _ASIDE_M):
            self.publish(topics.CONTROL_STATUS, status)

    def _intent(self) -> tuple[tuple[tuple[float, float], ...], bool]:
        """Return where the robot goes back to, if it does, and whether it drives round."""
        row = self._follower
        if not isinstance(row, LightRow):
            return (), False
        return (row.back_to,) if row.back_to is not None else (), row.is_passing

    def _missed(self) -> tuple[str, ...]:
        """Return the lights along all ways to this goal that were not measured."""
        return tuple(name for name in self._due if name not in self._inspection.judged)


def lights_along(
    lights: tuple[RowLight, ...], waypoints: tuple[tuple[float, float], ...]
) -> tuple[RowLight, ...]:
    """Return the lights that a robot passes over which follows the waypoints."""
    line = Polyline(waypoints)
    feet = [(light, line.project(light.x_m, light.y_m)) for light in lights]
    return tuple(light for light, foot in feet
                 if 0.0 < foot.s_m < line.length_m and abs(foot.n_m) <= _OVER_M)


def _same_goal(one: Route, other: Route) -> bool:
    return (one.mission_id, one.step, one.mode) == (other.mission_id, other.step, other.mode)


def row_lights(airport: Airport) -> tuple[RowLight, ...]:
    """Return the airport's lights as the inspection wants them."""
    return tuple(
        RowLight(light.name, light.x_m, light.y_m, light.nominal_cd) for light in airport.lights
    )
