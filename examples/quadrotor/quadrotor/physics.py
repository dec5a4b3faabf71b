"""The simulated vehicle: MuJoCo, wind, battery, speed controllers, noisy sensors.

Not simulated: the flow of the rotors (ground effect, vortex rings), vibration, blocked satellites,
magnetic fields of the motors, obstacles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from quadrotor import topics as t
from quadrotor.rotation import Quaternion, tilt, yaw
from quadrotor.rotors import SpeedControllers
from quadrotor.vehicle import MOST_THRUST_N, Vector
from rampart import Application, Topic
from rampart.sim.runs.physics import RobotModel

STEP_S = 0.002

_MODEL = Path(__file__).with_name("quadrotor.xml")
_DRAG_NSPM = 0.3
_GUST_MPS, _GUST_S = 0.4, 3.0
_CAPACITY_AS = 2.2 * 3600
_EMPTY = 0.05
_GYRO_RADPS, _ACCEL_MPS2 = 0.006, 0.12
_GPS_XY_M, _GPS_Z_M, _GPS_MPS, _BARO_M, _HEADING_RAD = 0.35, 0.6, 0.08, 0.12, 0.02


@dataclass(slots=True)
class Health:
    """Share of the thrust of each rotor, and how fast the battery drains."""

    rotors: list[float] = field(default_factory=lambda: [1.0] * 4)
    drain: float = 1.0


class Physics:
    """The vehicle on flat ground, feet at the origin of `map`.

    Args:
        seed: seed of wind and noise.
        wind_mps: mean wind; its direction follows from the seed.
        charge: charge of the battery, from 0 to 1.
        rotors: their speed controllers.
        start_s: simulated time now.
    """

    def __init__(self, seed: int, wind_mps: float, charge: float, rotors: SpeedControllers,
                 start_s: float) -> None:
        self._model = mujoco.MjModel.from_xml_path(str(_MODEL))
        self._data = mujoco.MjData(self._model)
        self._dice = np.random.default_rng(seed)
        towards_rad = self._dice.uniform(-math.pi, math.pi)
        self._wind = wind_mps * np.array([math.cos(towards_rad), math.sin(towards_rad), 0.0])
        self._gust = np.zeros(3)
        self._imu_off = np.concatenate([self._dice.normal(0.0, 0.001, (3, 3)),
                                        self._dice.normal(0.0, 0.03, (3, 3))], axis=1)
        self._rotors = rotors
        self._start_s = start_s
        self._steps = 0
        self._air_s = 0.0
        self.now_s = start_s
        self.health = Health()
        self.charge = charge
        self.touch_speed_mps = self.touch_tilt_rad = self.highest_tilt_rad = 0.0
        mujoco.mj_forward(self._model, self._data)

    @property
    def turning(self) -> bool:
        """Whether a rotor turns."""
        return bool(max(self._data.ctrl) > 1e-6)

    def step_to(self, time_s: float) -> None:
        """Advance the physics to a simulated time."""
        while self._start_s + (self._steps + 1) * STEP_S <= time_s + 1e-9:
            self._step()

    @property
    def data(self) -> mujoco.MjData:
        """MuJoCo's state."""
        return self._data

    def skip(self, time_s: float) -> None:
        """Let time pass without motion, after the process was stopped."""
        self._start_s += max(0.0, time_s - self.now_s)
        self.now_s = self._start_s + self._steps * STEP_S

    def _step(self) -> None:
        model, data = self._model, self._data
        if self._steps % 5 == 0:
            self._slow_forces()
        before_mps = float(data.qvel[2])
        mujoco.mj_step(model, data)
        self._steps += 1
        self.now_s = self._start_s + self._steps * STEP_S
        tilt_rad = tilt(self.attitude)
        self.highest_tilt_rad = max(self.highest_tilt_rad, tilt_rad)
        if data.ncon == 0:
            self._air_s += STEP_S
        else:
            if self._air_s > 0.1 or before_mps < -0.5:
                self.touch_speed_mps = max(self.touch_speed_mps, -before_mps)
                self.touch_tilt_rad = max(self.touch_tilt_rad, tilt_rad)
            self._air_s = 0.0

    def _slow_forces(self) -> None:
        """Update wind, battery and rotors, every fifth step."""
        data, each_s = self._data, 5 * STEP_S
        self._gust += (-self._gust * each_s / _GUST_S + self._dice.normal(0.0, 1.0, 3)
                       * _GUST_MPS * math.sqrt(2 * each_s / _GUST_S))
        data.xfrc_applied[1, :3] = -_DRAG_NSPM * (data.qvel[:3] - self._wind - self._gust)
        most_n = MOST_THRUST_N * min(1.0, max(self.charge, 0.0) / _EMPTY)
        for i, thrust_n in enumerate(self._rotors.turn(self.now_s)):
            data.ctrl[i] = min(thrust_n, most_n) * self.health.rotors[i]
        self.charge = max(0.0, self.charge - self.health.drain * self.current_a * each_s
                          / _CAPACITY_AS)

    # -- sensors ----------------------------------------------------------------------------------

    @property
    def attitude(self) -> Quaternion:
        """True attitude, `base_link` to `map`."""
        w, x, y, z = self._data.qpos[3:7].tolist()
        return w, x, y, z

    @property
    def current_a(self) -> float:
        """Current of the battery: 0.3 A for the electronics, the rest for the rotors."""
        return 0.3 + float(np.sum(np.maximum(self._data.act, 0.0) ** 1.5)) * 0.65

    def imu(self, which: int) -> t.Imu:
        """Read one of the IMUs."""
        values = self._data.sensordata + self._imu_off[which] + self._noise(6) * _IMU_NOISE
        return t.Imu(*values.tolist())

    def gps(self) -> t.GpsFix:
        """Read the satellite receiver."""
        x, y, z = (self._data.qpos[:3] + self._noise(3) * _GPS_NOISE).tolist()
        vx, vy, vz = (self._velocity() + self._noise(3) * _GPS_MPS).tolist()
        return t.GpsFix(x, y, z, vx, vy, vz)

    def barometer(self) -> t.Barometer:
        """Read the barometer."""
        return t.Barometer(float(self._data.qpos[2]) + _BARO_M * float(self._dice.normal()))

    def heading(self) -> t.Heading:
        """Read the magnetometer."""
        return t.Heading(yaw(self.attitude) + _HEADING_RAD * float(self._dice.normal()))

    def battery(self) -> t.Battery:
        """Read the battery, under load."""
        voltage_v = 13.2 + 3.4 * self.charge - 0.02 * self.current_a
        return t.Battery(self.charge, voltage_v, self.current_a)

    def esc(self) -> t.EscStatus:
        """Read the rotors' speed controllers."""
        return t.EscStatus(self._rotors.age_s(self.now_s), self.turning, self._rotors.obeys,
                           self._rotors.thrusts)

    def truth(self) -> t.Truth:
        """Return the ground truth."""
        x, y, z = self._data.qpos[:3].tolist()
        return t.Truth(x, y, z, float(np.linalg.norm(self._velocity())), tilt(self.attitude),
                       bool(self._data.ncon > 0), self.turning, self.touch_speed_mps,
                       self.touch_tilt_rad, self.highest_tilt_rad)

    @property
    def position(self) -> Vector:
        """True position of the feet, m."""
        x, y, z = self._data.qpos[:3].tolist()
        return x, y, z

    def _velocity(self) -> npt.NDArray[np.float64]:
        velocity: npt.NDArray[np.float64] = self._data.qvel[:3]
        return velocity

    def _noise(self, count: int) -> npt.NDArray[np.float64]:
        return self._dice.normal(0.0, 1.0, count)


_IMU_NOISE = np.array([_GYRO_RADPS] * 3 + [_ACCEL_MPS2] * 3)
_GPS_NOISE = np.array([_GPS_XY_M, _GPS_XY_M, _GPS_Z_M])


class QuadrotorModel(RobotModel):
    """The vehicle of a replay, at its estimate."""

    def __init__(self, _application: Application) -> None:
        super().__init__(mujoco.MjModel.from_xml_path(str(_MODEL)))

    def take(self, _topic: Topic[Any], body: Any) -> None:
        """Move the vehicle."""
        if isinstance(body, t.Estimate):
            self.stand((body.x_m, body.y_m, body.z_m), body.attitude)
