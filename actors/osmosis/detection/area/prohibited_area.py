"""DM1: the robot reaches a prohibited area (paper, table I).

Independent of what it guards: it hears the GPS receiver only, not localization, and looks the
position up in its own copy of the prohibited area.
"""

from __future__ import annotations

import math

from rampart.actors.detection.module import DetectionModule
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.osmosis.detection.area.fence_monitor import FenceMonitor
from rampart.actors.osmosis.detection.area.geofence import FenceLimits
from rampart.actors.osmosis.detection.freshness_monitor import FreshnessMonitor
from rampart.actors.runtime.actor import Context, Header, on
from rampart.actors.runtime.parameters import amount
from rampart.manager.spec.mobile_robot import Robot, time_to_intrusion_s
from rampart.manager.spec.schema import SystemSpec

GPS_PERIOD_S = 1.0 / topics.GPS.rate_hz


class ProhibitedArea(DetectionModule):
    """Active while the robot would not stop before the prohibited area, or while GPS is silent.

    Parameters:
        margin_m: distance from the footprint to the prohibited area at which it warns when the
            robot drives straight at it with top speed. By default what the spec's times need.
        gps_timeout_s: a fix older than this is none, s.
        hold_s: how long it must have been safe again before the module is idle, s.
    """

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        system = context.run.system
        airport = Osmosis.of(context).airport
        timeout_s = amount(self.parameters, "gps_timeout_s", 5 * GPS_PERIOD_S)
        self.monitor = self.judged_by(FenceMonitor(
            airport.prohibited_distance_m,
            FenceLimits(half_diagonal_m(system.robot), self._reaction_s(system),
                        system.robot.braking_mps2),
            FreshnessMonitor("GPS", timeout_s, 2 * GPS_PERIOD_S, self.clock.now(),
                             self.grace_s(timeout_s), known=self.first_life),
            amount(self.parameters, "hold_s", 0.5)))

    def _reaction_s(self, system: SystemSpec) -> float:
        needed_s = GPS_PERIOD_S + system.timing.arbitration_s + system.timing.actuation_s
        if "margin_m" not in self.parameters:
            return needed_s
        margin_m = amount(self.parameters, "margin_m", 0.0)
        return max(needed_s, time_to_intrusion_s(system.robot, margin_m))

    @on(topics.GPS)
    def gps(self, message: m.GpsFix, header: Header) -> None:
        """Look where the robot is and where it is going."""
        self.monitor.fix(message, header.stamp, self.clock.now())
        self.follow()


def half_diagonal_m(robot: Robot) -> float:
    """Return the radius of the disc about `base_link` that holds the footprint, m."""
    return math.hypot(robot.length_m, robot.width_m) / 2
