"""DM1: the robot reaches a prohibited area (paper, table I).

Independent of what it guards: it hears the GPS receiver only, not localization, and looks the
position up in its own copy of the prohibited area.
"""

from __future__ import annotations

import math

from rampart.actors.detection.module import DetectionModule, Waiting
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.osmosis.detection.area.geofence import FenceLimits, FenceMonitor
from rampart.actors.osmosis.detection.freshness import FreshnessMonitor
from rampart.actors.runtime.actor import Context, Header, on
from rampart.manager.spec.mobile_robot import Robot, time_to_intrusion_s
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.spec.tables import NonNegative, Positive

GPS_PERIOD_S = 1.0 / topics.GPS.rate_hz


class ProhibitedArea(DetectionModule):
    """Active while the robot would not stop before the prohibited area, or while GPS is silent."""

    class Parameters(Waiting, frozen=True):
        """When it warns.

        Attributes:
            margin_m: distance from the footprint to the prohibited area at which it warns when
                the robot drives straight at it with top speed. By default what the spec's times
                need.
            gps_timeout_s: a fix older than this is none, s.
            hold_s: how long it must have been safe again before the module is idle, s.
        """

        margin_m: Positive | None = None
        gps_timeout_s: NonNegative = 5 * GPS_PERIOD_S
        hold_s: NonNegative = 0.5

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        system = context.run.system
        airport = Osmosis.of(context).airport
        timeout_s = self.parameters.gps_timeout_s
        self.monitor = self.judged_by(FenceMonitor(
            airport.prohibited_distance_m,
            FenceLimits(half_diagonal_m(system.robot), reaction_s(system, self.parameters.margin_m),
                        system.robot.braking_mps2),
            FreshnessMonitor("GPS", timeout_s, 2 * GPS_PERIOD_S, self.clock.now(),
                             self.grace_s(timeout_s), known=self.first_life),
            self.parameters.hold_s))

    @on(topics.GPS)
    def gps(self, message: m.GpsFix, header: Header) -> None:
        """Look where the robot is and where it is going."""
        self.monitor.fix(message, header.stamp, self.clock.now())
        self.follow()


def reaction_s(system: SystemSpec, margin_m: float | None) -> float:
    """Return how long before the area it has to warn, s, or to keep a margin if one is given."""
    needed_s = GPS_PERIOD_S + system.timing.arbitration_s + system.timing.actuation_s
    return needed_s if margin_m is None else max(
        needed_s, time_to_intrusion_s(system.robot, margin_m))


def half_diagonal_m(robot: Robot) -> float:
    """Return the radius of the disc about `base_link` that holds the footprint, m."""
    return math.hypot(robot.length_m, robot.width_m) / 2
