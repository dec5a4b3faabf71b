"""Light verification: follow the row of lights straight on, wait in front of obstacles.

Unlike in taxi mode the robot never leaves the row: a light is measured only if the sensor passes
over it. In front of an obstacle it stops, and goes on when the way has been free for a moment
(paper, section III).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from actors.control.path_follower import (
    STANDSTILL,
    Motion,
    MotionLimits,
    Ramp,
    braking_speed,
)
from actors.control.polyline import Array, Hull, Point, Polyline, to_map, wrap_angle


@dataclass(frozen=True, slots=True)
class RowLimits:
    """How a row is followed.

    Args:
        speed_mps: speed along the row.
        lookahead_m: distance of the point steered at.
        stop_distance_m: free distance kept to an obstacle ahead of the hull; larger than what
            the Safety Pilot keeps, so that the stop is the controller's own.
        lane_margin_m: width added to the hull on each side when looking for obstacles.
        clear_s: how long the way has to be free before going on.
        overrun_m: the goal is reached within this distance of abeam.
        goal_reach_m: farthest lateral distance at which the goal still counts as reached.
    """

    speed_mps: float = 0.8
    lookahead_m: float = 1.0
    stop_distance_m: float = 1.0
    lane_margin_m: float = 0.2
    clear_s: float = 1.0
    overrun_m: float = 0.05
    goal_reach_m: float = 1.1


class LightRow:
    """Follows one row. State: progress, whether it waits, and since when the way is free.

    Args:
        waypoints: the row in `map`, at least one point; usually start and goal.
        hull: footprint of the robot.
        motion: acceleration and turn limits.
        limits: how the row is followed.
    """

    def __init__(
        self,
        waypoints: tuple[Point, ...],
        hull: Hull | None = None,
        motion: MotionLimits | None = None,
        limits: RowLimits | None = None,
    ) -> None:
        self._line = Polyline(waypoints)
        self._hull = hull or Hull()
        self._motion = motion or MotionLimits()
        self._limits = limits or RowLimits()
        self._ramp = Ramp(self._motion)
        self._s_m: float | None = None
        self._free_for_s = math.inf
        self._arrived = False

    def step(self, x_m: float, y_m: float, yaw_rad: float, points: Array, dt_s: float) -> Motion:
        """Return the command for now; arguments as for `PathFollower.step`."""
        line, limits = self._line, self._limits
        foot = line.project(x_m, y_m, self._s_m)
        self._s_m = foot.s_m
        to_go_m = line.length_m - foot.s_m
        if to_go_m <= limits.overrun_m and abs(foot.n_m) <= limits.goal_reach_m:
            self._arrived = True
        if self._arrived:
            self._ramp.last = STANDSTILL
            return Motion(0.0, 0.0, True, False, len(line.points) - 1, 0.0)

        braking = self._motion.deceleration_mps2
        cruise = min(limits.speed_mps, self._motion.max_linear_mps)
        free_m = self._free(x_m, y_m, yaw_rad, points, foot.s_m)
        allowed = braking_speed(free_m - limits.stop_distance_m, braking)
        self._free_for_s = self._free_for_s + dt_s if allowed >= cruise else 0.0
        if self._free_for_s < limits.clear_s:
            allowed = min(allowed, self._ramp.last[0])  # an echo that comes and goes is there
        waiting = allowed == 0.0
        bearing = self._bearing(x_m, y_m, yaw_rad, foot.s_m)
        speed = 0.0
        if abs(bearing) < self._motion.turn_in_place_rad:
            approach = max(braking_speed(to_go_m, braking), 0.15)
            speed = min(cruise * math.cos(bearing) ** 2, approach, allowed)
        turn = 0.0 if waiting else self._motion.heading_gain_per_s * bearing
        linear, angular = self._ramp.towards(speed, turn, dt_s)
        return Motion(linear, angular, False, waiting and linear == 0.0, foot.segment, to_go_m)

    def _bearing(self, x_m: float, y_m: float, yaw_rad: float, s_m: float) -> float:
        x_to, y_to = self._line.point_at(s_m + self._limits.lookahead_m)
        return wrap_angle(math.atan2(y_to - y_m, x_to - x_m) - yaw_rad)

    def _free(
        self, x_m: float, y_m: float, yaw_rad: float, points: Array, s_m: float
    ) -> float:
        """Free distance ahead of the hull in the lane along the row; infinite if all is free."""
        if len(points) == 0:
            return math.inf
        reach_m = 2.0 * self._limits.stop_distance_m + 4.0
        echoes = self._line.coordinates(
            to_map(points, x_m, y_m, yaw_rad), s_m - 1.0, s_m + reach_m
        )
        half_m = self._hull.half_width_m + self._limits.lane_margin_m
        lane = (np.abs(echoes[:, 1]) < half_m) & (echoes[:, 0] > s_m)
        ahead = echoes[lane, 0]
        if not len(ahead):
            return math.inf
        return float(ahead.min()) - s_m - self._hull.half_length_m
