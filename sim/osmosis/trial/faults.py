"""The faults of Osmosis: the paper's, those of sensors and actuators, and a sudden obstacle.

Failure modes of a sensor:

* **bias**: a constant error.
* **drift**: an error that grows with time.
* **noise**: Gaussian noise on top of the sensor's own.
* **dropout**: no reading at all.
* **stuck**: the sensor repeats its last value with fresh stamps, which a freshness check cannot
  detect; a frozen *driver*, which repeats old stamps too, is `freeze:TOPIC`.
* **stuck-noise**: the same with the noise of a healthy device, so that no value is repeated.
* **slow-drift**, **creep**: a third and a tenth of the drift: 5 and 1.5 cm/s of a position.

A *frozen set* is several sensors that get stuck at the same time, as behind a hung serial hub.

The magnitudes are those of a failed device: at least ten times the noise of a healthy one
(`rampart.sim.osmosis.sensors`), and within the range of the device. A GPS receiver does not notice
its own error: `accuracy_m` stays. The paper's system does not use odometry and IMU (`rampart topic
info`): there their faults change messages but no mission.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any

from msgspec.structs import replace

from rampart.actors.bus.topic import Topic
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.messages import ActuatorFault, ActuatorFaultKind
from rampart.actors.runtime.fault_watch import Order
from rampart.sim.faults.faults import Faults
from rampart.sim.faults.scenario import ScenarioError, number
from rampart.sim.faults.topic_faults import Disturbance, Fault, Sizes
from rampart.sim.osmosis.robot import WHEEL_NAMES

OBSTACLE = "obstacle-ahead"

_COMMAND = topics.COMMAND.key
_POSE = topics.POSE.key
_GROUP = "paper"

_AHEAD_M, _OBSTACLE_RADIUS_M = 3.0, 0.4
_WEAK, _NO_BRAKE = 0.2, 0.0
_LASTS_S = {"stuck-wheel": 10.0, "weak-wheel": 10.0, "brake-failure": 30.0, OBSTACLE: math.inf}
_WHEELS = {name.replace(" ", "-"): name for name in WHEEL_NAMES}

PAPER_FAULTS: Mapping[str, Fault] = {fault.name: fault for fault in (
    Fault("command-not-updated", "Osmosis Control repeats its last velocity command permanently",
          (Disturbance(_COMMAND, "freeze"),), ("DM2",), 10.0, _GROUP),
    Fault("command-out-of-bounds",
          "Osmosis Control commands 3 m/s straight ahead, three times the top speed",
          (Disturbance(_COMMAND, "corrupt",
                       set_fields={"linear_mps": 3.0, "angular_radps": 0.0}),), ("DM3",), 10.0,
          _GROUP),
    Fault("localization-not-updated", "Localization repeats its last pose permanently",
          (Disturbance(_POSE, "freeze"),), ("DM6",), 10.0, _GROUP),
    Fault("prohibited-area",
          "Localization drifts north by 0.25 m/s: the controller drives the robot into the grass "
          "without noticing",
          (Disturbance(_POSE, "corrupt", ramp_fields={"y_m": 0.25}),), ("DM1",), 20.0, _GROUP),
    Fault("wrong-graph",
          "Graph Planner publishes a straight route to the goal, along an edge that does not exist",
          (Disturbance(topics.ROUTE.key, "corrupt", keep_ends=("waypoints",)),), ("DM1",), 30.0,
          _GROUP))}
"""The paper's faults without crashes."""


_SENSOR_GROUP = "sensor"
_FOR_A_WHILE_S = 10.0
_TO_GROW_S = 20.0
_SLOW, _CREEP = 0.35, 0.106


@dataclass(frozen=True, slots=True)
class _Sensor:
    """A sensor with the sizes of its errors: field → amount, for `drift` per second.

    `grain` is the noise of a healthy device. `titles` describes its failure modes; each sensor also
    has dropout and stuck.
    """

    name: str
    topic: Topic[Any]
    what: str
    bias: Mapping[str, float]
    noise: Mapping[str, float]
    drift: Mapping[str, float] = field(default_factory=dict)
    grain: Mapping[str, float] = field(default_factory=dict)
    titles: Mapping[str, str] = field(default_factory=dict)
    seen_by: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


