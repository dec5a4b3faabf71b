"""The way out of a prohibited area during an emergency stop. Pure.

A robot inside a prohibited area, or too near to one, keeps DM1 active and RM1 latched, so it could
not be driven out. On request of an operator RM1 releases the brake while the dead man is held once:
slowly, and only in directions that lead out. RM1 determines the direction from the pose, ten times
a second, and the Safety Pilot enforces it. An independent check of GPS ends the way out if the
robot gets deeper. Any missing input ends it too; then the brake is engaged again.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec

from rampart.actors.osmosis.messages import Way

PERIOD_S = 0.1
"""Period of the decision."""

FRESH_S = 0.3
"""Greatest age of pose, fix and joystick."""

PILOT_S = 0.6
"""Greatest age of the Safety Pilot's status: three of its periods."""

TAKE_S = 10.0
"""Time in which the operator has to press the dead man."""

TOP_SPEED_MPS = 0.2
STANDING_RADPS = 0.1
"""Largest wheel speed at a standstill."""

APART_M = 0.5
"""Greatest distance of pose and GPS."""

DEEPER_M = 0.15
"""Increase of depth by GPS that ends the way out."""

_STEP_M = 0.25
_STEEP = 0.3
"""Least metres towards the edge per metre driven."""


class Look(msgspec.Struct):
    """Newest readings with their stamps; simulated seconds, metres and radians in `map`."""

    pose: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    pose_s: float = -math.inf
    fix: tuple[float, float] = (math.nan, math.nan)
    fix_s: float = -math.inf
    stick_s: float = -math.inf
    pilot_s: float = -math.inf
    wheels_radps: float = math.inf
    wheels_s: float = -math.inf


class WayOut:
    """One permission, from the request until its end.

    Args:
        distance_m: signed distance from a point in `map` to the area; negative inside.
        too_near_m: distance of the robot's centre up to which it cannot be released.
        far_m: distance at which it can be released, with a margin.
        now_s: now.

    Attributes:
        began_s: time of the permission.
        way: allowed directions.
        is_out: whether the robot is far enough from the area.
        open: whether the Safety Pilot obeys, so that the brake may be released.
    """

    def __init__(self, distance_m: Callable[[float, float], float], too_near_m: float,
                 far_m: float, now_s: float) -> None:
        self._distance_m = distance_m
        self._too_near_m, self._far_m = too_near_m, far_m
        self.began_s = now_s
        self._held = False
        self._farthest_m = -math.inf
        self.way = Way.NEITHER
        self.is_out = False
        self.open = False

    def refusal(self, look: Look, now_s: float) -> str:
        """Return why a way out is refused, or ""."""
        unknown = self._unknown(look, now_s)
        if unknown:
            return unknown
        if now_s - look.wheels_s > FRESH_S or look.wheels_radps > STANDING_RADPS:
            return "the robot moves"
        self._farthest_m = self._distance_m(*look.fix)
        if self._farthest_m > self._too_near_m:
            return (f"the robot is {self._farthest_m:.2f} m from the prohibited area: "
                    "reset the emergency stop")
        return ""

    def look(self, look: Look, now_s: float) -> str:
        """Determine the allowed directions; return why the way out ends, or ""."""
        self.way = Way.NEITHER
        lost = self._lost(look, now_s) or self._unknown(look, now_s)
        if lost:
            return lost
        distance_m = self._distance_m(*look.fix)
        self.is_out = distance_m >= self._far_m
        if self.is_out:
            return f"the robot is {distance_m:.2f} m from the prohibited area"
        if distance_m < self._farthest_m - DEEPER_M:
            return "the robot got deeper into the prohibited area"
        self._farthest_m = max(self._farthest_m, distance_m)
        self.way = self._outwards(*look.pose)
        return ""

    def _lost(self, look: Look, now_s: float) -> str:
        """Return whether operator or Safety Pilot ended it, or ""."""
        before, self._held = self._held, now_s - look.stick_s <= FRESH_S
        if before and not self._held:
            return "the operator released the dead man"
        if not self._held and now_s - self.began_s > TAKE_S:
            return f"the dead man was not pressed within {TAKE_S:g} s"
        if self.open and now_s - look.pilot_s > PILOT_S:
            return "the safety pilot is silent"
        return ""

    def _unknown(self, look: Look, now_s: float) -> str:
        if not now_s - look.pose_s <= FRESH_S:
            return "the pose is unknown"
        if not now_s - look.fix_s <= FRESH_S:
            return "GPS is silent"
        if not math.dist(look.pose[:2], look.fix) <= APART_M:
            return "pose and GPS differ"
        return ""

    def _outwards(self, x_m: float, y_m: float, yaw_rad: float) -> Way:
        step_x, step_y = _STEP_M * math.cos(yaw_rad), _STEP_M * math.sin(yaw_rad)
        here_m = self._distance_m(x_m, y_m)
        for way, sign in ((Way.FORWARDS, 1), (Way.BACKWARDS, -1)):
            there_m = self._distance_m(x_m + sign * step_x, y_m + sign * step_y)
            if there_m - here_m >= _STEEP * _STEP_M:
                return way
        return Way.NEITHER
