"""DM1: the robot reaches a prohibited area (paper, table I).

Independent of what it guards: it hears the GPS receiver only, not localization, and looks the
position up in its own copy of the prohibited area.
"""

from __future__ import annotations

import math

from rampart.actors.detection.freshness import FreshnessMonitor
from rampart.actors.detection.module import DetectionModule
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.osmosis.detection.area.geofence import FenceLimits, FenceMonitor
from rampart.actors.runtime.actor import Context, Header, on
from rampart.manager.spec.mobile_robot import Robot, time_to_intrusion_s
from rampart.manager.spec.tables import NonNegative, Positive

GPS_PERIOD_S = 1.0 / topics.GPS.rate_hz


class ProhibitedArea(DetectionModule):
    """Active while the robot would not stop before the prohibited area, or while GPS is silent."""

    class Parameters(DetectionModule.Parameters, frozen=True):
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
        parameters = self.parameters
        self.monitor = self.judged_by(fence_of(
            self, parameters.margin_m, parameters.hold_s, "GPS", parameters.gps_timeout_s))

    @on(topics.GPS)
    def gps(self, message: m.GpsFix, header: Header) -> None:
        """Look where the robot is and where it is going."""
        self.monitor.fix(message, header.stamp, self.clock.now())
        self.follow()


def fence_of(module: DetectionModule, margin_m: float | None, hold_s: float, subject: str,
             timeout_s: float) -> FenceMonitor:
    """Return the fence round the prohibited area for a module.

    Args:
        module: that has it.
        margin_m: as of `ProhibitedArea.Parameters`.
        hold_s: likewise.
        subject: what fixes come from.
        timeout_s: how old the newest may be.
    """
    system = module.context.run.system
    robot, timing = system.robot, system.timing
    reaction_s = GPS_PERIOD_S + timing.arbitration_s + timing.actuation_s
    if margin_m is not None:
        reaction_s = max(reaction_s, time_to_intrusion_s(robot, margin_m))
    return FenceMonitor(
        Osmosis.of(module.context).airport.prohibited_distance_m,
        FenceLimits(half_diagonal_m(robot), reaction_s, robot.braking_mps2),
        FreshnessMonitor(subject, timeout_s, 2 * GPS_PERIOD_S, module.clock.now(),
                         module.grace_s(timeout_s), known=module.first_life),
        hold_s)


def half_diagonal_m(robot: Robot) -> float:
    """Return the radius of the disc about `base_link` that holds the footprint, m."""
    return math.hypot(robot.length_m, robot.width_m) / 2
