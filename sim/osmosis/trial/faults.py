"""The faults of Osmosis: the paper's, those of the sensors and the actuators, a sudden obstacle."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from rampart.actors.osmosis import topics
from rampart.actors.osmosis.messages import ActuatorFault, ActuatorFaultKind
from rampart.actors.runtime.fault_watch import Order
from rampart.sim.faults.disturbance import Disturbance, Fault
from rampart.sim.faults.faults import Faults
from rampart.sim.faults.scenario import ScenarioError, number
from rampart.sim.faults.wrong_numbers import Sizes
from rampart.sim.osmosis.robot import WHEEL_NAMES
from rampart.sim.osmosis.trial.sensor_faults import LEFT_OUT, SENSOR_FAULTS

OBSTACLE = "obstacle-ahead"

_COMMAND = topics.COMMAND.key
_POSE = topics.POSE.key
_GROUP = "paper"

_AHEAD_M, _OBSTACLE_RADIUS_M = 3.0, 0.4
_WEAK, _NO_BRAKE = 0.2, 0.0
_LASTS_S = {"stuck-wheel": 10.0, "weak-wheel": 10.0, "brake-failure": 30.0, OBSTACLE: math.inf}
_WHEELS = {name.replace(" ", "-"): name for name in WHEEL_NAMES}

PAPER_FAULTS: Mapping[str, Fault] = {fault.name: fault for fault in (
    Fault("command-not-updated", "Osmosis Control repeats its last velocity command for ever",
          (Disturbance(_COMMAND, "freeze"),), ("DM2",), 10.0, _GROUP),
    Fault("command-out-of-bounds",
          "Osmosis Control commands 3 m/s straight ahead, three times the top speed",
          (Disturbance(_COMMAND, "corrupt",
                       set_fields={"linear_mps": 3.0, "angular_radps": 0.0}),), ("DM3",), 10.0,
          _GROUP),
    Fault("localization-not-updated", "Localization repeats its last pose for ever",
          (Disturbance(_POSE, "freeze"),), ("DM6",), 10.0, _GROUP),
    Fault("prohibited-area",
          "Localization drifts north by 0.25 m/s: the controller leads the robot into the grass "
          "while all looks healthy to it",
          (Disturbance(_POSE, "corrupt", ramp_fields={"y_m": 0.25}),), ("DM1",), 20.0, _GROUP),
    Fault("wrong-graph",
          "Graph Planner gives a way straight to the goal, along an edge that does not exist",
          (Disturbance(topics.ROUTE.key, "corrupt", keep_ends=("waypoints",)),), ("DM1",), 30.0,
          _GROUP))}
"""The faults that the paper injects, other than crashes."""


@dataclass(frozen=True, slots=True)
class SuddenObstacle:
    """An obstacle that appears ahead of the robot, `distance_m` from its centre to its own."""

    distance_m: float
    radius_m: float
    duration_s: float


SIZES = Sizes((
    ("_m", 0.5, 3.0), ("_rad", 0.3, 1.5), ("_mps", 0.2, 0.8), ("_radps", 0.2, 1.0),
    ("_mps2", 0.5, 2.0), ("_s", 1.0, 10.0), ("_lux", 200.0, 1000.0), ("_cd", 50.0, 150.0),
    ("_f32", 0.3, 1.5), ("waypoints", 0.5, 3.0), ("", 0.1, 0.5)), ("_s", "_lux", "_cd"))
"""By which the numbers of Osmosis' messages, and of the engine's on Osmosis, are wrong."""


class OsmosisFaults(Faults):
    """Besides disturbances of topics: `stuck-wheel[:WHEEL]`, `weak-wheel[:WHEEL[:STRENGTH]]`,
    `brake-failure[:STRENGTH]` for the actuators, `obstacle-ahead[:METRES]` for the world.
    """  # noqa: D205 names that must not be broken

    named = {**PAPER_FAULTS, **SENSOR_FAULTS}
    sizes = SIZES
    left_out = LEFT_OUT
    others = {
        "actuator": (*(f"stuck-wheel:{wheel}" for wheel in _WHEELS),
                     *(f"weak-wheel:{wheel}:{_WEAK}" for wheel in _WHEELS),
                     "brake-failure:0", "brake-failure:0.3"),
        "world": tuple(f"{OBSTACLE}:{distance}" for distance in (2, 3, 5))}
    titled = {
        **{f"stuck-wheel:{wheel}": ("actuator", f"the {name} wheel is stuck")
           for wheel, name in _WHEELS.items()},
        **{f"weak-wheel:{wheel}": (
            "actuator", f"the {name} wheel has a fifth of its torque and speed left")
           for wheel, name in _WHEELS.items()},
        "brake-failure": ("actuator", "the brakes do not brake")}
    kinds = {"none": "no fault", "paper": "paper's faults", "topic": "topics", "sensor": "sensors",
             "process": "processes", "actuator": "actuators", "world": "the world",
             "several": "several at once"}
    intruder = (OBSTACLE, 1.2, 6.0)

    def own(self, fault: str, injection: str, duration_s: float | None
            ) -> tuple[Order, ...] | SuddenObstacle | None:
        """Return the order of an actuator fault, or the obstacle that is to appear."""
        kind, *details = fault.split(":")
        if kind not in _LASTS_S:
            return None
        lasts_s = _LASTS_S[kind] if duration_s is None else duration_s
        if kind == OBSTACLE:
            return SuddenObstacle(number(fault, details, _AHEAD_M, most=50.0), _OBSTACLE_RADIUS_M,
                                  lasts_s)
        wheel, usual = "", _NO_BRAKE
        if kind != "brake-failure":
            name, *details = details or list(_WHEELS)[:1]
            if name not in _WHEELS:
                raise ScenarioError(f"fault {fault!r}: no wheel {name!r}; there are: "
                                    f"{', '.join(_WHEELS)}")
            wheel, usual = _WHEELS[name], _WEAK
        return (Order(topics.ACTUATOR_FAULT, ActuatorFault(
            injection, ActuatorFaultKind(kind.replace("-", " ")), wheel,
            number(fault, details, usual), lasts_s)),)
