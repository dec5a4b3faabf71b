"""The way out of a prohibited area: what the operator may do while the emergency stop holds. Pure.

A robot that stands inside a prohibited area, or too near to one, keeps DM1 active, and so RM1
latched. Nobody could drive it out. On the word of an operator RM1 lets go of the brake for one
grip of the stick: slowly, and in directions that lead out only. RM1 judges the direction by the
pose, ten times a second, and the Safety Pilot obeys. An independent look at GPS ends it if the
robot gets deeper. Whatever is not known ends it, too; then the brake is engaged again.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec

from rampart.actors.osmosis.messages import Way

PERIOD_S = 0.1
"""Between two looks."""

FRESH_S = 0.3
"""Age at which a pose, a fix and the stick count as lost."""

PILOT_S = 0.6
"""Age at which the Safety Pilot's word is none: three of its periods."""

TAKE_S = 10.0
"""Within which the operator has to take the stick."""

TOP_SPEED_MPS = 0.2
STANDING_RADPS = 0.1
"""Of a wheel."""

APART_M = 0.5
"""Difference of pose and GPS at which neither is believed."""

DEEPER_M = 0.15
"""So much nearer to the middle of the area than before, by GPS, ends it."""

_STEP_M = 0.25
_STEEP = 0.3
"""Metres nearer to the edge for a metre of way, at least."""


class Look(msgspec.Struct):
    """The newest readings, each with its stamp; simulated seconds, metres and radians in `map`."""

    pose: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    pose_s: float = -math.inf
    fix: tuple[float, float] = (math.nan, math.nan)
    fix_s: float = -math.inf
    stick_s: float = -math.inf
    pilot_s: float = -math.inf
    wheels_radps: float = math.inf
    wheels_s: float = -math.inf


class WayOut:
    """One permission, from the operator's word until it ends.

    Args:
        distance_m: signed distance of a point in `map` from the area, negative inside.
        too_near_m: at this distance of its centre the robot cannot be released.
        far_m: at this one it can, with a margin.
        now_s: now.

    Attributes:
        began_s: when it was granted.
        way: where the robot may drive.
        is_out: whether the robot is far enough from the area.
        open: whether the Safety Pilot obeys, so that the brake may be let go.
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
        """Return why there is no way out to be granted, or ""."""
        unknown = self._unknown(look, now_s)
        if unknown:
            return unknown
        if now_s - look.wheels_s > FRESH_S or look.wheels_radps > STANDING_RADPS:
            return "the robot does not stand"
        self._farthest_m = self._distance_m(*look.fix)
        if self._farthest_m > self._too_near_m:
            return (f"the robot is {self._farthest_m:.2f} m from the prohibited area: "
                    "reset the emergency stop")
        return ""

    def look(self, look: Look, now_s: float) -> str:
        """Decide where the robot may drive now; return why the way out ends, or ""."""
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
        """Return whose word of the way out has ended, or ""."""
        before, self._held = self._held, now_s - look.stick_s <= FRESH_S
        if before and not self._held:
            return "the operator let go"
        if not self._held and now_s - self.began_s > TAKE_S:
            return f"no stick was taken in hand within {TAKE_S:g} s"
        if self.open and now_s - look.pilot_s > PILOT_S:
            return "the safety pilot is silent"
        return ""

    def _unknown(self, look: Look, now_s: float) -> str:
        if not now_s - look.pose_s <= FRESH_S:
            return "the pose is not known"
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
