"""Whether the robot can still stop before the prohibited area: geometry and monitor of DM1.

The robot is taken for a disc about its centre that holds its footprint at any heading, grown by
the error of the positioning device. If it is driven on with its present velocity until a
recovery takes effect, and then brakes, the disc sweeps a capsule. The robot is safe while that
capsule stays clear of the prohibited area:

    length = v * reaction + v^2 / (2 * braking)      radius = half diagonal + accuracy

So the margin ahead grows with speed, and beside the robot it does not: a robot that skirts an
obstacle along the edge of its lane is not taken for one that is about to leave it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from rampart.actors.detection.finding import Lasting
from rampart.actors.detection.freshness import FreshnessMonitor
from rampart.actors.ftm.plausible import is_possible
from rampart.actors.osmosis.messages import GpsFix
from rampart.actors.osmosis.readings import is_fix

ProhibitedDistance = Callable[[float, float], float]
"""Signed distance (m) from a point in `map` to the prohibited area, negative inside it."""

_LEAST_STEP_M = 0.02
"""Resolution at which a grazing capsule is examined."""

_ROUNDING_M = 1e-6
"""Far more than the rounding errors of distances."""


@dataclass(frozen=True, slots=True)
class FenceLimits:
    """What the capsule is made of.

    Args:
        half_diagonal_m: radius of the disc about `base_link` that holds the footprint.
        reaction_s: from the error to the brakes taking hold, s.
        braking_mps2: deceleration that is certain.
        hysteresis_m: how much farther away the area must be before the robot counts as safe again.
    """

    half_diagonal_m: float
    reaction_s: float
    braking_mps2: float
    hysteresis_m: float = 0.1


class DistanceBound:
    """What one look at the distance says about places near it, without another look.

    A distance changes by no more than the way made. An exact one costs as much as all the rest of
    a fix, and the robot is far from the prohibited area nearly always.

    Args:
        exact: the distance.
    """

    def __init__(self, exact: ProhibitedDistance) -> None:
        self._exact = exact
        self._at_m = (0.0, 0.0)
        self._distance_m = -math.inf

    def exceeds(self, x_m: float, y_m: float, needed_m: float) -> bool:
        """Whether the distance from a place is greater than needed; as the exact one would say."""
        bound_m = self._distance_m - math.dist(self._at_m, (x_m, y_m))
        if bound_m > needed_m + _ROUNDING_M:
            return True
        self._at_m, self._distance_m = (x_m, y_m), self._exact(x_m, y_m)
        return self._distance_m > needed_m


def stopping_distance_m(speed_mps: float, limits: FenceLimits) -> float:
    """Return how far the robot goes on: reaction and braking distance, m."""
    return speed_mps * limits.reaction_s + speed_mps**2 / (2 * limits.braking_mps2)


def reach_m(fix: GpsFix, limits: FenceLimits, extra_m: float = 0.0) -> float:
    """Return how far from the position the capsule ends, m: beyond, all is well for certain."""
    speed_mps = math.hypot(fix.velocity_x_mps, fix.velocity_y_mps)
    return (limits.half_diagonal_m + fix.accuracy_m + extra_m
            + stopping_distance_m(speed_mps, limits))


def intrusion(fix: GpsFix, distance_m: ProhibitedDistance, limits: FenceLimits,
              extra_m: float = 0.0) -> str:
    """Return why the robot will not stop in time, or "" if it will.

    Args:
        fix: a usable fix.
        distance_m: the prohibited area.
        limits: size, reaction and brakes.
        extra_m: added to the radius of the capsule.
    """
    radius_m = limits.half_diagonal_m + fix.accuracy_m + extra_m
    here_m = distance_m(fix.x_m, fix.y_m)
    if here_m < 0:
        return "the robot is inside the prohibited area"
    if here_m <= radius_m:
        return (f"the robot is {here_m:.2f} m from the prohibited area, "
                f"{radius_m:.2f} m is the least")
    speed_mps = math.hypot(fix.velocity_x_mps, fix.velocity_y_mps)
    length_m = stopping_distance_m(speed_mps, limits)
    # Sphere tracing: a distance changes by no more than the way made, so from a point that is
    # d away one may go on by d - radius without looking.
    along_m, gap_m = 0.0, here_m - radius_m
    while along_m < length_m:
        along_m = min(length_m, along_m + max(gap_m, _LEAST_STEP_M))
        share = along_m / speed_mps
        gap_m = distance_m(fix.x_m + fix.velocity_x_mps * share,
                           fix.y_m + fix.velocity_y_mps * share) - radius_m
        if gap_m <= 0:
            return (f"at {speed_mps:.2f} m/s the robot would touch the prohibited area in "
                    f"{along_m:.2f} m, it needs {length_m:.2f} m to stop")
    return ""


class FenceMonitor:
    """Active while the robot would not stop before the prohibited area, or while GPS is silent.

    A redundant device that sees nothing is no barrier. A fix that does not come, is old, or is no
    number counts the same: after the timeout the monitor is active.

    Args:
        distance_m: the prohibited area.
        limits: size, reaction and brakes of the robot.
        freshness: when fixes are too old.
        hold_s: how long it must have been safe again, s.
    """

    nodes: tuple[str, ...] = ()

    def __init__(self, distance_m: ProhibitedDistance, limits: FenceLimits,
                 freshness: FreshnessMonitor, hold_s: float) -> None:
        self._distance_m = distance_m
        self._bound = DistanceBound(distance_m)
        self._limits = limits
        self._freshness = freshness
        self._intrusion = ""
        self._safe = Lasting(hold_s)

    @property
    def active(self) -> bool:
        """Whether the robot is too near, or nobody knows."""
        return bool(self._intrusion) or self._freshness.active

    @property
    def reason(self) -> str:
        """Why it is active; what was found at first."""
        return self._intrusion or self._freshness.reason

    @property
    def known(self) -> bool:
        """Whether a fix was heard, or missed."""
        return self._freshness.known

    @property
    def due_s(self) -> float:
        """When the next fix is overdue."""
        return self._freshness.due_s

    def expire(self, now_s: float) -> None:
        """Conclude from the time without a fix."""
        self._freshness.expire(now_s)

    def fix(self, fix: GpsFix, stamp_s: float, now_s: float) -> None:
        """Take note of a fix in `map`, measured at `stamp_s`."""
        if not is_fix(fix) or not is_possible(stamp_s, now_s):
            return
        self._freshness.heard(stamp_s, now_s)
        extra_m = self._limits.hysteresis_m if self._intrusion else 0.0
        needed_m = reach_m(fix, self._limits, extra_m)
        found = "" if self._bound.exceeds(fix.x_m, fix.y_m, needed_m) else intrusion(
            fix, self._distance_m, self._limits, extra_m)
        if self._safe.note(not found, now_s):
            self._intrusion = ""
        elif found:
            self._intrusion = self._intrusion or found
