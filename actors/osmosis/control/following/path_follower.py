"""Path follower of taxi mode: from pose, route and laser echoes to a velocity command.

Progress is the projection of the pose on the route. Nothing else is stored, so a restarted Osmosis
Control with the same route continues from the pose. The point of attraction is ahead on the route,
offset by the tangential escape (`Escape`). The potential field turns it into a direction.
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


class EscapeLimits(msgspec.Struct, frozen=True):
    """Room for the escape, in metres.

    Args:
        range_m: distance ahead along the route, from the robot's centre, at which an escape begins.
        depth_m: further distance of echoes that are considered, since the tip of an obstacle alone
            may suggest the wrong side.
        clearance_m: preferred distance of the hull's side to an obstacle.
        least_clearance_m: least distance where the corridor is narrow.
        max_deviation_m: largest offset from the route. With 2.5 m of pavement on each side it
            leaves the 1.07 m between the robot's centre and the grass that DM1 requires.
        group_m: obstacles closer to each other along the route are passed as one.
        detour_m: additional offset for which more distant obstacles are passed as one.
        yielding_m: tolerance in clearance and offset for the chosen side.
        turning_room_m: least distance to the obstacle for a change of side.
        return_slope: lateral metres back to the line per metre along the route.
    """

    range_m: float = 3.0
    depth_m: float = 1.5
    clearance_m: float = 0.4
    least_clearance_m: float = 0.28
    max_deviation_m: float = 1.3
    group_m: float = 1.3
    detour_m: float = 0.4
    yielding_m: float = 0.1
    turning_room_m: float = 1.6
    return_slope: float = 0.6


class Deviation(msgspec.Struct, frozen=True, gc=False):
    """Lateral offset from the route, left positive.

    `gap_m` is the distance along the route from the robot's centre to the first echo in its
    present lane, infinite if the lane is free. `possible` is False if neither side is free.
    """

    offset_m: float
    gap_m: float
    possible: bool


class Escape:
    """Tangential escape: chooses the side and the lateral offset for passing an obstacle.

    It works in route coordinates (s, n), see `rampart.actors.osmosis.control.polyline`. Each echo
    forbids an interval of offsets, as wide as the robot and its clearance. If offset 0 is
    forbidden, the nearest free offset to the right or left is chosen, and the side is kept until
    the obstacle is behind. This commitment avoids a local minimum in front of an obstacle exactly
    on the line. A restarted robot beside an obstacle chooses the side where it is. If neither side
    is free within the corridor, the robot waits.

    Attributes:
        side: -1 right, 1 left, 0 none.
        offset_m: present lateral offset, left positive, m.
    """

    def __init__(self, hull: Hull, limits: EscapeLimits) -> None:
        self._hull = hull
        self._limits = limits
        self._s_m = math.nan
        self._until_m = -math.inf
        self.side = 0
        self.offset_m = 0.0

    def update(self, echoes: Array, s_m: float, n_m: float) -> Deviation:
        """Return the deviation for a robot at (s, n).

        Args:
            echoes: laser echoes in route coordinates, shape (k, 2).
            s_m: the robot's progress along the route.
            n_m: its lateral offset, left positive.
        """
        if math.isnan(self._s_m):  # first step: return gradually from the present offset
            self._s_m = s_m
            reach = self._limits.max_deviation_m
            self.offset_m = min(max(n_m, -reach), reach)
        travelled_m = max(s_m - self._s_m, 0.0)
        self._s_m = max(s_m, self._s_m)
        near = self._with_bodies(self._relevant(echoes, s_m), s_m, n_m)
        offset_m, possible = self._choose(near, s_m, n_m)
        if self.side == 0:
            step_m = self._limits.return_slope * travelled_m
            shrunk = math.copysign(max(abs(self.offset_m) - step_m, 0.0), self.offset_m)
            if self._is_free(near, shrunk, self._hull.half_width_m):
                offset_m = shrunk
        self.offset_m = offset_m
        return Deviation(offset_m, self._gap(near, s_m, n_m), possible)

    def _relevant(self, echoes: Array, s_m: float) -> Array:
        """Return the echoes that are not behind and near the corridor, sorted by s."""
        if not len(echoes):
            return echoes
        behind_m = self._hull.half_length_m + 0.15
        ahead = echoes[:, 0] - s_m
        width = self._limits.max_deviation_m + self._hull.half_width_m + self._limits.clearance_m
        far_m = self._limits.range_m + self._limits.depth_m
        kept = echoes[(ahead > -behind_m) & (ahead < far_m) & (np.abs(echoes[:, 1]) < width)]
        return np.asarray(kept[np.argsort(kept[:, 0], kind="stable")])

    def _with_bodies(self, near: Array, s_m: float, n_m: float) -> Array:
        """Add the unseen body of a passed obstacle at the line.

        Beside an obstacle only its flank is visible. The far side of an echo between the robot and
        the line may reach the line, so the line is not free until the obstacle is behind.
        """
        if not len(near) or abs(n_m) < self._hull.half_width_m:
            return near
        aside = near[:, 1] * math.copysign(1.0, n_m)
        upto_m = max(s_m + self._hull.length_m, self._until_m + 0.3 if self.side else -math.inf)
        flank = near[(aside > 0.0) & (aside < abs(n_m)) & (near[:, 0] < upto_m)]
        if len(flank) == 0:
            return near
        bodies = np.column_stack((flank[:, 0], np.zeros(len(flank))))
        joint = np.concatenate((near, bodies))
        return np.asarray(joint[np.argsort(joint[:, 0], kind="stable")])

    def _gap(self, near: Array, s_m: float, n_m: float) -> float:
        if not len(near):
            return math.inf
        lane = np.abs(near[:, 1] - n_m) < self._hull.half_width_m + self._limits.least_clearance_m
        ahead = near[lane & (near[:, 0] > s_m), 0]
        return float(ahead.min()) - s_m if len(ahead) else math.inf

    def _choose(self, near: Array, s_m: float, n_m: float) -> tuple[float, bool]:
        """Keep or choose the side; return the offset and whether it is free."""
        keep_off_m = self._hull.half_width_m + self._limits.least_clearance_m
        if not len(near) or self._is_free(
                near[near[:, 0] - s_m < self._limits.range_m], 0.0, keep_off_m):
            self.side = 0
            self._until_m = -math.inf
            return 0.0, True
        ends = np.flatnonzero(np.diff(near[:, 0]) > self._limits.group_m) + 1
        groups = (near[:end] for end in (*ends, len(near)))
        group = next(part for part in groups if not self._is_free(part, 0.0, keep_off_m))
        first_m = float(group[np.abs(group[:, 1]) < keep_off_m, 0].min())
        if first_m > self._until_m + self._limits.group_m / 2:
            self.side = 0  # the obstacle of this side is passed
        kept = self.side
        for side in (kept, -kept) if kept else self._preferred(group, n_m):
            offset_m = self._offset(group, side, yielding=side == kept)
            if offset_m is None:
                continue
            if kept == -side and first_m - s_m < self._limits.turning_room_m:
                continue  # too late for a change of side: wait
            farther_m = self._offset(near, side, yielding=side == kept)
            if farther_m is not None and abs(farther_m - offset_m) <= self._limits.detour_m:
                offset_m = farther_m
            self.side = side
            self._until_m = float(group[-1, 0])
            return offset_m, True
        return self.offset_m, False

    def _preferred(self, group: Array, n_m: float) -> tuple[int, int]:
        """Return the sides by preference: the shorter detour from the robot, then the right."""

        def cost(side: int) -> float:
            offset_m = self._offset(group, side, yielding=False)
            if offset_m is None:
                return math.inf
            return abs(offset_m) + 0.5 * abs(offset_m - n_m)

        return (1, -1) if cost(1) < cost(-1) - 0.1 else (-1, 1)

    def _offset(self, echoes: Array, side: int, *, yielding: bool) -> float | None:
        """Return the nearest free offset on a side with the best clearance available, or None."""
        slack_m = self._limits.yielding_m if yielding else 0.0
        reach_m = self._limits.max_deviation_m + slack_m
        least_m = self._hull.half_width_m + self._limits.least_clearance_m - slack_m
        wished_m = self._hull.half_width_m + self._limits.clearance_m
        nearest_m = self._free_from(echoes, side, least_m)
        if nearest_m > reach_m:
            return None
        for offset_m in (self._free_from(echoes, side, wished_m), self._limits.max_deviation_m):
            if offset_m <= reach_m and self._is_free(echoes, side * offset_m, least_m):
                return side * offset_m
        return side * nearest_m

    @staticmethod
    def _is_free(echoes: Array, offset_m: float, keep_off_m: float) -> bool:
        return not len(echoes) or not bool(
            np.count_nonzero(np.abs(echoes[:, 1] - offset_m) < keep_off_m - 1e-9))

    @staticmethod
    def _free_from(echoes: Array, side: int, keep_off_m: float) -> float:
        """Return the magnitude of the smallest offset of a side that no echo forbids."""
        offset_m = 0.0
        for n_m in np.sort(echoes[:, 1] * side):
            if abs(n_m - offset_m) < keep_off_m - 1e-9:
                offset_m = float(n_m) + keep_off_m
        return offset_m


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
