"""Path follower of taxi mode: from pose, route and laser echoes to a velocity command.

Progress is the projection of the pose on the route. Nothing else is stored, so a restarted Osmosis
Control with the same route continues from the pose. The point of attraction is ahead on the route,
offset by the tangential escape (`following.escape`). The potential field turns it into a direction.
The speed is the lowest that heading error, curves, obstacles, goal and acceleration limits allow.

The field lives in `base_link`. The paper's field repels from the robot's centre with
4*alpha*(d_s^2 - d^2). Here distances are those of the hull and the repulsion is Khatib's
alpha*(1/d - 1/d_s) (Khatib 1986), which grows without bound towards contact. A field alone has a
local minimum in front of an obstacle exactly on the line. So the tangential escape is a choice and
not a force: it moves the point of attraction to one side and keeps it there. The field handles the
last half metre.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from rampart.actors.osmosis.control.following.escape import Deviation, Escape, EscapeLimits
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
    """Limits and gains of the motion.

    Args:
        max_linear_mps: top speed (paper's code: 1.0 m/s).
        max_angular_radps: top turn rate (paper's code: 2 rad/s).
        acceleration_mps2: rise of the speed.
        deceleration_mps2: fall of the speed, planned and commanded.
        angular_acceleration_radps2: change of the turn rate.
        heading_gain_per_s: turn rate per heading error.
        turn_in_place_rad: heading error above which the robot turns in place.
        lookahead_m: distance of the point of attraction along the route.
        arrival_radius_m: distance at which a goal is reached.
        abeam_m: lateral distance at which a passed goal is reached; the paper's arrival radius.
        obstacle_stop_m: free distance ahead of the hull at which the speed is zero.
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
        """Return the speed from which the robot stops within a distance."""
        return math.sqrt(2.0 * self.deceleration_mps2 * max(distance_m, 0.0))


class Motion(msgspec.Struct, frozen=True, gc=False):
    """Result of a control step: the command and the progress.

    `waiting`: stopped by an obstacle; `waypoint`: index of the route's last waypoint passed.
    """

    linear_mps: float
    angular_radps: float
    arrived: bool
    waiting: bool
    waypoint: int
    distance_to_go_m: float


_ASTRAY_M = 1.0

STANDSTILL = (0.0, 0.0)
"""Command for standing still."""


class Ramp(msgspec.Struct):
    """Acceleration limits relative to the last command."""

    limits: MotionLimits
    last: tuple[float, float] = STANDSTILL

    def towards(self, linear_mps: float, angular_radps: float, dt_s: float) -> tuple[float, float]:
        """Return the nearest command to the requested one within the limits after `dt_s`."""
        limits, (linear, angular) = self.limits, self.last
        top, turn = limits.max_linear_mps, limits.max_angular_radps
        rise, fall = limits.acceleration_mps2 * dt_s, limits.deceleration_mps2 * dt_s * 1.5
        swing = limits.angular_acceleration_radps2 * dt_s
        linear = min(max(linear_mps, linear - fall), linear + rise)
        angular = min(max(angular_radps, angular - swing), angular + swing)
        self.last = (min(max(linear, 0.0), top), min(max(angular, -turn), turn))
        return self.last


def free_ahead(points: Array, hull: Hull, margin_m: float) -> float:
    """Return the free distance ahead of the hull, m, in a lane wider by `margin_m` per side."""
    lane = (np.abs(points[:, 1]) < hull.half_width_m + margin_m) & (points[:, 0] > 0.0)
    ahead = points[lane, 0]
    return float(ahead.min()) - hull.half_length_m if len(ahead) else math.inf


class Follower:
    """Common base of the followers of both modes: the route and the progress along it.

    Args:
        waypoints: the route in `map`, at least one point.
        hull: footprint of the robot.
        motion: speeds and distances.
        near_s_m: last known arc length, if it resumes.

    Attributes:
        line: the route.
        progress_m: arc length of the robot; None before the first step.
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
        """Update the progress and return the projection of the position on the route.

        The last progress selects the leg if the route comes near itself. After a restart another
        leg is selected if it is much nearer, since the robot may have moved.
        """
        line = self.line
        foot = line.project(x_m, y_m, self.progress_m)
        if self.progress_m is None and self._resumed_at_m is not None:
            near = line.project(x_m, y_m, self._resumed_at_m)
            foot = near if abs(near.n_m) <= abs(foot.n_m) + _ASTRAY_M else foot
        self.progress_m = foot.s_m
        return foot

    def _arrive(self) -> Motion:
        """Stop at the end of the route."""
        self._arrived = True
        self._ramp.last = STANDSTILL
        return Motion(0.0, 0.0, True, False, len(self.line.points) - 1, 0.0)


_NEAR_M = 0.1
"""Distance to the target below which the attraction fades."""

# Shape of the field.
INFLUENCE_M = 0.9
"""Distance d_s from the hull at which repulsion begins."""

REPULSION = 0.06
"""At 0.06 an echo 0.1 m beside the hull deflects the direction by 28 degrees."""

LEAST_DISTANCE_M = 0.05
"""Below this distance the repulsion is constant."""

LEAST_ADVANCE = 0.15
"""Share of the attraction that repulsion leaves, so that the field never turns the robot around."""


def clusters(points: Array, gap_m: float = 0.5) -> list[Array]:
    """Split echoes, in the order of the sweep, into obstacles where the gap is larger."""
    steps = np.hypot(*np.diff(points, axis=0).T)
    return np.split(points, np.flatnonzero(steps > gap_m) + 1)


def repulsion(points: Array, hull: Hull) -> tuple[float, float]:
    """Return the sum of the repulsion of each obstacle's nearest echo, in `base_link`.

    Only one echo per obstacle counts, so that the result does not depend on the laser's resolution.
    """
    push_x = push_y = 0.0
    if not len(points) or float(hull.distance(points).min()) >= INFLUENCE_M:
        return push_x, push_y
    for cluster in clusters(points):
        distances = hull.distance(cluster)
        nearest = int(np.argmin(distances))
        distance_m = max(float(distances[nearest]), LEAST_DISTANCE_M)
        if distance_m >= INFLUENCE_M:
            continue
        x_m, y_m = (float(v) for v in cluster[nearest])
        away_x = min(max(x_m, -hull.half_length_m), hull.half_length_m) - x_m
        away_y = min(max(y_m, -hull.half_width_m), hull.half_width_m) - y_m
        norm = math.hypot(away_x, away_y)
        if norm < 1e-9:  # inside the hull: away from the centre
            away_x, away_y, norm = -x_m, -y_m, max(math.hypot(x_m, y_m), 1e-9)
        size = REPULSION * (1.0 / distance_m - 1.0 / INFLUENCE_M)
        push_x += size * away_x / norm
        push_y += size * away_y / norm
    return push_x, push_y


def field(target_x_m: float, target_y_m: float, points: Array, hull: Hull) -> tuple[float, float]:
    """Return the field's vector at the robot, in `base_link`; its direction is the heading to take.

    Args:
        target_x_m: point of attraction in `base_link`.
        target_y_m: point of attraction in `base_link`.
        points: laser echoes in `base_link`, shape (n, 2), in the order of the sweep.
        hull: footprint of the robot.
    """
    # A unit vector to the target, linear near it (the paper's conic-quadratic).
    scale = max(math.hypot(target_x_m, target_y_m), _NEAR_M)
    pull_x, pull_y = target_x_m / scale, target_y_m / scale
    push_x, push_y = repulsion(points, hull)
    pull = math.hypot(pull_x, pull_y)
    if pull < 1e-9:
        return push_x, push_y
    ahead_x, ahead_y = pull_x / pull, pull_y / pull
    along = max(pull + push_x * ahead_x + push_y * ahead_y, LEAST_ADVANCE * pull)
    aside = ahead_x * push_y - ahead_y * push_x
    return along * ahead_x - aside * ahead_y, along * ahead_y + aside * ahead_x


class PathFollower(Follower):
    """Follows one route in taxi mode.

    Args:
        waypoints: the route in `map`, at least one point.
        hull: footprint of the robot.
        limits: speeds and distances.
        escape: room for passing obstacles.
        near_s_m: last known arc length, if it resumes.
    """

    def __init__(self, waypoints: tuple[Point, ...], hull: Hull | None = None,
                 limits: MotionLimits | None = None, escape: EscapeLimits | None = None, *,
                 near_s_m: float | None = None) -> None:
        super().__init__(waypoints, hull, limits, near_s_m)
        self._room = escape or EscapeLimits()
        self._escape = Escape(self._hull, self._room)

    @property
    def aside_m(self) -> float:
        """Current lateral offset from the route, left positive, m."""
        return self._escape.offset_m

    def adopt_aside(self, aside_m: float) -> None:
        """Take the offset from which another follower returns to the route."""
        if self._escape.side == 0:
            self._escape.offset_m = aside_m

    def step(self, x_m: float, y_m: float, yaw_rad: float, points: Array, dt_s: float) -> Motion:
        """Return the command.

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
        """Return the direction of the field relative to the robot's heading."""
        (x_m, y_m, yaw_rad), s_m, n_m = pose, foot.s_m, foot.n_m
        aside_m = abs(way.offset_m - n_m)
        reach_m = self._motion.lookahead_m
        if aside_m > 0.05:
            # The offset must be reached before the obstacle: the nearer it is, the steeper.
            room_m = way.gap_m - self._hull.half_length_m - 0.2
            reach_m = min(reach_m, max(room_m, 0.6 - aside_m, 0.15))
        heading = self.line.smooth_heading_at(s_m)
        while reach_m > 0.3:
            # On the outside of a bend the offset path is longer: look less far ahead.
            bend = wrap_angle(self.line.smooth_heading_at(s_m + reach_m) - heading)
            if reach_m - way.offset_m * bend <= self._motion.lookahead_m + 0.1:
                break
            reach_m -= 0.1
        dx, dy = self._beside(s_m + reach_m, way.offset_m, x_m, y_m)
        while math.hypot(dx, dy) < 0.5 and reach_m < 2.0 * self._motion.lookahead_m:
            reach_m += 0.1  # on the inside of a bend it is shorter: never aim at the robot itself
            dx, dy = self._beside(s_m + reach_m, way.offset_m, x_m, y_m)
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        target_x, target_y = cos * dx + sin * dy, cos * dy - sin * dx
        field_x, field_y = field(target_x, target_y, points, self._hull)
        bearing = math.atan2(field_y, field_x)
        along = wrap_angle(heading - yaw_rad)
        outwards = wrap_angle(bearing - along) * n_m > 0.0
        if outwards and abs(n_m) > self._room.max_deviation_m:
            return along  # repulsion must not push beyond the corridor
        return bearing

    def _beside(self, s_m: float, n_m: float, x_m: float, y_m: float) -> tuple[float, float]:
        """Return the vector in `map` from (x, y) to (s, n), at most to the route's end."""
        s_m = min(s_m, self.line.length_m)
        x_line, y_line = self.line.point_at(s_m)
        heading = self.line.smooth_heading_at(s_m)
        return x_line - n_m * math.sin(heading) - x_m, y_line + n_m * math.cos(heading) - y_m

    def _speed(self, bearing: float, s_m: float, direct_m: float, points: Array) -> float:
        """Return the lowest of the speeds that heading, curve, goal and obstacles allow."""
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
