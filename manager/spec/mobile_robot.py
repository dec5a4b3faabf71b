"""A mobile robot: the room it has, and the time that leaves.

With v the top speed, b the braking and v^2 / 2b the braking distance, the robot may wait at most

* *drift*: `(clearance - v^2/2b) / v`. The error makes it go on as before, e.g. with the last
  command it got, straight at the edge of the corridor. Obstacles do not enter here: the Safety
  Pilot sees them by laser, whatever becomes of commands and of localization.
* *runaway*: t with `v t + a t^2/2 + (v + a t)^2/2b = clearance`. A wrong command makes it
  accelerate, until the drive can go no faster.
* *intrusion*: `(margin - gps accuracy - v^2/2b) / v`. It comes within the margin at which the
  redundant device warns.
* an *obstacle*, for the Safety Pilot and for the base's own dead man: `(stop distance - v^2/2b)
  / v`; when the Safety Pilot dies, or its last sweep of the laser was made, an obstacle may be
  just beyond the stop distance.

Watchdog values need not be guessed (`rampart.manager.spec.budget` bounds them). `derive_timeouts`
takes nine tenths of the upper bound; the heartbeat timeout is what is left of the command's after a
respawn, because a crash is better masked by RM3 than noticed by DM2, but no more than five periods.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from enum import StrEnum

import msgspec

from rampart.manager.spec.tables import (
    FAILOVER_S,
    GUARDED,
    PERIODS,
    Finding,
    NonNegative,
    Positive,
    Table,
    Timing,
)

SHARE = 0.9
"""Of the time that is left, a derived timeout takes this much."""


class Robot(Table, frozen=True):
    """The robot and the room it has, as far as time budgets depend on them.

    Attributes:
        length_m: Of the footprint, along x of `base_link`.
        width_m: Of the footprint, along y.
        top_speed_mps: Fastest command that the controller gives.
        top_turn_rate_radps: Fastest turn that the controller commands.
        hardware_speed_mps: Fastest the drive goes when it is commanded nonsense.
        acceleration_mps2: With which it gets there.
        braking_mps2: Deceleration that is certain on wet concrete.
        stop_distance_m: The Safety Pilot stops for an obstacle this far ahead of the footprint.
        lateral_distance_m: And for one this far beside it.
        sensing_range_m: The laser shows everything up to this distance ...
        sensing_field_rad: ... in this angle, half of it on either side of straight ahead ...
        sensing_gap_rad: ... with rays no farther apart. A sweep that covers less is not believed.
        gps_accuracy_m: Error bound of the redundant positioning device.
        corridor_clearance_m: From the footprint to the nearest prohibited area, when the robot
            is where it should be.
    """

    length_m: Positive
    width_m: Positive
    top_speed_mps: Positive
    top_turn_rate_radps: Positive
    hardware_speed_mps: Positive
    acceleration_mps2: Positive
    braking_mps2: Positive
    stop_distance_m: Positive
    lateral_distance_m: NonNegative
    sensing_range_m: Positive
    gps_accuracy_m: NonNegative
    corridor_clearance_m: Positive
    sensing_field_rad: Positive = 4.7
    sensing_gap_rad: Positive = 0.035


class Hazard(StrEnum):
    """What a mechanism races against; all but `PARENT` are a robot's."""

    DRIFT = "drift"
    """The robot goes on as before, at top speed, until the corridor ends."""
    RUNAWAY = "runaway"
    """It accelerates as hard as it can."""
    INTRUSION = "intrusion"
    """It has come within the detection module's `margin_m` of the prohibited area."""
    PARENT = "parent"
    """Nothing yet, but the mechanism above is about to detect the consequence."""


_WORDS = {
    Hazard.DRIFT: "the robot drifts out of the corridor",
    Hazard.RUNAWAY: "the robot runs away out of the corridor",
    Hazard.INTRUSION: "the robot enters the prohibited area",
}


def braking_distance_m(robot: Robot, speed_mps: float) -> float:
    """Distance in which the robot comes to a stop."""
    return speed_mps ** 2 / (2 * robot.braking_mps2)


def time_to_drift_s(robot: Robot) -> float:
    """Time after which braking comes too late for the corridor's edge, at constant speed."""
    v = robot.top_speed_mps
    return (robot.corridor_clearance_m - braking_distance_m(robot, v)) / v


def time_to_runaway_s(robot: Robot) -> float:
    """Time after which braking comes too late for the corridor's edge, at full acceleration."""
    v, a, b = robot.top_speed_mps, robot.acceleration_mps2, robot.braking_mps2
    fastest = max(v, robot.hardware_speed_mps)
    ramp = (fastest - v) / a
    at_ramp_end = (v + fastest) / 2 * ramp + braking_distance_m(robot, fastest)
    if at_ramp_end <= robot.corridor_clearance_m:
        return ramp + (robot.corridor_clearance_m - at_ramp_end) / fastest
    square, linear = a / 2 + a ** 2 / (2 * b), v + v * a / b
    constant = braking_distance_m(robot, v) - robot.corridor_clearance_m
    if constant >= 0:
        return -constant / v
    return (math.sqrt(linear ** 2 - 4 * square * constant) - linear) / (2 * square)


