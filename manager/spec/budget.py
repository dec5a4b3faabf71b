"""The time budget: recovery must start before a collision can.

For every mechanism, and for every guard beside the mechanisms, this inequality must hold:

    detection + arbitration + actuation (+ respawn)  <=  time left

The right-hand side is what distances and speeds leave (`rampart.manager.spec.mobile_robot`), what
the spec says (`within_s`), or, against the *parent*, the time in which the mechanism above detects
the consequence. A respawn that takes longer than that is still safe, the mechanism above stops the
robot, but it has masked nothing.

The respawn counts where the recovery brings a node back (backward, masking), for then only the
node's first message ends the error.
"""

from __future__ import annotations

import math

from rampart.manager.spec.mobile_robot import Hazard, guards, time_left
from rampart.manager.spec.schema import MechanismSpec, SystemSpec, Within
from rampart.manager.spec.timeouts import Budget


def check(spec: SystemSpec) -> list[Budget]:
    """Draw up the budget of every mechanism and guard that is switched on, mechanisms first."""
    modules = _Modules(spec)
    return [*(_of_mechanism(spec, mechanism, modules) for mechanism in spec.mechanisms
              if spec.layers.ftm),
            *(guards(spec.mobile, spec.timing, spec.layers) if spec.mobile else ())]


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
    elif mechanism.against is not Hazard.PARENT:
        left_s, hazard = time_left(spec.robot, mechanism.against, min(
            detections[name].parameters.get("margin_m", math.inf)
            for name in mechanism.detections))
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
