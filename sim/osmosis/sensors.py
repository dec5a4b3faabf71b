"""The robot's sensors: measurements of the true state, each with its own seeded noise.

Noise is typical of the devices: RTK-GPS 2 cm, a 2D safety laser 1 cm, a MEMS IMU, encoders with
4096 counts per turn, a lux meter of 1 %.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.airport.model import Airport, WorldTruth
from rampart.actors.osmosis.airport.photometry import SENSOR_HEIGHT_M, sensor_position
from rampart.sim.osmosis.robot import WheelSpeeds, twist_from_wheels
from rampart.sim.osmosis.scene import SOLID_GROUP

Floats = npt.NDArray[np.float64]


class Noise:
    """Standard normal numbers, drawn in blocks for speed."""

    BLOCK = 256

    def __init__(self, rng: np.random.Generator, width: int) -> None:
        self._rng = rng
        self._width = width
        self._rows: list[list[float]] = []

    def take(self) -> list[float]:
        """Return the next `width` numbers."""
        if not self._rows:
            self._rows = self._rng.normal(size=(self.BLOCK, self._width)).tolist()
        return self._rows.pop()


@dataclass(frozen=True, slots=True)
class LaserSpec:
    """The 2D laser above `base_link`; ranges are from the robot's centre.

    Args:
        rays: number of rays, two or more, evenly over the field of view, from right to left.
        field_of_view_rad: centred on straight ahead.
        range_max_m: range, and the reading without an echo.
        height_m: height above the ground, between the chassis and the top of the obstacles.
        noise_m: standard deviation.
        reference_m: distance of the target in the housing, measured once a sweep.
    """

    rays: int = 181
    field_of_view_rad: float = math.radians(270)
    range_max_m: float = 8.0
    height_m: float = 0.45
    noise_m: float = 0.01
    reference_m: float = 0.1

    @property
    def angle_min_rad(self) -> float:
        """Angle of the first ray, rightmost."""
        return -self.field_of_view_rad / 2

    @property
    def angle_increment_rad(self) -> float:
        """Angle between rays."""
        return self.field_of_view_rad / (self.rays - 1)


class Laser:
    """Casts the rays with MuJoCo against buildings and present obstacles."""

    def __init__(self, spec: LaserSpec, rng: np.random.Generator) -> None:
        self.spec = spec
        self._rng = rng
        self._noise: Floats = np.empty((0, spec.rays))
        angles = spec.angle_min_rad + spec.angle_increment_rad * np.arange(spec.rays)
        self._body = np.column_stack((np.cos(angles), np.sin(angles), np.zeros(spec.rays)))
        self._turn = np.eye(3)
        self._rays = np.zeros((spec.rays, 3))
        self._flat = self._rays.reshape(-1)
        self._geoms = np.zeros(spec.rays, dtype=np.int32)
        self._ranges = np.zeros(spec.rays)
        self._origin = np.array([0.0, 0.0, spec.height_m])
        self._groups = np.zeros(6, dtype=np.uint8)
        self._groups[SOLID_GROUP] = 1
        self._reference_noise = Noise(rng.spawn(1)[0], 1)

    def reference(self) -> float:
        """Return the range to the target in the housing, m."""
        return self.spec.reference_m + self.spec.noise_m * self._reference_noise.take()[0]

    def cast(self, model: Any, data: Any, pose: tuple[float, float, float]) -> Floats:
        """Return the true ranges, m, per ray; the next call overwrites the array."""
        x_m, y_m, yaw_rad = pose
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        self._turn[0, :2] = cos, sin
        self._turn[1, :2] = -sin, cos
        np.dot(self._body, self._turn, out=self._rays)
        self._origin[:2] = x_m, y_m
        mujoco.mj_multiRay(model, data, self._origin, self._flat, self._groups, True, -1,
                           self._geoms, self._ranges, None, self.spec.rays, self.spec.range_max_m)
        self._ranges[self._geoms < 0] = math.inf
        return self._ranges

    def sweep(self, true_m: Floats) -> Floats:
        """Return the measured ranges, m; `range_max_m` without an echo."""
        if not len(self._noise):
            self._noise = self._rng.normal(0.0, self.spec.noise_m, (64, self.spec.rays))
        ranges: Floats = true_m + self._noise[-1]
        self._noise = self._noise[:-1]
        np.maximum(ranges, 0.0, out=ranges)
        np.minimum(ranges, self.spec.range_max_m, out=ranges)
        return ranges


class Gps:
    """RTK-GPS with its antenna above `base_link`."""

    POSITION_SIGMA_M = 0.02
    VELOCITY_SIGMA_MPS = 0.03

    def __init__(self, rng: np.random.Generator) -> None:
        self._noise = Noise(rng, 4)

    def read(self, x_m: float, y_m: float, vx_mps: float, vy_mps: float) -> m.GpsFix:
        """Return a fix for the true position and velocity in `map`."""
        n = self._noise.take()
        return m.GpsFix(x_m + self.POSITION_SIGMA_M * n[0], y_m + self.POSITION_SIGMA_M * n[1],
                        vx_mps + self.VELOCITY_SIGMA_MPS * n[2],
                        vy_mps + self.VELOCITY_SIGMA_MPS * n[3], self.POSITION_SIGMA_M)


class Imu:
    """Strap-down IMU: rate and specific force are means since the last reading.

    The heading starts at the truth, as after an alignment, and drifts with the gyro's bias.
    """

    RATE_SIGMA_RADPS = 0.003
    RATE_BIAS_SIGMA_RADPS = 2e-4
    ACCELERATION_SIGMA_MPS2 = 0.05

    def __init__(self, rng: np.random.Generator, yaw_rad: float, now_s: float) -> None:
        self._noise = Noise(rng, 3)
        self._bias = float(rng.normal(0.0, self.RATE_BIAS_SIGMA_RADPS))
        self._heading = yaw_rad
        self._last = (now_s, yaw_rad, 0.0, 0.0)

    def read(self, now_s: float, yaw_rad: float, vx_mps: float, vy_mps: float) -> m.Imu:
        """Return a reading for the true heading and velocity (in `map`)."""
        then_s, then_yaw, then_vx, then_vy = self._last
        dt_s = now_s - then_s
        n = self._noise.take()
        if dt_s <= 0:
            return m.Imu(self._heading, self._bias + self.RATE_SIGMA_RADPS * n[0], 0.0, 0.0)
        self._last = (now_s, yaw_rad, vx_mps, vy_mps)
        rate = wrap(yaw_rad - then_yaw) / dt_s + self._bias + self.RATE_SIGMA_RADPS * n[0]
        self._heading = wrap(self._heading + rate * dt_s)
        ax, ay = (vx_mps - then_vx) / dt_s, (vy_mps - then_vy) / dt_s
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        return m.Imu(self._heading, rate, ax * cos + ay * sin + self.ACCELERATION_SIGMA_MPS2 * n[1],
                     ay * cos - ax * sin + self.ACCELERATION_SIGMA_MPS2 * n[2])


class WheelOdometry:
    """Integrates encoder counts with the nominal slip factor; real slip makes it drift."""

    COUNT_RAD = 2 * math.pi / 4096

    def __init__(self, angles: WheelSpeeds, now_s: float) -> None:
        self._counts = self._count(angles)
        self._at_s = now_s
        self._reading = m.Odometry(m.Pose(0.0, 0.0, 0.0), m.Twist(0.0, 0.0))

    def read(self, angles: WheelSpeeds, now_s: float) -> m.Odometry:
        """Return the odometry for wheel angles (rad: front left, front right, rear left, right)."""
        dt_s = now_s - self._at_s
        if dt_s <= 0:
            return self._reading
        counts = self._count(angles)
        fl, fr, rl, rr = (
            (new - old) * self.COUNT_RAD for new, old in zip(counts, self._counts, strict=True))
        self._counts, self._at_s = counts, now_s
        forward_m, turn_rad = twist_from_wheels((fl, fr, rl, rr))
        was = self._reading.pose
        middle = was.yaw_rad + turn_rad / 2
        self._reading = m.Odometry(
            m.Pose(was.x_m + forward_m * math.cos(middle), was.y_m + forward_m * math.sin(middle),
                   wrap(was.yaw_rad + turn_rad)),
            m.Twist(forward_m / dt_s, turn_rad / dt_s))
        return self._reading

    def _count(self, angles: WheelSpeeds) -> tuple[int, ...]:
        return tuple(math.floor(angle / self.COUNT_RAD) for angle in angles)


class LightSensor:
    """Lux meter over the ground ahead of the robot; see `airport.photometry`."""

    NOISE_SHARE = 0.01
    NOISE_LUX = 0.5
    AMBIENT_LUX = 2.0
    """Apron lighting at night, modelled as constant."""

    def __init__(self, airport: Airport, truth: WorldTruth, rng: np.random.Generator) -> None:
        real = truth.intensity_cd(airport)
        self._noise = Noise(rng, 2)
        self._x = np.array([light.x_m for light in airport.lights], dtype=float)
        self._y = np.array([light.y_m for light in airport.lights], dtype=float)
        self._intensity = np.array([real[light.name] for light in airport.lights], dtype=float)

    def illuminance_lux(self, pose: tuple[float, float, float]) -> float:
        """Return the true illuminance from all lights at the sensor, without noise."""
        x_m, y_m = sensor_position(*pose)
        h = SENSOR_HEIGHT_M
        square = (self._x - x_m) ** 2 + (self._y - y_m) ** 2 + h * h
        return h * float(np.dot(self._intensity, square**-1.5))

    def read(self, pose: tuple[float, float, float]) -> float:
        """Return a reading, lux, never negative."""
        share, floor = self._noise.take()
        clean = self.illuminance_lux(pose) + self.AMBIENT_LUX
        return max(0.0, clean * (1 + self.NOISE_SHARE * share) + self.NOISE_LUX * floor)


def wrap(angle_rad: float) -> float:
    """Return the angle in (-pi, pi]."""
    return math.pi - (math.pi - angle_rad) % (2 * math.pi)