def time_to_intrusion_s(robot: Robot, margin_m: float) -> float:
    """Time after which braking comes too late, from the margin of the redundant device on."""
    v = robot.top_speed_mps
    return (margin_m - robot.gps_accuracy_m - braking_distance_m(robot, v)) / v


def time_to_obstacle_s(robot: Robot) -> float:
    """Time after which braking comes too late for an obstacle at the stop distance."""
    v = robot.top_speed_mps
    return (robot.stop_distance_m - braking_distance_m(robot, v)) / v


def time_left(robot: Robot, hazard: Hazard, margin_m: float) -> tuple[float, str]:
    """Return the time before a hazard in seconds, and the hazard in words.

    `margin_m` is the distance at which the redundant device warns; it counts for an intrusion.
    """
    left_s = (time_to_drift_s(robot) if hazard is Hazard.DRIFT else
              time_to_runaway_s(robot) if hazard is Hazard.RUNAWAY else
              time_to_intrusion_s(robot, margin_m))
    return left_s, _WORDS[hazard]


PERIODS_WAITED = 5
"""Of what a timeout waits for, in a system that has no [robot] to derive it from."""


def derive_timeouts(robot: Robot | None, timing: Timing) -> Timing:
    """Fill in the timeouts that a spec leaves out.

    Args:
        robot: Speeds and distances; without one a timeout is `PERIODS_WAITED` periods of what it
            waits for, and what stops the robot outlasts the death of a router (`FAILOVER_S`).
        timing: With NaN where a value is to be derived; values that are given are kept, and
            those derived follow from them.

    Returns:
        Timing without NaN. A robot that leaves no time gets values that are too short, zero or
        even negative; `check` and `find_false_alarms` then refuse it.
    """
    if robot is None:
        return msgspec.structs.replace(timing, **{
            field: max(PERIODS_WAITED * getattr(timing, period),
                       0.0 if field in GUARDED else FAILOVER_S)
            for field, period in PERIODS.items() if math.isnan(getattr(timing, field))})
    drift = time_to_drift_s(robot)
    noticed_s = SHARE * (drift - timing.arbitration_s - timing.actuation_s)
    cycle_s, obstacle = timing.control_period_s, time_to_obstacle_s(robot)
    derived = {
        "command_timeout_s": noticed_s,
        "localization_timeout_s": noticed_s,
        "detection_silence_timeout_s": noticed_s,
        "manager_timeout_s": SHARE * (drift - cycle_s - timing.actuation_s),
        "scan_timeout_s": SHARE * (obstacle - cycle_s - timing.actuation_s),
        "dead_man_timeout_s": SHARE * (obstacle - timing.actuation_s),
    }
    timing = msgspec.structs.replace(timing, **{
        field: _to_millisecond(value) for field, value in derived.items()
        if math.isnan(getattr(timing, field))})
    if math.isnan(timing.heartbeat_timeout_s):
        before_consequence_s = min(timing.command_timeout_s, timing.localization_timeout_s) - (
            timing.arbitration_s + timing.actuation_s + timing.respawn_s)
        timing = msgspec.structs.replace(timing, heartbeat_timeout_s=_to_millisecond(
            min(5 * timing.heartbeat_period_s, before_consequence_s)))
    return timing


def find_too_little_room(robot: Robot) -> Iterator[Finding]:
    """Find distances in which the robot cannot brake or see."""
    braking_m = braking_distance_m(robot, robot.top_speed_mps)
    for field in ("corridor_clearance_m", "stop_distance_m"):
        room_m = getattr(robot, field)
        if room_m <= braking_m:
            yield Finding(f"$.robot.{field}", f"too little to brake in; from top_speed_mps the "
                          f"robot takes {braking_m:.3f} m", (room_m,))
    if robot.hardware_speed_mps < robot.top_speed_mps:
        yield Finding("$.robot.hardware_speed_mps", "the drive cannot be slower than top_speed_mps "
                      f"= {robot.top_speed_mps}", (robot.hardware_speed_mps,))
    if robot.sensing_range_m <= robot.stop_distance_m:
        yield Finding("$.robot.sensing_range_m", "obstacles must be seen before they are nearer "
                      f"than stop_distance_m = {robot.stop_distance_m}", (robot.sensing_range_m,))


def _to_millisecond(value_s: float) -> float:
    """Round down, for a timeout may be shorter but not longer than derived."""
    return math.floor(value_s * 1000 + 1e-6) / 1000
