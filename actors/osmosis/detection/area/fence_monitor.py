"""DM1's monitor: the geofence over time, blind moments included.

A redundant device that sees nothing is no barrier. A fix that does not come, is old, or is no
number counts the same: after the timeout the monitor is active.
"""

from __future__ import annotations

from rampart.actors.bus.plausible import is_possible
from rampart.actors.detection.lasting import Lasting
from rampart.actors.osmosis.detection.area.geofence import (
    DistanceBound,
    FenceLimits,
    ProhibitedDistance,
    intrusion,
    is_usable,
    reach_m,
)
from rampart.actors.osmosis.detection.freshness_monitor import FreshnessMonitor
from rampart.actors.osmosis.messages import GpsFix


class FenceMonitor:
    """Active while the robot would not stop before the prohibited area, or while GPS is silent.

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
        if not is_usable(fix) or not is_possible(stamp_s, now_s):
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
