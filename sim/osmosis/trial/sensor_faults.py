"""The sensor faults: each sensor of the Summit XL with each way in which a sensor fails.

* **bias**: a constant error from one moment on.
* **drift**: an error that grows with time.
* **noise**: Gaussian noise on top of the sensor's own.
* **dropout**: no reading at all.
* **stuck**: the sensor goes on publishing, with fresh stamps, the value it had. A freshness check
  cannot see it; a frozen *driver*, which repeats old stamps too, is `freeze:TOPIC`.

The magnitudes are those of a device that has failed, ten times and more beyond the noise that
`rampart.sim.osmosis.sensors` gives a healthy one, and within what the device could report. No
receiver notices its own error: `accuracy_m` stays what it was. The shipped controller hears neither
the odometry nor the IMU (`rampart topic info`): these faults change messages there, and no mission.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from msgspec.structs import replace

from rampart.actors.bus.topic import Topic
from rampart.actors.osmosis import topics
from rampart.sim.faults.disturbance import Disturbance, Fault

GROUP = "sensor"
_FOR_A_WHILE_S = 10.0
_TO_GROW_S = 20.0


@dataclass(frozen=True, slots=True)
class _Sensor:
    """A sensor with the size of its errors: field → amount, for `drift` per second.

    It has the faults of which it says something, besides dropout and stuck.
    """

    name: str
    topic: Topic[Any]
    what: str
    bias: Mapping[str, float]
    noise: Mapping[str, float]
    drift: Mapping[str, float] = field(default_factory=dict)
    says: Mapping[str, str] = field(default_factory=dict)
    seen_by: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


SENSORS = (
    _Sensor("gps", topics.GPS, "the GPS receiver",
            bias={"x_m": 1.5, "y_m": 1.5},
            noise={"x_m": 1.5, "y_m": 1.5, "velocity_x_mps": 0.3, "velocity_y_mps": 0.3},
            drift={"x_m": 0.1, "y_m": 0.1},
            says={"bias": "is 2.1 m off to the north-east, as by multipath at a hangar",
                  "drift": "drifts north-east by 0.14 m/s",
                  "noise": "has lost its RTK fix: 1.5 m noise, 0.3 m/s in velocity"},
            seen_by={"dropout": ("DM1",)}),
    _Sensor("imu", topics.IMU, "the IMU",
            bias={"yaw_rate_radps": 0.05, "accel_x_mps2": 0.3, "accel_y_mps2": 0.3},
            noise={"yaw_rad": 0.05, "yaw_rate_radps": 0.1, "accel_x_mps2": 1.0,
                   "accel_y_mps2": 1.0},
            drift={"yaw_rad": 0.02},
            says={"bias": "has a turn-on bias: 0.05 rad/s and 0.3 m/s2",
                  "drift": "has a heading that drifts by 0.02 rad/s",
                  "noise": "shakes on a loose mount: 0.1 rad/s, 1 m/s2, 0.05 rad of noise"}),
    _Sensor("odom", topics.ODOMETRY, "the odometry",
            bias={"twist.linear_mps": 0.1, "twist.angular_radps": 0.05},
            noise={"pose.x_m": 0.1, "pose.y_m": 0.1, "pose.yaw_rad": 0.05,
                   "twist.linear_mps": 0.1, "twist.angular_radps": 0.1},
            drift={"pose.x_m": 0.1, "pose.yaw_rad": 0.02},
            says={"bias": "reports 0.1 m/s and 0.05 rad/s too much, as with worn tyres",
                  "drift": "counts slipping wheels: 0.1 m/s, 0.02 rad/s",
                  "noise": "has noise of 0.1 m, 0.05 rad, 0.1 m/s, 0.1 rad/s"}),
    _Sensor("laser", topics.SCAN, "the laser",
            bias={"ranges_f32": 0.5, "reference_m": 0.5},
            noise={"ranges_f32": 0.3, "reference_m": 0.3},
            says={"bias": "sees everything 0.5 m farther than it is, its reference too",
                  "noise": "has 0.3 m of noise on each ray, as in spray"}),
    _Sensor("light", topics.LIGHT, "the light sensor",
            bias={"illuminance_lux": 800.0}, noise={"illuminance_lux": 200.0},
            says={"bias": "sees 800 lux of stray light, half a healthy light of 200 cd",
                  "noise": "has 200 lux of noise"}),
    _Sensor("absolute-pose", topics.ABSOLUTE_POSE, "the absolute localization",
            bias={"x_m": 0.7, "y_m": 0.7}, noise={"x_m": 0.3, "y_m": 0.3, "yaw_rad": 0.1},
            drift={"x_m": 0.1, "y_m": 0.1, "yaw_rad": 0.01},
            says={"bias": "is 1 m off to the north-east",
                  "drift": "drifts by 0.14 m/s and 0.01 rad/s",
                  "noise": "has noise of 0.3 m and 0.1 rad"},
            seen_by={"bias": ("DM1",), "drift": ("DM1",), "dropout": ("DM6",)}))
"""The sensors of the robot. Bias of the light sensor: 200 cd at 0.35 m give 1633 lux
(`rampart.actors.osmosis.airport.photometry`), so 800 lux lift a dead light near the limit of half
its intensity."""

LEFT_OUT: Mapping[str, str] = {
    "laser-drift": "time of flight is held by a quartz: it drifts by millimetres an hour",
    "light-drift": "a photodiode ages over years; within one mission that is light-bias"}
"""Combinations that make no sense, and why. A bias of the odometry is one of its twist only: a
constant offset of a pose in `odom`, whose origin is arbitrary (REP-105), is no error."""


def _faults_of(sensor: _Sensor) -> list[Fault]:
    corrupt = Disturbance(sensor.topic.key, "corrupt")
    ways = {
        "bias": replace(corrupt, add_fields=sensor.bias),
        "drift": replace(corrupt, ramp_fields=sensor.drift),
        "noise": replace(corrupt, noise_fields=sensor.noise),
        "dropout": replace(corrupt, mode="drop"),
        "stuck": replace(corrupt, mode="stuck")}
    says = {"dropout": "gives no reading", "stuck": "repeats its last value with fresh stamps",
            **sensor.says}
    return [Fault(f"{sensor.name}-{way}", f"{sensor.what} {says[way]}", (what,),
                  sensor.seen_by.get(way, ()), _TO_GROW_S if way == "drift" else _FOR_A_WHILE_S,
                  GROUP)
            for way, what in ways.items() if way in says]


SENSOR_FAULTS: Mapping[str, Fault] = {
    fault.name: fault for sensor in SENSORS for fault in _faults_of(sensor)}
"""The faults of the sensors."""
