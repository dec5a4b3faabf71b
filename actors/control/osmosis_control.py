"""Osmosis Control: from route, pose and scan to the velocity command, 20 times a second.

It commands always, zero without a route, because silence is for DM2 to detect. It goes on
computing from the last pose it has, however old, as the paper's does: that a stale pose stops
the robot is the business of FTM6, not something to hide here.
"""

from __future__ import annotations

import math

from actors import topics
from actors.control.light_inspection import LightInspection, RowLight
from actors.control.light_row import LightRow
from actors.control.path_follower import Motion, PathFollower
from actors.control.polyline import Array, scan_points
from actors.control.settings import hull_of, motion_of
from actors.messages import (
    ControlPhase,
    ControlStatus,
    LaserScan,
    LightMeasurement,
    LightSample,
    LightVerdict,
    Mode,
    Pose,
    Route,
    Twist,
)
from actors.runtime.actor import Actor, Context, Header, every, on
from airport.model import Airport

_PERIOD_S = 0.05


class OsmosisControl(Actor):
    """Wires `PathFollower`, `LightRow` and `LightInspection` to their topics."""

    outputs = (topics.COMMAND, topics.CONTROL_STATUS, topics.LIGHT_MEASURED)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        system, airport = context.shared["system"], context.shared["airport"]
        self._hull = hull_of(system)
        self._motion = motion_of(system)
        self._lights = row_lights(airport)
        self._inspection = LightInspection(self._lights)
        self._pose: Pose | None = None
        self._points: Array | None = None
        self._route: Route | None = None
        self._follower: PathFollower | LightRow | None = None
        self._status = ControlStatus("", 0, ControlPhase.IDLE, 0, 0.0)
        self._ticked_s = context.clock.now()
        self._begun = False

    @on(topics.POSE)
    def pose(self, message: Pose, header: Header) -> None:
        """Keep the latest pose."""
        if all(map(math.isfinite, (message.x_m, message.y_m, message.yaw_rad))):
            self._pose = message
            self._inspection.pose(header.stamp, message.x_m, message.y_m, message.yaw_rad)
            self._begin()

    @on(topics.SCAN)
    def scan(self, message: LaserScan, _header: Header) -> None:
        """Keep the latest scan, as points."""
        self._points = scan_points(
            message.ranges_f32,
            message.angle_min_rad,
            message.angle_increment_rad,
            message.range_max_m,
        )
        self._begin()

    @on(topics.LIGHT)
    def light(self, message: LightSample, header: Header) -> None:
        """Keep a reading of the light sensor."""
        self._inspection.sample(header.stamp, message.illuminance_lux)

    @on(topics.ROUTE)
    def route(self, message: Route, _header: Header) -> None:
        """Take a route, if it is another one; the follower finds its place on it by itself."""
        previous = self._route
        if message == previous:
            return
        finite = all(math.isfinite(v) for waypoint in message.waypoints for v in waypoint)
        if not finite:
            self.report_diagnostic("route", "a waypoint is not finite", message.mission_id)
            return
        if previous is None or message.mission_id != previous.mission_id:
            self._inspection = LightInspection(self._lights)
        self._route = message
        self._follower = None
        if message.active and message.waypoints:
            kind = PathFollower if message.mode is Mode.TAXI else LightRow
            self._follower = kind(message.waypoints, self._hull, self._motion)
        self._begin()

    def _begin(self) -> None:
        """Command at once when all inputs are there, so that a respawn costs no extra period."""
        blind = self._pose is None or self._points is None
        if self._begun or self._route is None or (self._follower is not None and blind):
            return
        self._begun = True
        self.control()

    @every(_PERIOD_S)
    def control(self) -> None:
        """Publish the command for now."""
        now = self.clock.now()
        dt_s = min(max(now - self._ticked_s, _PERIOD_S / 5), _PERIOD_S * 4)
        self._ticked_s = now
        motion = self._step(dt_s)
        if motion is None:
            self.publish(topics.COMMAND, Twist(0.0, 0.0))
        else:
            self.publish(topics.COMMAND, Twist(motion.linear_mps, motion.angular_radps))
        self._inspect(motion)
        self._report(motion)

    @every(0.2)
    def repeat(self) -> None:
        """Repeat the status for whoever joined late."""
        self.publish(topics.CONTROL_STATUS, self._status)

    def _step(self, dt_s: float) -> Motion | None:
        follower, pose, points = self._follower, self._pose, self._points
        if follower is None or pose is None or points is None:
            return None
        return follower.step(pose.x_m, pose.y_m, pose.yaw_rad, points, dt_s)

    def _inspect(self, motion: Motion | None) -> None:
        """Publish measurements; before the arrival is reported, so that none comes too late."""
        if motion is None or not isinstance(self._follower, LightRow):
            return
        for found in self._inspection.take(ended=motion.arrived):
            self.publish(topics.LIGHT_MEASURED, LightMeasurement(
                found.light, found.intensity_cd, found.ratio, LightVerdict(found.verdict)))

    def _report(self, motion: Motion | None) -> None:
        route = self._route
        mission_id, step = (route.mission_id, route.step) if route else ("", 0)
        if motion is None:
            waiting = self._follower is not None
            phase = ControlPhase.WAITING if waiting else ControlPhase.IDLE
            status = ControlStatus(mission_id, step, phase, 0, 0.0)
        else:
            phase = ControlPhase.FOLLOWING
            if motion.arrived:
                phase = ControlPhase.ARRIVED
            elif motion.waiting:
                phase = ControlPhase.WAITING
            status = ControlStatus(
                mission_id, step, phase, motion.waypoint, motion.distance_to_go_m)
        before, self._status = self._status, status
        if (before.mission_id, before.step, before.phase) != (mission_id, step, phase):
            self.publish(topics.CONTROL_STATUS, status)


def row_lights(airport: Airport) -> tuple[RowLight, ...]:
    """Return the airport's lights as the inspection wants them."""
    return tuple(
        RowLight(light.name, light.x_m, light.y_m, light.nominal_cd) for light in airport.lights
    )
