"""Follower of light verification: follows a row of lights and waits in front of obstacles.

Unlike in taxi mode the robot stays on the row, since a light is measured only if the sensor passes
over it. It stops in front of an obstacle and continues when the lane has been free for a moment
(paper, section III). With `pass_after_s` it does not wait permanently: it passes the obstacle as in
taxi mode, if the pavement is wide enough, and returns to the row. Lights beside the obstacle remain
unmeasured.

For a light that was missed for another reason the robot goes back (`following.light_ledger`
decides): it turns around, drives back, and turns around again. It never drives in reverse, because
the laser looks ahead.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from rampart.actors.osmosis.control.following.path_follower import (
    EscapeLimits,
    Follower,
    Motion,
    MotionLimits,
    PathFollower,
)
from rampart.actors.osmosis.control.polyline import (
    Array,
    Hull,
    Point,
    Pose2,
    Projection,
    to_map,
    wrap_angle,
)

_SAME_PLACE_M = 0.3
_TURNS_RADPS = 0.3
_BEHIND_RAD = 2.8


class RowLimits(Struct, frozen=True):
    """Parameters for following a row.

    Args:
        speed_mps: speed along the row.
        lookahead_m: distance of the target point on the row.
        stop_distance_m: free distance from the hull to an obstacle ahead; larger than the Safety
            Pilot's, so that the controller stops first.
        lane_margin_m: width of the lane beyond each side of the hull.
        clear_s: time that the lane has to be free before the robot continues.
        overrun_m: distance along the row at which the goal is reached.
        goal_reach_m: greatest lateral distance at which the goal is reached.
        pass_after_s: waiting time before the robot passes an obstacle; infinite for never, as in
            the paper.
        edge_m: least distance of the robot's centre to the prohibited area while passing.
        give_up_s: longest standstill while passing or going back.
    """

    speed_mps: float = 0.8
    lookahead_m: float = 1.0
    stop_distance_m: float = 1.0
    lane_margin_m: float = 0.2
    clear_s: float = 1.0
    overrun_m: float = 0.05
    goal_reach_m: float = 1.1
    pass_after_s: float = math.inf
    edge_m: float = 1.15
    give_up_s: float = 4.0


class LightRow(Follower):
    """Follows one row.

    Args:
        waypoints: the row in `map`, at least one point; usually start and goal.
        hull: footprint of the robot.
        motion: acceleration and turn limits.
        limits: parameters.
        edge_m: distance from a point in `map` to the prohibited area; without it the robot does
            not pass obstacles.
        near_s_m: last known arc length, if it resumes.
    """

    def __init__(self, waypoints: tuple[Point, ...], hull: Hull | None = None,
                 motion: MotionLimits | None = None, limits: RowLimits | None = None,
                 edge_m: Callable[[float, float], float] | None = None, *,
                 near_s_m: float | None = None) -> None:
        super().__init__(waypoints, hull, motion, near_s_m)
        self._limits = limits or RowLimits()
        self._free_for_s = math.inf
        self._edge_m = edge_m
        self._waited_s = 0.0
        self._stood_s = 0.0
        self._passing: PathFollower | None = None
        self._back: LightRow | None = None

    @property
    def is_off_course(self) -> bool:
        """Whether it passes an obstacle or goes back."""
        return self._passing is not None or self._back is not None

    @property
    def back_to(self) -> Point | None:
        """Point in `map` to which it goes back, or None."""
        return self._back.line.end if self._back is not None else None

    def go_back(self, to_s_m: float) -> None:
        """Go back to an arc length and follow the row from there.

        It gives up if an obstacle blocks the way back for `give_up_s`.
        """
        if self.progress_m is None:
            return
        self._arrived = False
        self._passing = None
        self._stood_s = 0.0
        self._back = LightRow(self.line.part(self.progress_m, to_s_m), self._hull, self._motion,
                              replace(self._limits, pass_after_s=math.inf))
        self._back._ramp = self._ramp  # the same robot

    @property
    def is_passing(self) -> bool:
        """Whether it passes an obstacle."""
        return self._passing is not None

    def adopt(self, back_to: Point | None, *, passing: bool) -> None:
        """Take over the intent of another follower of the same row: go back, pass, or neither."""
        if self.progress_m is None:
            return
        if back_to is None:
            self._back = None
        elif self.back_to is None or math.dist(self.back_to, back_to) > _SAME_PLACE_M:
            self.go_back(self.line.project(*back_to).s_m)
        if passing and self._passing is None and self._back is None:
            self._begin_to_pass(self.progress_m)
        elif not passing:
            self._passing = None

    def step(self, x_m: float, y_m: float, yaw_rad: float, points: Array, dt_s: float) -> Motion:
        """Return the command; arguments as for `PathFollower.step`."""
        line, limits = self.line, self._limits
        foot = self._advance(x_m, y_m)
        to_go_m = line.length_m - foot.s_m
        if self._back is not None:
            back = self._back.step(x_m, y_m, yaw_rad, points, dt_s)
            self._stood_s = self._stood_s + dt_s if back.waiting else 0.0
            if not back.arrived and self._stood_s < limits.give_up_s:
                return Motion(back.linear_mps, back.angular_radps, False, back.waiting,
                              foot.segment, to_go_m)
            self._back = None
        if self._arrived or (to_go_m <= limits.overrun_m and abs(foot.n_m) <= limits.goal_reach_m):
            return self._arrive()
        if self._passing is not None:
            return self._pass(self._passing, (x_m, y_m, yaw_rad), foot, points, dt_s)

        cruise = min(limits.speed_mps, self._motion.max_linear_mps)
        free_m = self._free(x_m, y_m, yaw_rad, points, foot.s_m)
        allowed = self._motion.braking_speed(free_m - limits.stop_distance_m)
        self._free_for_s = self._free_for_s + dt_s if allowed >= cruise else 0.0
        if self._free_for_s < limits.clear_s:
            allowed = min(allowed, self._ramp.last[0])  # an intermittent echo counts
        waiting = allowed == 0.0
        x_to, y_to = line.point_at(foot.s_m + limits.lookahead_m)
        bearing = wrap_angle(math.atan2(y_to - y_m, x_to - x_m) - yaw_rad)
        if abs(bearing) > _BEHIND_RAD:  # both turns are as short: keep the present one
            turning = self._ramp.last[1]
            bearing = math.copysign(bearing, turning if abs(turning) > _TURNS_RADPS else 1.0)
        speed = 0.0
        if abs(bearing) < self._motion.turn_in_place_rad:
            approach = max(self._motion.braking_speed(to_go_m), 0.15)
            speed = min(cruise * math.cos(bearing) ** 2, approach, allowed)
        turn = 0.0 if waiting else self._motion.heading_gain_per_s * bearing
        linear, angular = self._ramp.towards(speed, turn, dt_s)
        stands = waiting and linear == 0.0
        self._waited_s = self._waited_s + dt_s if stands else 0.0
        if self._waited_s >= limits.pass_after_s:
            self._waited_s = 0.0
            self._begin_to_pass(foot.s_m)
        return Motion(linear, angular, False, stands, foot.segment, to_go_m)

    def _begin_to_pass(self, s_m: float) -> None:
        """Start a follower of taxi mode if the pavement ahead is wide enough."""
        if self._edge_m is None:
            return
        usual = EscapeLimits()
        ahead_m = range(math.ceil(usual.range_m + usual.depth_m) + 2)
        room_m = min(self._edge_m(*self.line.point_at(min(s_m + far_m, self.line.length_m)))
                     for far_m in ahead_m) - self._limits.edge_m
        if room_m > self._hull.half_width_m:
            self._stood_s = 0.0
            self._passing = PathFollower(
                self.line.points, self._hull, self._motion,
                escape=replace(usual, max_deviation_m=min(usual.max_deviation_m, room_m)))

    def _pass(self, follower: PathFollower, pose: Pose2, foot: Projection, points: Array,
              dt_s: float) -> Motion:
        """Pass the obstacle; end when the robot is back on a free row."""
        motion = follower.step(*pose, points, dt_s)
        self._ramp.last = (motion.linear_mps, motion.angular_radps)
        self._arrived = motion.arrived
        self._stood_s = self._stood_s + dt_s if motion.waiting else 0.0
        heading_off = wrap_angle(self.line.heading_at(foot.s_m) - pose[2])
        back = (follower.aside_m == 0.0 and abs(foot.n_m) < 0.1 and abs(heading_off) < 0.2
                and self._free(*pose, points, foot.s_m) > self._limits.stop_distance_m + 0.5)
        if back or self._stood_s >= self._limits.give_up_s:
            self._passing = None
            self._free_for_s = math.inf if back else 0.0
        return motion

    def _free(self, x_m: float, y_m: float, yaw_rad: float, points: Array, s_m: float) -> float:
        """Return the free distance ahead of the hull in the lane, infinite without an echo."""
        if not len(points):
            return math.inf
        reach_m = 2.0 * self._limits.stop_distance_m + 4.0
        echoes = self.line.coordinates(to_map(points, x_m, y_m, yaw_rad), s_m - 1.0, s_m + reach_m)
        half_m = self._hull.half_width_m + self._limits.lane_margin_m
        lane = (np.abs(echoes[:, 1]) < half_m) & (echoes[:, 0] > s_m)
        ahead = echoes[lane, 0]
        return float(ahead.min()) - s_m - self._hull.half_length_m if len(ahead) else math.inf
