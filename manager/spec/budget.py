"""The time budget: recovery must start before a collision can.

For every mechanism, and for every guard beside the mechanisms, this inequality must hold:

    detection + arbitration + actuation (+ respawn)  <=  time left

The right-hand side is what distances and speeds leave. With v the top speed, b the braking and
v^2 / 2b the braking distance, the robot may wait at most

* *drift*: `(clearance - v^2/2b) / v`. The error makes it go on as before, e.g. with the last
  command it got, straight at the edge of the corridor. Obstacles do not enter here: the Safety
  Pilot sees them by laser, whatever becomes of commands and of localization.
* *runaway*: t with `v t + a t^2/2 + (v + a t)^2/2b = clearance`. A wrong command makes it
  accelerate, until the drive can go no faster.
* *intrusion*: `(margin - gps accuracy - v^2/2b) / v`. It comes within the margin at which the
  redundant device warns.
* *parent*: the time in which the mechanism above detects the consequence. A respawn that takes
  longer than that is still safe, the mechanism above stops the robot, but it has masked nothing.
* an *obstacle*, for the Safety Pilot and for the base's own dead man: `(stop distance - v^2/2b)
  / v`; when the Safety Pilot dies, or its last sweep of the laser was made, an obstacle may be
  just beyond the stop distance.

The respawn counts where the recovery brings a node back (backward, masking), for then only the
node's first message ends the error.

Watchdog values need not be guessed: each is bounded from above by this inequality and from below
by false alarms, three periods of whatever it watches. `derive_timeouts` takes nine tenths of the
upper bound; the heartbeat timeout is what is left of the command's after a respawn, because a
crash is better masked by RM3 than noticed by DM2, but no more than five periods.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import msgspec

from rampart.manager.spec.schema import Hazard, MechanismSpec, Robot, SystemSpec, Timing, Within

SHARE = 0.9
"""Of the time that is left, a derived timeout takes this much."""

PERIODS_TO_MISS = 3
"""A timeout shorter than so many periods would take a late message for a lost one."""


class Budget(msgspec.Struct, frozen=True):
    """The two sides of the inequality, for one mechanism or guard; all times in seconds."""

    name: str
    hazard: str
    time_left_s: float
    detection_s: float
    arbitration_s: float
    actuation_s: float
    respawn_s: float = 0.0

    @property
    def needed_s(self) -> float:
        """From the error to the recovery being effective."""
        return self.detection_s + self.arbitration_s + self.actuation_s + self.respawn_s

    @property
    def margin_s(self) -> float:
        """What is left over; negative if the recovery comes too late."""
        return self.time_left_s - self.needed_s

    @property
    def fits(self) -> bool:
        """Whether the recovery starts in time."""
        return self.margin_s >= -1e-9  # the sum of floats may exceed an equal bound by a rounding

    def __str__(self) -> str:
        respawn = f" + respawn {self.respawn_s:.3f}" if self.respawn_s else ""
        return (f"{self.name} needs {self.needed_s:.3f} s (detection {self.detection_s:.3f} + "
                f"arbitration {self.arbitration_s:.3f} + actuation {self.actuation_s:.3f}"
                f"{respawn}) of {self.time_left_s:.3f} s before {self.hazard}")


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


def derive_timeouts(robot: Robot | None, timing: Timing) -> Timing:
    """Fill in the timeouts that a spec leaves out.

    Args:
        robot: Speeds and distances; None leaves timing as it is.
        timing: With NaN where a value is to be derived; values that are given are kept, and
            those derived follow from them.

    Returns:
        Timing without NaN. A robot that leaves no time gets values that are too short, zero or
        even negative; `check` and `find_false_alarms` then refuse it.
    """
    if robot is None:
        return timing
    drift = time_to_drift_s(robot)
    noticed_s = SHARE * (drift - timing.arbitration_s - timing.actuation_s)
    derived = {
        "command_timeout_s": noticed_s,
        "localization_timeout_s": noticed_s,
        "detection_silence_timeout_s": noticed_s,
        "manager_timeout_s": SHARE * (drift - timing.control_period_s - timing.actuation_s),
        "scan_timeout_s": SHARE * (
            time_to_obstacle_s(robot) - timing.control_period_s - timing.actuation_s),
        "dead_man_timeout_s": SHARE * (time_to_obstacle_s(robot) - timing.actuation_s),
    }
    for field, value in derived.items():
        if math.isnan(getattr(timing, field)):
            timing = msgspec.structs.replace(timing, **{field: _to_millisecond(value)})
    if math.isnan(timing.heartbeat_timeout_s):
        before_consequence_s = min(timing.command_timeout_s, timing.localization_timeout_s) - (
            timing.arbitration_s + timing.actuation_s + timing.respawn_s)
        timing = msgspec.structs.replace(timing, heartbeat_timeout_s=_to_millisecond(
            min(5 * timing.heartbeat_period_s, before_consequence_s)))
    return timing


def check(spec: SystemSpec) -> list[Budget]:
    """Draw up the budget of every mechanism and guard that is switched on, mechanisms first."""
    modules = _Modules(spec)
    return [*(_of_mechanism(spec, mechanism, modules) for mechanism in spec.mechanisms
              if spec.layers.ftm), *_of_guards(spec)]


def find_false_alarms(spec: SystemSpec) -> Iterator[tuple[str, float, str]]:
    """Find timeouts so tight that a healthy system trips them.

    Yields:
        Path in the spec, value, and what is wrong with it.
    """
    timing = spec.timing
    for field, period_field in (
            ("heartbeat_timeout_s", "heartbeat_period_s"),
            ("command_timeout_s", "control_period_s"),
            ("localization_timeout_s", "control_period_s"),
            ("scan_timeout_s", "control_period_s"),
            ("dead_man_timeout_s", "control_period_s"),
            ("manager_timeout_s", "manager_period_s"),
            ("detection_silence_timeout_s", "detection_period_s")):
        value = getattr(timing, field)
        problem = find_false_alarm(timing, value, period_field)
        if problem:
            yield f"$.timing.{field}", value, problem


def find_false_alarm(timing: Timing, timeout_s: float, period_field: str) -> str:
    """Say what is wrong with a timeout on what comes with a period of `[timing]`; "" if nothing."""
    period_s = getattr(timing, period_field)
    least_s = PERIODS_TO_MISS * period_s
    if timeout_s >= least_s - 1e-9:
        return ""
    return (f"would raise false alarms; at least {least_s:.3f} s, {PERIODS_TO_MISS} periods of "
            f"{period_field} = {period_s:.3f} s, is right")


class _Modules:
    """A spec's modules by name, and the FTMTree: looked up once for all mechanisms."""

    def __init__(self, spec: SystemSpec) -> None:
        self.detections = {detection.name: detection for detection in spec.detections}
        self.recoveries = {recovery.name: recovery for recovery in spec.recoveries}
        self.mechanisms = {mechanism.name: mechanism for mechanism in spec.mechanisms}
        self.parents = spec.build_ftm_tree().parents if spec.mechanisms else {}


