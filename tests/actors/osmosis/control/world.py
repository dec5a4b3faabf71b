"""A small kinematic world for the control nodes' tests: unicycle, circles, a laser."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from rampart.actors.osmosis.control.polyline import Array, Hull, Polyline
from rampart.actors.osmosis.messages import LaserScan

HULL = Hull()
DT_S = 0.05


@dataclass
class Circle:
    x_m: float
    y_m: float
    radius_m: float


@dataclass
class World:
    """A robot that follows velocity commands with limited acceleration, among circles."""

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0
    circles: list[Circle] = field(default_factory=list)
    linear_mps: float = 0.0
    angular_radps: float = 0.0
    deceleration_mps2: float = 1.5
    track: list[tuple[float, float]] = field(default_factory=list)
    least_clearance_m: float = math.inf

    def scan(self, noise_m: float = 0.0, rays: int = 271, range_max_m: float = 10.0) -> Array:
        """Echoes of a 270 degree laser at `base_link`, shape (n, 2)."""
        angles = np.linspace(-0.75 * math.pi, 0.75 * math.pi, rays)
        directions = np.column_stack((np.cos(angles), np.sin(angles)))
        ranges = np.full(rays, range_max_m)
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        for circle in self.circles:
            dx, dy = circle.x_m - self.x_m, circle.y_m - self.y_m
            centre = np.array((cos * dx + sin * dy, cos * dy - sin * dx))
            along = directions @ centre
            square = circle.radius_m**2 - (centre @ centre - along**2)
            hit = (square >= 0.0) & (along > 0.0)
            ranges[hit] = np.minimum(ranges[hit], along[hit] - np.sqrt(square[hit]))
        if noise_m:
            ranges = ranges + np.random.default_rng(len(self.track)).normal(0, noise_m, rays)
        echo = ranges < range_max_m - 0.1
        return np.asarray((directions * ranges[:, None])[echo])

    def move(self, linear_mps: float, angular_radps: float) -> None:
        """Apply a command for one control period."""
        for _ in range(5):
            dt = DT_S / 5
            fall = self.deceleration_mps2 * dt
            self.linear_mps += min(max(linear_mps - self.linear_mps, -fall), fall)
            swing = 6.0 * dt
            self.angular_radps += min(max(angular_radps - self.angular_radps, -swing), swing)
            self.yaw_rad += self.angular_radps * dt
            self.x_m += self.linear_mps * math.cos(self.yaw_rad) * dt
            self.y_m += self.linear_mps * math.sin(self.yaw_rad) * dt
            self.least_clearance_m = min(self.least_clearance_m, self.clearance())
        self.track.append((self.x_m, self.y_m))

    def clearance(self) -> float:
        """True distance from the hull to the nearest circle."""
        cos, sin = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        best = math.inf
        for circle in self.circles:
            dx, dy = circle.x_m - self.x_m, circle.y_m - self.y_m
            point = np.array(((cos * dx + sin * dy, cos * dy - sin * dx),))
            best = min(best, float(HULL.distance(point)[0]) - circle.radius_m)
        return best

    def deviation(self, route: list[tuple[float, float]]) -> float:
        """Largest distance of the track from a route."""
        line = Polyline(route)
        return max(abs(line.project(x, y).n_m) for x, y in self.track)


Gate = Callable[[float, float, Array], tuple[float, float]]


def drive(world: World, follower, seconds: float, gate: Gate | None = None):
    """Run a follower in the world until it arrives or time is up; return the last Motion."""
    motion = None
    for _ in range(round(seconds / DT_S)):
        points = world.scan(noise_m=0.01)
        motion = follower.step(world.x_m, world.y_m, world.yaw_rad, points, DT_S)
        if motion.arrived:
            return motion
        linear, angular = motion.linear_mps, motion.angular_radps
        if gate is not None:
            linear, angular = gate(linear, angular, points)
        world.move(linear, angular)
    return motion


RAYS = 181
TOP_M = 8.0
STEP_RAD = math.radians(270) / (RAYS - 1)


def full_sweep(range_m: float = TOP_M, number: int = 0) -> LaserScan:
    """Return a sweep with one range in all directions; `number` distinguishes sweeps."""
    return LaserScan(
        -math.radians(135), STEP_RAD, TOP_M, np.full(RAYS, range_m, "<f4").tobytes(),
        0.1 + 0.001 * math.sin(number + 1))