SENSORS = (
    _Sensor("gps", topics.GPS, "the GPS receiver",
            bias={"x_m": 1.5, "y_m": 1.5},
            noise={"x_m": 1.5, "y_m": 1.5, "velocity_x_mps": 0.3, "velocity_y_mps": 0.3},
            drift={"x_m": 0.1, "y_m": 0.1},
            grain={"x_m": 0.01, "y_m": 0.01, "velocity_x_mps": 0.03, "velocity_y_mps": 0.03},
            titles={"bias": "is 2.1 m off to the north-east, as by multipath at a hangar",
                  "drift": "drifts north-east by 0.14 m/s",
                  "noise": "has lost its RTK fix: 1.5 m noise, 0.3 m/s in velocity"},
            seen_by={"dropout": ("DM1",)}),
    _Sensor("imu", topics.IMU, "the IMU",
            bias={"yaw_rate_radps": 0.05, "accel_x_mps2": 0.3, "accel_y_mps2": 0.3},
            noise={"yaw_rad": 0.05, "yaw_rate_radps": 0.1, "accel_x_mps2": 1.0,
                   "accel_y_mps2": 1.0},
            drift={"yaw_rad": 0.02},
            grain={"yaw_rad": 3e-4, "yaw_rate_radps": 0.003, "accel_x_mps2": 0.05,
                   "accel_y_mps2": 0.05},
            titles={"bias": "has a turn-on bias: 0.05 rad/s and 0.3 m/s2",
                  "drift": "has a heading that drifts by 0.02 rad/s",
                  "noise": "shakes on a loose mount: 0.1 rad/s, 1 m/s2, 0.05 rad of noise"}),
    _Sensor("odom", topics.ODOMETRY, "the odometry",
            bias={"twist.linear_mps": 0.1, "twist.angular_radps": 0.05},
            noise={"pose.x_m": 0.1, "pose.y_m": 0.1, "pose.yaw_rad": 0.05,
                   "twist.linear_mps": 0.1, "twist.angular_radps": 0.1},
            drift={"pose.x_m": 0.1, "pose.yaw_rad": 0.02},
            grain={"twist.linear_mps": 0.005, "twist.angular_radps": 0.005},
            titles={"bias": "reports 0.1 m/s and 0.05 rad/s too much, as with worn tyres",
                  "drift": "counts slipping wheels: 0.1 m/s, 0.02 rad/s",
                  "noise": "has noise of 0.1 m, 0.05 rad, 0.1 m/s, 0.1 rad/s"}),
    _Sensor("laser", topics.SCAN, "the laser",
            bias={"ranges_f32": 0.5, "reference_m": 0.5},
            noise={"ranges_f32": 0.3, "reference_m": 0.3},
            grain={"ranges_f32": 0.01, "reference_m": 0.01},
            titles={"bias": "sees everything 0.5 m farther than it is, its reference too",
                  "noise": "has 0.3 m of noise on each ray, as in spray"}),
    _Sensor("light", topics.LIGHT, "the light sensor",
            bias={"illuminance_lux": 800.0}, noise={"illuminance_lux": 200.0},
            grain={"illuminance_lux": 5.0},
            titles={"bias": "sees 800 lux of stray light, half a healthy light of 200 cd",
                  "noise": "has 200 lux of noise"}),
    _Sensor("absolute-pose", topics.ABSOLUTE_POSE, "the absolute localization",
            bias={"x_m": 0.7, "y_m": 0.7}, noise={"x_m": 0.3, "y_m": 0.3, "yaw_rad": 0.1},
            drift={"x_m": 0.1, "y_m": 0.1, "yaw_rad": 0.01},
            grain={"x_m": 0.01, "y_m": 0.01, "yaw_rad": 0.003},
            titles={"bias": "is 1 m off to the north-east",
                  "drift": "drifts by 0.14 m/s and 0.01 rad/s",
                  "noise": "has noise of 0.3 m and 0.1 rad"},
            seen_by={"bias": ("DM1",), "drift": ("DM1",), "dropout": ("DM6",)}),
    _Sensor("encoders", topics.BASE_STATUS, "the base's status with its wheel speeds",
            bias={"wheel_speeds_radps": 1.0}, noise={"wheel_speeds_radps": 1.0},
            drift={"wheel_speeds_radps": 0.1}, grain={"wheel_speeds_radps": 0.05},
            titles={"bias": "has each wheel turn 1 rad/s, 12 cm/s, too fast",
                  "drift": "has each wheel turn faster by 0.1 rad/s each second",
                  "noise": "has noise of 1 rad/s on each wheel"}))
"""The sensors of the robot. Bias of the light sensor: 200 cd at 0.35 m cause 1633 lux
(`rampart.actors.osmosis.airport.photometry`), so with 800 lux a failed light is near the limit of
half its intensity. A laser does not drift: its time of flight depends on a quartz. Nor does the
light sensor: a photodiode ages over years. A bias of odometry affects its twist only, since the
origin of `odom` is arbitrary (REP-105)."""