def _of_mechanism(spec: SystemSpec, mechanism: MechanismSpec, modules: _Modules) -> Budget:
    timing = spec.timing
    detections = modules.detections
    repairs = any(modules.recoveries[name].kind.repairs for name in mechanism.recoveries)
    if isinstance(mechanism.against, Within):
        left_s, hazard = mechanism.against.within_s, mechanism.against.hazard
    elif mechanism.against is Hazard.DRIFT:
        left_s, hazard = time_to_drift_s(spec.robot), "the robot drifts out of the corridor"
    elif mechanism.against is Hazard.RUNAWAY:
        left_s, hazard = time_to_runaway_s(spec.robot), "the robot runs away out of the corridor"
    elif mechanism.against is Hazard.INTRUSION:
        left_s = time_to_intrusion_s(spec.robot, min(
            detections[name].parameters["margin_m"] for name in mechanism.detections))
        hazard = "the robot enters the prohibited area"
    else:
        parent = modules.mechanisms[str(modules.parents[mechanism.name])]
        left_s = min(detections[name].soonest_s for name in parent.detections)
        hazard = f"{parent.detect} of {parent.name} detects the consequence"
    # Which input of a gate opens it is not known: count on the slowest.
    detection_s = max(detections[name].latency_s for name in mechanism.detections)
    return Budget(mechanism.name, hazard, left_s, detection_s, timing.arbitration_s,
                  timing.actuation_s, timing.respawn_s if repairs else 0.0)


def patience_s(spec: SystemSpec) -> dict[str, float]:
    """Return how long the recovery of each mechanism may take, in seconds from its detection.

    What is left of the time before the hazard when detection has taken its longest, and when the
    next recovery still has to be decided on and to take effect.
    """
    modules = _Modules(spec)
    return {mechanism.name: max(0.0, budget.margin_s + budget.respawn_s)
            for mechanism in spec.mechanisms
            for budget in [_of_mechanism(spec, mechanism, modules)]}


def _of_guards(spec: SystemSpec) -> Iterator[Budget]:
    timing = spec.timing
    if spec.mobile is None:
        return
    robot = spec.mobile
    drift_s, obstacle_s = time_to_drift_s(robot), time_to_obstacle_s(robot)
    collision = "the robot hits an obstacle"
    # The Safety Pilot decides in its own cycle: one to see, one to command.
    yield Budget("safety_pilot", collision, obstacle_s, timing.control_period_s,
                 timing.control_period_s, timing.actuation_s)
    if spec.layers.safety_pilot_checks:
        yield Budget("blind_pilot", collision, obstacle_s, timing.scan_timeout_s,
                     timing.control_period_s, timing.actuation_s)
    if spec.layers.dead_man:
        yield Budget("dead_man", collision, obstacle_s, timing.dead_man_timeout_s, 0.0,
                     timing.actuation_s)
    if spec.layers.manager_watch and spec.layers.ftm:
        yield Budget("manager_watch", "the robot drifts out of the corridor", drift_s,
                     timing.manager_timeout_s, timing.control_period_s, timing.actuation_s)
    if spec.layers.ftm:
        yield Budget("silent_detection", "the robot drifts out of the corridor", drift_s,
                     timing.detection_silence_timeout_s, timing.arbitration_s, timing.actuation_s)


def _to_millisecond(value_s: float) -> float:
    """Round down, for a timeout may be shorter but not longer than derived."""
    return math.floor(value_s * 1000 + 1e-6) / 1000
