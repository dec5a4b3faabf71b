"""The table `[robot]`: the room that a mobile robot has, and the time which that leaves.

With v the top speed, b the braking and v^2 / 2b the braking distance, the robot may wait at most

* *drift*: `(clearance - v^2/2b) / v`. The robot goes on as before, e.g. by its last command,
  straight towards the edge of the corridor. Obstacles do not count here, since the Safety Pilot
  sees them by laser.
* *runaway*: t with `v t + a t^2/2 + (v + a t)^2/2b = clearance`. A wrong command makes it
  accelerate up to the speed limit of the drive.
* *intrusion*: `(margin - gps accuracy - v^2/2b) / v`. It comes within the margin at which the
  redundant device warns.
* *obstacle*: `(stop distance - v^2/2b) / v`, for the Safety Pilot and the base's dead man. When
  the last laser scan was made, an obstacle may have been just beyond the stop distance.

`derive_timeouts` takes nine tenths of each bound (`rampart.manager.spec.budget`). The heartbeat
timeout is the command timeout without the time of a respawn, so that a restarted node prevents the
stale command; it is at most five periods.
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
"""Part of the time left that a derived timeout takes."""


class Robot(Table, frozen=True):
    """The robot and its room, as far as time budgets depend on them.

    Attributes:
        length_m: Length of the footprint, along x of `base_link`.
        width_m: Width of the footprint, along y.
        top_speed_mps: Highest speed that the controller commands.
        top_turn_rate_radps: Highest turn rate that the controller commands.
        hardware_speed_mps: Highest speed of the drive, whatever the command.
        acceleration_mps2: Highest acceleration of the drive.
        braking_mps2: Deceleration that is certain on wet concrete.
        stop_distance_m: The Safety Pilot stops for an obstacle this close ahead of the footprint.
        lateral_distance_m: The same beside the footprint.
        sensing_range_m: Range of the laser.
        sensing_field_rad: Field of view, half of it on either side of straight ahead.
        sensing_gap_rad: Largest angle between rays. A scan that covers less is refused.
        gps_accuracy_m: Error bound of the redundant positioning device.
        corridor_clearance_m: Distance from the footprint to the nearest prohibited area while the
            robot follows its path.
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
    """The event that a mechanism must forestall; all but `PARENT` need a robot."""

    DRIFT = "drift"
    """The robot goes on at top speed until the corridor ends."""
    RUNAWAY = "runaway"
    """It accelerates as hard as it can."""
    INTRUSION = "intrusion"
    """It is within the detection module's `margin_m` of the prohibited area."""
    PARENT = "parent"
    """The mechanism above detects the consequence."""


_WORDS = {
    Hazard.DRIFT: "the robot drifts out of the corridor",
    Hazard.RUNAWAY: "the robot runs away out of the corridor",
    Hazard.INTRUSION: "the robot enters the prohibited area",
}


def braking_distance_m(robot: Robot, speed_mps: float) -> float:
    """Return the distance in which the robot stops."""
    return speed_mps ** 2 / (2 * robot.braking_mps2)


def time_to_drift_s(robot: Robot) -> float:
    """Return the time after which braking is too late for the corridor's edge, at top speed."""
    v = robot.top_speed_mps
    return (robot.corridor_clearance_m - braking_distance_m(robot, v)) / v


def time_to_runaway_s(robot: Robot) -> float:
    """Return the time after which braking is too late for the edge, at full acceleration."""
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
    """Return the time after which braking is too late, from the margin of the device on."""
    v = robot.top_speed_mps
    return (margin_m - robot.gps_accuracy_m - braking_distance_m(robot, v)) / v


def time_to_obstacle_s(robot: Robot) -> float:
    """Return the time after which braking is too late for an obstacle at the stop distance."""
    v = robot.top_speed_mps
    return (robot.stop_distance_m - braking_distance_m(robot, v)) / v


def time_left(robot: Robot, hazard: Hazard, margin_m: float) -> tuple[float, str]:
    """Return the time before a hazard in seconds, and the hazard in words.

    `margin_m`, at which the redundant device warns, counts for an intrusion only.
    """
    left_s = (time_to_drift_s(robot) if hazard is Hazard.DRIFT else
              time_to_runaway_s(robot) if hazard is Hazard.RUNAWAY else
              time_to_intrusion_s(robot, margin_m))
    return left_s, _WORDS[hazard]


PERIODS_WAITED = 5
"""Periods of the awaited message that a timeout takes in a system without a [robot]."""


def derive_timeouts(robot: Robot | None, timing: Timing) -> Timing:
    """Fill in the timeouts that a spec leaves out.

    Args:
        robot: Speeds and distances; without them a timeout is `PERIODS_WAITED` periods of what it
            waits for, and a timeout that stops the robot at least `FAILOVER_S`.
        timing: Times, NaN where a value is to be derived.

    Returns:
        Timing without NaN. If the robot leaves no time, values are too short or even negative;
        `check` and `find_false_alarms` then refuse them.
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
            min(PERIODS_WAITED * timing.heartbeat_period_s, before_consequence_s)))
    return timing


def find_too_little_room(robot: Robot) -> Iterator[Finding]:
    """Find distances in which the robot cannot brake or see."""
    braking_m = braking_distance_m(robot, robot.top_speed_mps)
    for field in ("corridor_clearance_m", "stop_distance_m"):
        room_m = getattr(robot, field)
        if room_m <= braking_m:
            yield Finding(f"$.robot.{field}", f"expected more than {braking_m:.3f} m, the braking "
                          "distance from top_speed_mps", (room_m,))
    if robot.hardware_speed_mps < robot.top_speed_mps:
        yield Finding("$.robot.hardware_speed_mps", "expected at least top_speed_mps = "
                      f"{robot.top_speed_mps}", (robot.hardware_speed_mps,))
    if robot.sensing_range_m <= robot.stop_distance_m:
        yield Finding("$.robot.sensing_range_m", "expected more than stop_distance_m = "
                      f"{robot.stop_distance_m}", (robot.sensing_range_m,))


def _to_millisecond(value_s: float) -> float:
    """Round down, since a timeout may be shorter than derived but not longer."""
    return math.floor(value_s * 1000 + 1e-6) / 1000
