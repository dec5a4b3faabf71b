"""Path follower of taxi mode: from pose, route and laser echoes to a velocity command.

The robot is tracked by projecting its pose on the route, and nothing else is needed to know how
far it is: a respawned Osmosis Control that is given the same route and a pose in the middle goes
on from there. The point of attraction runs ahead on the route, moved aside by the tangential
escape; the potential field turns that into a direction; speed yields to everything that speaks
against it (heading error, curves, obstacles, the goal), and changes within acceleration limits.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from rampart.actors.osmosis.control.following.escape import Deviation, Escape, EscapeLimits
from rampart.actors.osmosis.control.following.potential_field import field
from rampart.actors.osmosis.control.polyline import (
    Array,
    Hull,
    Point,
    Polyline,
    Pose2,
    Projection,
    to_map,
    wrap_angle,
)


class MotionLimits(msgspec.Struct, frozen=True):
    """What the robot is asked at most, and how it follows.

    Args:
        max_linear_mps: top speed (paper's code: 1.0 m/s).
        max_angular_radps: top turn rate (paper's code: 2 rad/s).
        acceleration_mps2: rise of the speed.
        deceleration_mps2: fall of the speed, planned and commanded.
        angular_acceleration_radps2: change of the turn rate.
        heading_gain_per_s: turn rate per heading error.
        turn_in_place_rad: with a larger heading error the robot turns before it goes.
        lookahead_m: distance of the point of attraction along the route.
        arrival_radius_m: a goal is reached within this distance, or once passed abeam at most
            `abeam_m` aside.
        abeam_m: see `arrival_radius_m`; the paper's arrival radius.
        obstacle_stop_m: free space in front of the hull at which forward speed is zero.
    """

    max_linear_mps: float = 1.0
    max_angular_radps: float = 2.0
    acceleration_mps2: float = 0.8
    deceleration_mps2: float = 0.8
    angular_acceleration_radps2: float = 4.0
    heading_gain_per_s: float = 2.0
    turn_in_place_rad: float = 1.1
    lookahead_m: float = 1.0
    arrival_radius_m: float = 0.5
    abeam_m: float = 1.1
    obstacle_stop_m: float = 0.3

    def braking_speed(self, distance_m: float) -> float:
        """Speed from which the robot stops within a distance; 0 for none left."""
        return math.sqrt(2.0 * self.deceleration_mps2 * max(distance_m, 0.0))


class Motion(msgspec.Struct, frozen=True, gc=False):
    """Result of one control step: the command, and how far the robot is.

    `waiting` means stopped by an obstacle; `arrived` that the goal is reached; `waypoint` is the
    index of the route's waypoint last passed.
    """

    linear_mps: float
    angular_radps: float
    arrived: bool
    waiting: bool
    waypoint: int
    distance_to_go_m: float


_ASTRAY_M = 1.0

STANDSTILL = (0.0, 0.0)
"""The command of a robot that stands."""


class Ramp(msgspec.Struct):
    """Acceleration limits on a command: remembers the last one."""

    limits: MotionLimits
    last: tuple[float, float] = STANDSTILL

    def towards(self, linear_mps: float, angular_radps: float, dt_s: float) -> tuple[float, float]:
        """Return the command nearest to what is asked for that the limits allow after `dt_s`."""
        limits, (linear, angular) = self.limits, self.last
        top, turn = limits.max_linear_mps, limits.max_angular_radps
        rise, fall = limits.acceleration_mps2 * dt_s, limits.deceleration_mps2 * dt_s * 1.5
        swing = limits.angular_acceleration_radps2 * dt_s
        linear = min(max(linear_mps, linear - fall), linear + rise)
        angular = min(max(angular_radps, angular - swing), angular + swing)
        self.last = (min(max(linear, 0.0), top), min(max(angular, -turn), turn))
        return self.last


def free_ahead(points: Array, hull: Hull, margin_m: float) -> float:
    """Free distance in metres straight ahead of the hull, in a lane `margin_m` wider a side."""
    lane = (np.abs(points[:, 1]) < hull.half_width_m + margin_m) & (points[:, 0] > 0.0)
    ahead = points[lane, 0]
    return float(ahead.min()) - hull.half_length_m if len(ahead) else math.inf


class Follower:
    """What following in either mode has in common: the line, the robot, and how far it is.

    Args:
        waypoints: the route in `map`, at least one point.
        hull: footprint of the robot.
        motion: speeds and distances.
        near_s_m: arc length at which the robot was last known to be, for one that resumes.

    Attributes:
        line: the route.
        progress_m: arc length at which the robot is; None before the first step.
    """

    def __init__(self, waypoints: tuple[Point, ...], hull: Hull | None,
                 motion: MotionLimits | None, near_s_m: float | None) -> None:
        self.line = Polyline(waypoints)
        self.progress_m: float | None = None
        self._hull = hull or Hull()
        self._motion = motion or MotionLimits()
        self._ramp = Ramp(self._motion)
        self._resumed_at_m = near_s_m
        self._arrived = False

    def _advance(self, x_m: float, y_m: float) -> Projection:
        """Return where on the route the robot is.

        Where it was last known to be says which leg it is on, if the route comes near itself; of
        one that resumes it is not believed if another leg is much nearer: it may have moved since.
        """
        line = self.line
        foot = line.project(x_m, y_m, self.progress_m)
        if self.progress_m is None and self._resumed_at_m is not None:
            near = line.project(x_m, y_m, self._resumed_at_m)
            foot = near if abs(near.n_m) <= abs(foot.n_m) + _ASTRAY_M else foot
        self.progress_m = foot.s_m
        return foot

    def _arrive(self) -> Motion:
        """Stand at the end of the route."""
        self._arrived = True
        self._ramp.last = STANDSTILL
        return Motion(0.0, 0.0, True, False, len(self.line.points) - 1, 0.0)


class PathFollower(Follower):
    """Follows one route in taxi mode.

    Args:
        waypoints: the route in `map`, at least one point.
        hull: footprint of the robot.
        limits: speeds and distances.
        escape: room for passing obstacles.
        near_s_m: arc length at which the robot was last known to be, for one that resumes.
    """

    def __init__(self, waypoints: tuple[Point, ...], hull: Hull | None = None,
                 limits: MotionLimits | None = None, escape: EscapeLimits | None = None, *,
                 near_s_m: float | None = None) -> None:
        super().__init__(waypoints, hull, limits, near_s_m)
        self._room = escape or EscapeLimits()
        self._escape = Escape(self._hull, self._room)

    @property
    def aside_m(self) -> float:
        """The offset from the route at which the robot is to pass now, left positive."""
        return self._escape.offset_m

    def adopt_aside(self, aside_m: float) -> None:
        """Return to the route from where another follower of it returns from."""
        if self._escape.side == 0:
            self._escape.offset_m = aside_m

    def step(self, x_m: float, y_m: float, yaw_rad: float, points: Array, dt_s: float) -> Motion:
        """Return the command for now.

        Args:
            x_m: pose of `base_link` in `map`.
            y_m: pose of `base_link` in `map`.
            yaw_rad: heading in `map`.
            points: laser echoes in `base_link`, shape (n, 2), in the order of the sweep.
            dt_s: time since the last step, for the acceleration limits.
        """
        line, limits = self.line, self._motion
        foot = self._advance(x_m, y_m)
        to_go_m = line.length_m - foot.s_m + abs(foot.n_m if foot.s_m >= line.length_m else 0.0)
        direct_m = math.dist((x_m, y_m), line.end)
        passed = line.length_m - foot.s_m < 1e-3 and direct_m <= limits.abeam_m
        last_leg = line.length_m - foot.s_m <= limits.arrival_radius_m
        if self._arrived or passed or (last_leg and direct_m <= limits.arrival_radius_m):
            return self._arrive()

        echoes = line.coordinates(to_map(points, x_m, y_m, yaw_rad), foot.s_m - 2.0, foot.s_m + 5.0)
        way = self._escape.update(echoes, foot.s_m, foot.n_m)
        bearing = self._bearing((x_m, y_m, yaw_rad), foot, way, points)
        speed = self._speed(bearing, foot.s_m, direct_m, points) if way.possible else 0.0
        turn = limits.heading_gain_per_s * bearing if way.possible else 0.0
        linear, angular = self._ramp.towards(speed, turn, dt_s)
        waiting = linear == 0.0 and not way.possible
        return Motion(linear, angular, False, waiting, foot.segment, to_go_m)

    def _bearing(self, pose: Pose2, foot: Projection, way: Deviation, points: Array) -> float:
        """Direction of the field, relative to the robot's heading."""
        (x_m, y_m, yaw_rad), s_m, n_m = pose, foot.s_m, foot.n_m
        aside_m = abs(way.offset_m - n_m)
        reach_m = self._motion.lookahead_m
        if aside_m > 0.05:
            # Be aside before the obstacle begins: the nearer it is, the steeper the way there.
            room_m = way.gap_m - self._hull.half_length_m - 0.2
            reach_m = min(reach_m, max(room_m, 0.6 - aside_m, 0.15))
        heading = self.line.smooth_heading_at(s_m)
        while reach_m > 0.3:
            # Outside a bend the way aside is longer than the route: look less far ahead on it.
            bend = wrap_angle(self.line.smooth_heading_at(s_m + reach_m) - heading)
            if reach_m - way.offset_m * bend <= self._motion.lookahead_m + 0.1:
                break
            reach_m -= 0.1
        dx, dy = self._beside(s_m + reach_m, way.offset_m, x_m, y_m)
        while math.hypot(dx, dy) < 0.5 and reach_m < 2.0 * self._motion.lookahead_m:
            reach_m += 0.1  # inside a bend it is shorter: never aim at one's own feet
            dx, dy = self._beside(s_m + reach_m, way.offset_m, x_m, y_m)
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        target_x, target_y = cos * dx + sin * dy, cos * dy - sin * dx
        field_x, field_y = field(target_x, target_y, points, self._hull)
        bearing = math.atan2(field_y, field_x)
        along = wrap_angle(heading - yaw_rad)
        outwards = wrap_angle(bearing - along) * n_m > 0.0
        if outwards and abs(n_m) > self._room.max_deviation_m:
            return along  # the corridor's edge: repulsion may not push beyond it
        return bearing

    def _beside(self, s_m: float, n_m: float, x_m: float, y_m: float) -> tuple[float, float]:
        """Vector in `map` from (x, y) to the point (s, n) of the route, at most to its end."""
        s_m = min(s_m, self.line.length_m)
        x_line, y_line = self.line.point_at(s_m)
        heading = self.line.smooth_heading_at(s_m)
        return x_line - n_m * math.sin(heading) - x_m, y_line + n_m * math.cos(heading) - y_m

    def _speed(self, bearing: float, s_m: float, direct_m: float, points: Array) -> float:
        """The lowest of the speeds that heading, curve, goal and obstacles allow."""
        limits = self._motion
        if abs(bearing) > limits.turn_in_place_rad:
            return 0.0
        top, line = limits.max_linear_mps, self.line
        ahead_m = min(s_m + 1.2 * limits.lookahead_m, line.length_m)
        curve = abs(wrap_angle(line.heading_at(ahead_m) - line.heading_at(s_m)))
        speeds = [
            top * math.cos(bearing) ** 2,
            top * max(math.cos(min(curve, math.pi) / 2) ** 2, 0.35),
            max(limits.braking_speed(direct_m - limits.arrival_radius_m / 2), 0.2)]
        ahead = points[points[:, 0] > -self._hull.half_length_m] if len(points) else points
        if len(ahead):
            nearest_m = float(self._hull.distance(ahead).min())
            free_m = free_ahead(points, self._hull, 0.08)
            speeds.append(max(0.35, 0.35 + 0.8 * (nearest_m - 0.2)))
            speeds.append(limits.braking_speed(free_m - limits.obstacle_stop_m))
        return min(speeds)