def _faults_of(sensor: _Sensor) -> list[Fault]:
    corrupt = Disturbance(sensor.topic.key, "corrupt")
    ways = {
        "bias": replace(corrupt, add_fields=sensor.bias),
        "drift": replace(corrupt, ramp_fields=sensor.drift),
        "slow-drift": replace(corrupt, ramp_fields=_share(sensor.drift, _SLOW)),
        "creep": replace(corrupt, ramp_fields=_share(sensor.drift, _CREEP)),
        "noise": replace(corrupt, noise_fields=sensor.noise),
        "dropout": replace(corrupt, mode="drop"),
        "stuck": replace(corrupt, mode="stuck")}
    titles = {"dropout": "gives no reading", "stuck": "repeats its last value with fresh stamps",
            **sensor.titles}
    if "drift" in titles:
        titles |= {"slow-drift": f"drifts by {_SLOW:.0%} of {sensor.name}-drift",
                 "creep": f"drifts by {_CREEP:.0%} of {sensor.name}-drift"}
    found = [Fault(f"{sensor.name}-{way}", f"{sensor.what} {titles[way]}", (what,),
                   sensor.seen_by.get(way, ()), _TO_GROW_S if "drift" in way else _FOR_A_WHILE_S,
                   _SENSOR_GROUP)
             for way, what in ways.items() if way in titles]
    return [*found, Fault(
        f"{sensor.name}-stuck-noise", f"{sensor.what} repeats its last value with a little noise",
        (ways["stuck"], replace(corrupt, noise_fields=sensor.grain)), (), _FOR_A_WHILE_S,
        _SENSOR_GROUP)]


def _share(amounts: Mapping[str, float], share: float) -> dict[str, float]:
    return {name: amount * share for name, amount in amounts.items()}


SENSOR_FAULTS: Mapping[str, Fault] = {
    fault.name: fault for sensor in SENSORS for fault in _faults_of(sensor)}
"""The faults of the sensors."""

_FROZEN_GROUP = "frozen"
FROZEN_SETS: Mapping[str, Fault] = {fault.name: fault for fault in (
    Fault("-".join(("frozen", *(sensor.name for sensor in sensors))),
          f"{' and '.join(sensor.what for sensor in sensors)} get stuck in the same moment",
          tuple(Disturbance(sensor.topic.key, "stuck") for sensor in sensors), (),
          _FOR_A_WHILE_S, _FROZEN_GROUP)
    for count in (2, 3) for sensors in combinations(
        [sensor for sensor in SENSORS if sensor.topic is not topics.LIGHT], count))}
"""Sets of two and three sensors that get stuck at the same time."""


@dataclass(frozen=True, slots=True)
class SuddenObstacle:
    """An obstacle ahead of the robot, with `distance_m` between the centres."""

    distance_m: float
    radius_m: float
    duration_s: float


SIZES = Sizes((
    ("_m", 0.5, 3.0), ("_rad", 0.3, 1.5), ("_mps", 0.2, 0.8), ("_radps", 0.2, 1.0),
    ("_mps2", 0.5, 2.0), ("_s", 1.0, 10.0), ("_lux", 200.0, 1000.0), ("_cd", 50.0, 150.0),
    ("_f32", 0.3, 1.5), ("waypoints", 0.5, 3.0), ("", 0.1, 0.5)), ("_s", "_lux", "_cd"))
"""Error sizes of the numbers in messages."""


class OsmosisFaults(Faults):
    """Besides disturbances of topics: `stuck-wheel[:WHEEL]`, `weak-wheel[:WHEEL[:STRENGTH]]`,
    `brake-failure[:STRENGTH]` for the actuators, `obstacle-ahead[:METRES]` for the world.
    """  # noqa: D205 names that must not be broken

    named = {**PAPER_FAULTS, **SENSOR_FAULTS, **FROZEN_SETS}
    sizes = SIZES
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
    kinds = {"none": "no fault", "paper": "paper's faults", "topic": "topics",
             "reading": "nonsense readings", "sensor": "sensors", "frozen": "frozen sets",
             "process": "processes", "actuator": "actuators", "world": "the world",
             "several": "several at once"}

    def own(self, fault: str, injection: str, duration_s: float | None
            ) -> tuple[Order, ...] | SuddenObstacle | None:
        """Return the order of an actuator fault, or the sudden obstacle."""
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
                raise ScenarioError(f"fault {fault!r}: unknown wheel {name!r}; known: "
                                    f"{', '.join(_WHEELS)}")
            wheel, usual = _WHEELS[name], _WEAK
        return (Order(topics.ACTUATOR_FAULT, ActuatorFault(
            injection, ActuatorFaultKind(kind.replace("-", " ")), wheel,
            number(fault, details, usual), lasts_s)),)
