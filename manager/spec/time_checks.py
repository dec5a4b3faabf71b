"""Whether the times of a spec make sense: those that are missing, and the time budget."""

from __future__ import annotations

import math
from collections.abc import Iterator

import msgspec

from rampart.manager.spec.budget import check
from rampart.manager.spec.mobile_robot import Hazard, find_too_little_room
from rampart.manager.spec.schema import SystemSpec
from rampart.manager.spec.tables import Finding
from rampart.manager.spec.timeouts import find_false_alarms


def find_wrong_times(spec: SystemSpec) -> Iterator[Finding]:
    """Times that are missing, contradictory, or raise false alarms."""
    timing = spec.timing
    if spec.mobile is not None:
        yield from find_too_little_room(spec.mobile)
    else:
        for field, value in msgspec.structs.asdict(timing).items():
            if math.isnan(value):
                yield Finding(f"$.timing.{field}", "missing; it is derived from [robot], and this "
                                                   "system has none")
    if timing.release_hold_max_s < timing.release_hold_s:
        yield Finding("$.timing.release_hold_max_s", "must be no less than release_hold_s = "
                      f"{timing.release_hold_s}", (timing.release_hold_max_s,))
    for path, value, problem in find_false_alarms(spec.timing):
        yield Finding(path, problem, (value,))
    for first in ("backoff", "attempt"):
        first_s = getattr(spec.supervision, f"{first}_s")
        most_s = getattr(spec.supervision, f"{first}_max_s")
        if most_s < first_s:
            yield Finding(f"$.supervision.{first}_max_s",
                          f"must be no less than {first}_s = {first_s:g}", (most_s,))


def find_wrong_budget(spec: SystemSpec) -> Iterator[Finding]:
    """Mechanisms that come too late, or race what there is not."""
    root = spec.build_ftm_tree().root if spec.mechanisms else ""
    detections = {detection.name: detection for detection in spec.detections}
    for index, mechanism in enumerate(spec.mechanisms):
        if spec.mobile is None and mechanism.against is Hazard.DRIFT:
            yield Finding(f"$.mechanism[{index}].against", "'drift', which it is if left out, "
                          "needs a [robot]; 'parent' or { within_s = ..., hazard = '...' } is "
                          "right")
        if spec.mobile is None and mechanism.against in {Hazard.RUNAWAY, Hazard.INTRUSION}:
            yield Finding(f"$.mechanism[{index}].against", "needs a [robot]; 'parent' or "
                          "{ within_s = ..., hazard = '...' } is right", (mechanism.against.value,))
        if mechanism.against is Hazard.PARENT and mechanism.name == root:
            yield Finding(f"$.mechanism[{index}].against", f"{root} is the root of the FTMTree and "
                          "has no parent to be faster than", (mechanism.against.value,))
        if mechanism.against is Hazard.INTRUSION and \
                any("margin_m" not in detections[name].parameters
                    for name in mechanism.detections):
            yield Finding(f"$.mechanism[{index}].against", f"{mechanism.detect} needs "
                          "parameters.margin_m, the distance at which it warns",
                          (mechanism.against.value,))
    for index, detection in enumerate(spec.detections):
        margin_m = detection.parameters.get("margin_m", 0.0)
        if spec.mobile is not None and margin_m >= spec.robot.corridor_clearance_m:
            yield Finding(f"$.detection[{index}].parameters.margin_m", "would raise false alarms; "
                          "it must be below corridor_clearance_m = "
                          f"{spec.robot.corridor_clearance_m:g}", (margin_m,))
    for budget in check(spec):
        if not budget.fits:
            yield Finding("$.timing", f"the time budget does not fit: {budget}")
