"""The times of a spec: the time budget bounds timeouts from above, false alarms from below.

Recovery must start before a collision can. For every mechanism, and every protection layer beside
the mechanisms, this inequality must hold:

    detection + arbitration + actuation (+ respawn)  <=  time left

The time left follows from distances and speeds (`rampart.manager.spec.mobile_robot`), or the spec
states it (`within_s`). Against the *parent* it is the time in which the mechanism above detects the
consequence: a slower respawn is still safe, since the mechanism above stops the robot.

The respawn counts if the recovery restarts a node, since only the first message of the new process
ends the error.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import msgspec

from rampart.manager.spec.mobile_robot import (
    Hazard,
    find_too_little_room,
    time_left,
    time_to_obstacle_s,
)
from rampart.manager.spec.schema import Kind, SystemSpec, Within
from rampart.manager.spec.tables import FAILOVER_S, GUARDED, PERIODS, Finding, Timing, numbered

PERIODS_TO_MISS = 3
"""A timeout of fewer periods would take a late message for a lost one."""


class Budget(msgspec.Struct, frozen=True):
    """The two sides of the inequality, for one mechanism or layer; all times in seconds."""

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
        """Time left over; negative if the recovery comes too late."""
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


def check(spec: SystemSpec) -> list[Budget]:
    """Return the budgets of all mechanisms and of the layers that are switched on."""
    return [*(_of_mechanisms(spec) if spec.layers.ftm else ()),
            *(_of_layers(spec) if spec.mobile else ())]


def patience_s(spec: SystemSpec) -> dict[str, float]:
    """Return how long the recovery of each mechanism may take, in seconds from its detection.

    This assumes the longest detection, and leaves the next recovery time to be decided on and to
    take effect.
    """
    return {budget.name: max(0.0, budget.margin_s + budget.respawn_s)
            for budget in _of_mechanisms(spec)}


def _of_mechanisms(spec: SystemSpec) -> Iterator[Budget]:
    timing = spec.timing
    detections = {detection.name: detection for detection in spec.detections}
    repairs = {recovery.name for recovery in spec.recoveries if recovery.kind.repairs}
    mechanisms = {mechanism.name: mechanism for mechanism in spec.mechanisms}
    parents = spec.build_ftm_tree().parents if mechanisms else {}
    manager = next((node.name for node in spec.nodes if node.kind is Kind.MANAGER), "")
    for mechanism in spec.mechanisms:
        listens_to = [detections[name] for name in mechanism.detections]
        if isinstance(mechanism.against, Within):
            left_s, hazard = mechanism.against.within_s, mechanism.against.hazard
        elif mechanism.against is not Hazard.PARENT:
            left_s, hazard = time_left(spec.robot, mechanism.against, min(
                detection.parameters.get("margin_m", math.inf) for detection in listens_to))
        else:
            parent = mechanisms[str(parents[mechanism.name])]
            left_s = min(detections[name].soonest_s for name in parent.detections)
            hazard = f"{parent.detect} of {parent.name} detects the consequence"
        # Any input may be the one that opens the gate: count the slowest.
        detection_s = max(map(spec.latency_s, listens_to)) + (
            spec.link_s(manager, mechanism.detections))
        arbitration_s = timing.arbitration_s + spec.link_s(manager, mechanism.recoveries)
        yield Budget(mechanism.name, hazard, left_s, detection_s, arbitration_s, timing.actuation_s,
                     0.0 if repairs.isdisjoint(mechanism.recoveries) else timing.respawn_s)


def _of_layers(spec: SystemSpec) -> Iterator[Budget]:
    """Yield the budgets of a mobile robot's protection layers beside the mechanisms."""
    timing, layers = spec.timing, spec.layers
    pilot = next((node.name for node in spec.nodes if node.kind is Kind.PILOT), "")
    hits = time_to_obstacle_s(spec.robot), "the robot hits an obstacle"
    drifts = time_left(spec.robot, Hazard.DRIFT, math.inf)
    cycle_s = timing.control_period_s  # the pilot needs one to see and one to command
    for name, switched_on, (left_s, hazard), detection_s, decision_s in (
            (pilot, bool(pilot), hits, cycle_s, cycle_s),
            ("blind_pilot", pilot and layers.safety_pilot_checks, hits, timing.scan_timeout_s,
             cycle_s),
            ("dead_man", pilot and layers.dead_man, hits, timing.dead_man_timeout_s, 0.0),
            ("manager_watch", pilot and layers.manager_watch and layers.ftm, drifts,
             timing.manager_timeout_s, cycle_s),
            ("silent_detection", layers.ftm, drifts, timing.detection_silence_timeout_s,
             timing.arbitration_s)):
        if switched_on:
            yield Budget(name, hazard, left_s, detection_s, decision_s, timing.actuation_s)


