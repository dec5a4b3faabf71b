"""The quadrotor's faults: its sensors, its rotors, its battery.

Faults of topics (`drop:sensors/gps`) and processes (`kill:pilot`) need no entry here. The total
loss of a rotor is left out: three rotors cannot hold the attitude, and this controller cannot fly
while the vehicle spins.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from quadrotor import topics as t
from rampart import Disturbance, Fault, Faults, Order, ScenarioError, Topic

_WEAK, _DRAIN = 0.7, 12.0
_KINDS = {"weak-rotor": "rotor", "battery-drain": "battery"}


def _sensor(name: str, title: str, topic: Topic[Any], mode: str, lasts_s: float,
            **how: Mapping[str, float]) -> Fault:
    return Fault(name, title, (Disturbance(topic.key, mode, **how),), (),  # type: ignore[arg-type]
                 lasts_s, "sensor")


class QuadrotorFaults(Faults):
    """Faults besides those of any system: sensors by name, `weak-rotor[:ROTOR[:SHARE]]`,
    `battery-drain[:FACTOR]`.
    """  # noqa: D205 names that must not be broken

    named = {fault.name: fault for fault in (
        _sensor("gps-bias", "the GPS is off by 8 m to the east", t.GPS, "corrupt", 30.0,
                add_fields={"x_m": 8.0}),
        _sensor("gps-drift", "the GPS drifts north by 0.5 m/s", t.GPS, "corrupt", 60.0,
                ramp_fields={"y_m": 0.5}),
        _sensor("gps-dropout", "the GPS loses its fix", t.GPS, "drop", math.inf),
        _sensor("barometer-bias", "the barometer reads 6 m too low", t.BAROMETER, "corrupt", 30.0,
                add_fields={"altitude_m": -6.0}),
        _sensor("barometer-stuck", "the barometer repeats itself", t.BAROMETER, "stuck", 60.0),
        _sensor("imu-bias", "an IMU reads a rotation and a fall", t.IMU_1, "corrupt", 30.0,
                add_fields={"gyro_x_radps": 1.0, "accel_z_mps2": -6.0}),
        _sensor("imu-noise", "an IMU is noisy", t.IMU_2, "corrupt", 30.0,
                noise_fields={"gyro_x_radps": 2.0, "gyro_y_radps": 2.0, "accel_x_mps2": 8.0}),
        _sensor("imu-stuck", "an IMU repeats itself", t.IMU_3, "stuck", 30.0),
        _sensor("heading-bias", "the magnetometer is off by 0.6 rad", t.HEADING, "corrupt", 20.0,
                add_fields={"yaw_rad": 0.6}),
    )}
    others = {"vehicle": (*(f"weak-rotor:{i}:{_WEAK}" for i in range(4)),
                          f"battery-drain:{_DRAIN:g}")}
    titled = {"weak-rotor": ("vehicle", "the front left rotor loses 30 % of its thrust"),
              "battery-drain": ("vehicle", "the battery drains twelve times as fast")}
    kinds = {**Faults.kinds, "sensor": "sensors", "vehicle": "the vehicle"}

    def own(self, fault: str, injection: str, duration_s: float | None
            ) -> tuple[Order, ...] | None:
        """Return the order of a fault of the vehicle."""
        kind, *details = fault.split(":")
        if kind not in _KINDS:
            return None
        weak = kind == "weak-rotor"
        lasts_s = math.inf if duration_s is None else duration_s
        try:
            rotor = int(details.pop(0)) if weak and details else 0
            factor = float(details.pop(0)) if details else _WEAK if weak else _DRAIN
        except ValueError:
            raise ScenarioError(f"fault {fault!r}: expected numbers for rotor and share") from None
        most = 1.0 if weak else 1000.0
        if details or not 0 <= rotor <= 3 or not 0 <= factor <= most:
            raise ScenarioError(f"fault {fault!r}: expected a rotor of 0 to 3, then a number of 0 "
                                f"to {most:g}")
        return (Order(t.BODY_FAULT, t.BodyFault(
            injection, _KINDS[kind], rotor, factor, lasts_s)),)
