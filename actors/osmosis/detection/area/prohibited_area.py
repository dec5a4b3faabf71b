"""DM1: the robot reaches a prohibited area (paper, table I).

It is independent of localization: it reads GPS alone and has its own copy of the prohibited area.

The robot is modelled as a disc about its centre that contains its footprint at any heading, grown
by the position error. If the robot keeps its velocity until a recovery takes effect and then
brakes, the disc sweeps a capsule. The robot is safe while the capsule is clear of the prohibited
area:

    length = v * reaction + v^2 / (2 * braking)      radius = half diagonal + accuracy

So the margin ahead grows with the speed, and the margin beside the robot does not: a robot that
passes an obstacle along the edge of its lane raises no alarm.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from rampart.actors.detection.finding import Lasting
from rampart.actors.detection.freshness import FreshnessMonitor
from rampart.actors.detection.module import DetectionModule
from rampart.actors.ftm.plausible import is_possible
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.osmosis.messages import GpsFix
from rampart.actors.osmosis.readings import is_fix
from rampart.actors.runtime.actor import Context, Header, on
from rampart.manager.spec.mobile_robot import Robot, time_to_intrusion_s
from rampart.manager.spec.tables import NonNegative, Positive

GPS_PERIOD_S = 1.0 / topics.GPS.rate_hz

ProhibitedDistance = Callable[[float, float], float]
"""Signed distance (m) from a point in `map` to the prohibited area; negative inside."""

_HOLD_S = 0.5
"""Time that the robot must have been safe again before the module is idle."""

_LEAST_STEP_M = 0.02
"""Resolution for a capsule that nearly touches the area."""


@dataclass(frozen=True, slots=True)
class FenceLimits:
    """Parameters of the capsule.

    Args:
        half_diagonal_m: radius of the disc about `base_link` that contains the footprint.
        reaction_s: from the error until the brakes act, s.
        braking_mps2: guaranteed deceleration.
        hysteresis_m: additional distance for the robot to count as safe again.
    """

    half_diagonal_m: float
    reaction_s: float
    braking_mps2: float
    hysteresis_m: float = 0.1


def stopping_distance_m(speed_mps: float, limits: FenceLimits) -> float:
    """Return reaction and braking distance, m."""
    return speed_mps * limits.reaction_s + speed_mps**2 / (2 * limits.braking_mps2)


def intrusion(fix: GpsFix, distance_m: ProhibitedDistance, limits: FenceLimits,
              extra_m: float = 0.0) -> str:
    """Return why the robot would not stop in time, or "".

    Args:
        fix: a valid fix.
        distance_m: distance to the prohibited area.
        limits: parameters of the capsule.
        extra_m: added to its radius.
    """
    radius_m = limits.half_diagonal_m + fix.accuracy_m + extra_m
    here_m = distance_m(fix.x_m, fix.y_m)
    if here_m < 0:
        return "the robot is inside the prohibited area"
    if here_m <= radius_m:
        return (f"the robot is {here_m:.2f} m from the prohibited area, "
                f"expected at least {radius_m:.2f} m")
    speed_mps = math.hypot(fix.velocity_x_mps, fix.velocity_y_mps)
    length_m = stopping_distance_m(speed_mps, limits)
    # Sphere tracing: the distance changes by at most the distance travelled, so a point d away is
    # clear for another d - radius.
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
    """Active while the robot would not stop before the prohibited area, or fixes are missing.

    Missing, old and invalid fixes count the same: after the timeout the monitor is active.

    Args:
        distance_m: distance to the prohibited area.
        limits: parameters of the capsule.
        freshness: monitor of the age of fixes.
        hold_s: time that the robot must have been safe again, s.
    """

    nodes: tuple[str, ...] = ()

    def __init__(self, distance_m: ProhibitedDistance, limits: FenceLimits,
                 freshness: FreshnessMonitor, hold_s: float) -> None:
        self._distance_m = distance_m
        self._limits = limits
        self._freshness = freshness
        self._intrusion = ""
        self._safe = Lasting(hold_s)

    @property
    def active(self) -> bool:
        """Whether the robot is too near, or its position unknown."""
        return bool(self._intrusion) or self._freshness.active

    @property
    def reason(self) -> str:
        """Why it is active: the first cause."""
        return self._intrusion or self._freshness.reason

    @property
    def known(self) -> bool:
        """Whether a fix was received, or is overdue."""
        return self._freshness.known

    @property
    def due_s(self) -> float:
        """When the next fix is overdue."""
        return self._freshness.due_s

    def expire(self, now_s: float) -> None:
        """Become active if fixes are overdue."""
        self._freshness.expire(now_s)

    def fix(self, fix: GpsFix, stamp_s: float, now_s: float) -> None:
        """Take a fix in `map`, measured at `stamp_s`."""
        if not is_fix(fix) or not is_possible(stamp_s, now_s):
            return
        self._freshness.heard(stamp_s, now_s)
        extra_m = self._limits.hysteresis_m if self._intrusion else 0.0
        found = intrusion(fix, self._distance_m, self._limits, extra_m)
        if self._safe.note(not found, now_s):
            self._intrusion = ""
        elif found:
            self._intrusion = self._intrusion or found


class ProhibitedArea(DetectionModule):
    """Active while the robot would not stop before the prohibited area, or while GPS is silent."""

    class Parameters(DetectionModule.Parameters, frozen=True):
        """Thresholds.

        Attributes:
            margin_m: distance from the footprint to the prohibited area at which it is active if
                the robot drives straight towards the area at top speed. By default the distance
                that the spec's times require.
            gps_timeout_s: greatest age of a fix, s.
        """

        margin_m: Positive | None = None
        gps_timeout_s: NonNegative = 5 * GPS_PERIOD_S

    parameters: Parameters

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        parameters = self.parameters
        self.monitor = self.judged_by(fence_of(
            self, parameters.margin_m, "GPS", parameters.gps_timeout_s))

    @on(topics.GPS)
    def gps(self, message: m.GpsFix, header: Header) -> None:
        """Check position and velocity."""
        self.monitor.fix(message, header.stamp, self.clock.now())
        self.follow()


def fence_of(module: DetectionModule, margin_m: float | None, subject: str, timeout_s: float
             ) -> FenceMonitor:
    """Return the monitor for a module.

    Args:
        module: its module.
        margin_m: see `ProhibitedArea.Parameters`.
        subject: source of the fixes, for the reason.
        timeout_s: greatest age of the newest fix, s.
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
        _HOLD_S)


def half_diagonal_m(robot: Robot) -> float:
    """Return the radius of the disc about `base_link` that contains the footprint, m."""
    return math.hypot(robot.length_m, robot.width_m) / 2