def find_wrong_times(spec: SystemSpec) -> Iterator[Finding]:
    """Find times that contradict each other, or raise false alarms."""
    timing = spec.timing
    if spec.mobile is not None:
        yield from find_too_little_room(spec.mobile)
    if timing.release_hold_max_s < timing.release_hold_s:
        yield Finding("$.timing.release_hold_max_s", "expected at least release_hold_s = "
                      f"{timing.release_hold_s}", (timing.release_hold_max_s,))
    yield from find_false_alarms(timing)
    for first in ("backoff", "attempt"):
        first_s = getattr(spec.supervision, f"{first}_s")
        most_s = getattr(spec.supervision, f"{first}_max_s")
        if most_s < first_s:
            yield Finding(f"$.supervision.{first}_max_s",
                          f"expected at least {first}_s = {first_s:g}", (most_s,))


def find_false_alarms(timing: Timing) -> Iterator[Finding]:
    """Find timeouts so tight that a healthy system trips them."""
    for field, period_field in PERIODS.items():
        value = getattr(timing, field)
        problem = find_false_alarm(timing, value, period_field)
        if not problem and field not in GUARDED and value < FAILOVER_S - 1e-9:
            problem = ("would stop the robot whenever a router dies; expected at least "
                       f"{FAILOVER_S:.3f} s, the longest gap in messages then")
        if problem:
            yield Finding(f"$.timing.{field}", problem, (value,))


def allowed_late_s(timing: Timing) -> float:
    """Return how late a loop may be, in seconds: half the shortest slack of a timeout.

    A message may be late at its sender and again at its reader.
    """
    slacks_s: list[float] = [getattr(timing, field) - getattr(timing, period)
                             for field, period in PERIODS.items()]
    return min(slacks_s) / 2


def find_false_alarm(timing: Timing, timeout_s: float, period_field: str) -> str:
    """Return why a timeout on messages with a period of `[timing]` is too short, or ""."""
    period_s = getattr(timing, period_field)
    least_s = PERIODS_TO_MISS * period_s
    if timeout_s >= least_s - 1e-9:
        return ""
    return (f"would raise false alarms; expected at least {least_s:.3f} s, {PERIODS_TO_MISS} "
            f"periods of {period_field} = {period_s:.3f} s")


def find_wrong_budget(spec: SystemSpec) -> Iterator[Finding]:
    """Find mechanisms that come too late, or whose hazard does not apply."""
    root = spec.build_ftm_tree().root if spec.mechanisms else ""
    detections = {detection.name: detection for detection in spec.detections}
    for row, mechanism in numbered("mechanism", spec.mechanisms):
        path, hazard = f"{row}.against", mechanism.against
        if isinstance(hazard, Within):
            continue
        if spec.mobile is None and hazard is not Hazard.PARENT:
            needs = "needs a [robot]; expected 'parent' or { within_s = ..., hazard = '...' }"
            yield (Finding(path, f"the default 'drift' {needs}")
                   if hazard is Hazard.DRIFT else Finding(path, needs, (hazard.value,)))
        if hazard is Hazard.PARENT and mechanism.name == root:
            yield Finding(path, f"{root} is the root of the FTMTree and has no parent to be "
                          "faster than", (hazard.value,))
        if hazard is Hazard.INTRUSION and any(
                "margin_m" not in detections[name].parameters for name in mechanism.detections):
            yield Finding(path, f"{mechanism.detect} needs parameters.margin_m, the distance at "
                          "which it warns", (hazard.value,))
    for path, detection in numbered("detection", spec.detections):
        margin_m = detection.parameters.get("margin_m", 0.0)
        if spec.mobile is not None and margin_m >= spec.robot.corridor_clearance_m:
            yield Finding(f"{path}.parameters.margin_m", "would raise false alarms; expected less "
                          f"than corridor_clearance_m = {spec.robot.corridor_clearance_m:g}",
                          (margin_m,))
    for budget in check(spec):
        if not budget.fits:
            yield Finding("$.timing", f"the time budget does not fit: {budget}")
