"""The world: airport, Summit XL, obstacles, and their ground truth. Synchronous.

The caller provides the time: `step_to(t)` advances the physics to t. So the same world runs in real
time and, many times faster, in virtual time.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from typing import Any

import msgspec
import mujoco
import numpy as np
import shapely

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.airport.model import Airport, WorldTruth, rectangle
from rampart.actors.runtime.checkpoint import StateFormat
from rampart.sim.osmosis import robot, sensors
from rampart.sim.osmosis.actuator_faults import ActuatorFaults, FaultNews, motor_of
from rampart.sim.osmosis.robot import CIRCUMRADIUS_M, LENGTH_M, WIDTH_M
from rampart.sim.osmosis.scene import Scene, Solid, WorldError

TICK_S = 0.01
"""The drive electronics' period, and the grain of `step_to`."""

TRUTH_PERIOD_S, CLOSE_TRUTH_PERIOD_S = 0.05, 0.02
"""Period of the ground truth; the second applies near an obstacle or the prohibited area."""

NEVER_S = 1e6
"""Age of the command before the first one."""

NEAR_M = 0.3
"""Distance for the shorter period."""

SAME_CONTACT_S = 0.5
"""A contact with the same object after a shorter break is the same collision."""

LOCKED_DAMPING = 300.0
"""Damping, N m s/rad, of a blocked wheel, braked or stuck."""

EXACT_BELOW_M = 1.0
"""Clearances above this may be lower bounds."""

Pose = tuple[float, float, float]
"""x m, y m, yaw rad in `map`."""


class WorldKept(msgspec.Struct, frozen=True):
    """State of the world for a resumed run: the robot stands at its pose, as after a power cut.

    Attributes:
        pose: x m, y m, yaw rad in `map`.
        obstacles: present obstacles: name, x m, y m, radius m.
        waiting: names of presets that have not appeared yet.
        leaving: time since `began_s` at which presets disappear, s.
        began_s: simulated start time of the world.
        collisions: number of collisions.
        prohibited_s: time spent in the prohibited area.
    """

    pose: tuple[float, float, float]
    obstacles: tuple[tuple[str, float, float, float], ...]
    waiting: tuple[str, ...]
    leaving: dict[str, float]
    began_s: float
    collisions: int
    prohibited_s: float


def _objection(kept: WorldKept) -> str:
    numbers = [*kept.pose, kept.began_s, kept.prohibited_s, *kept.leaving.values(),
               *(value for _, *place in kept.obstacles for value in place)]
    return "" if all(map(math.isfinite, numbers)) else "a number is not finite"


WORLD_STATE = StateFormat(WorldKept, version=1, objection=_objection)


class World:
    """An airport with the robot in it.

    Args:
        airport: geometry, start pose, obstacle presets.
        truth: real intensities of the lights.
        seed: seed of all noise; the same seed and calls give the same world bit by bit.
        obstacles: number of the airport's presets, from the first.
        dead_man_timeout_s: see `rampart.sim.osmosis.robot.Drive`.
        laser: field of view, range, number of rays.
        start_s: start time of the world.
        max_catch_up_s: longest time that one `step_to` simulates; more is skipped, so that a
            delayed caller is not delayed further.
        kept: state of a world to continue.

    Raises:
        WorldError: the airport has fewer presets than `obstacles`.
    """

    def __init__(self, airport: Airport, truth: WorldTruth | None = None, seed: int = 0,
                 obstacles: int = 0, *, dead_man_timeout_s: float | None = 0.4,
                 laser: sensors.LaserSpec | None = None, start_s: float = 0.0,
                 max_catch_up_s: float = 1.0, kept: WorldKept | None = None) -> None:
        if not 0 <= obstacles <= len(airport.obstacles):
            raise WorldError(f"obstacles: {obstacles}: expected 0 to {len(airport.obstacles)} on "
                             f"{airport.name}")
        self.airport = airport
        self.time_s = start_s
        self.skipped_s = 0.0
        self._start_s = start_s
        self._began_s = start_s
        self._max_catch_up_s = max_catch_up_s
        self._scene = Scene(airport)
        if kept:
            self._scene.place_robot(*kept.pose)
        self._model, self._data = self._scene.model, self._scene.data
        self._steps_per_tick = round(TICK_S / self._model.opt.timestep)
        self._ticks = 0
        # Views into MuJoCo's memory, since look-ups by name are slow. The free joint of the base
        # is first: 7 positions, 6 velocities; then the wheels.
        self._base_q, self._base_v = self._data.qpos[:7], self._data.qvel[:6]
        self._wheel_q, self._wheel_v = self._data.qpos[7:11], self._data.qvel[6:10]
        self._servos = self._data.ctrl
        self._targets: robot.WheelSpeeds | None = None
        self._damping = self._model.dof_damping[6:10]
        self._free_damping = self._damping.copy()
        self._locked = False
        self._drive = robot.Drive(robot.DriveLimits(), dead_man_timeout_s)
        self._torque_ranges = self._model.actuator_forcerange
        self._faults = ActuatorFaults(motor_of(self._model, self._drive.limits))
        self._faulty = False
        self.laser = laser or sensors.LaserSpec()
        streams = [np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(5)]
        self._lasers = [sensors.Laser(self.laser, streams[i]) for i in (0, 4)]
        self._echoes: tuple[int, sensors.Floats] = (-1, np.empty(0))
        self._gps = sensors.Gps(streams[1])
        self._imu = sensors.Imu(streams[2], self.pose[2], start_s)
        self._light = sensors.LightSensor(airport, truth or WorldTruth(), streams[3])
        self._odometry = sensors.WheelOdometry(_four(self._wheel_q), start_s)
        self._collisions = 0
        self._contact_s: dict[str, float] = {}
        self._prohibited_s = 0.0
        self._near_obstacle = Clearance(lambda pose: self._scene.clearance_m(footprint(pose)))
        self._near_prohibited = Clearance(self._prohibited_exactly)
        self._obstacle_clearance_m = math.inf
        self._prohibited_clearance_m = math.inf
        self._examined_s = start_s
        self._examine_at_s = start_s
        self._waiting = list(airport.obstacles[:obstacles])
        self._leaving: dict[str, float] = {}
        if kept:
            self._restore(kept)
        self._bring_obstacles()
        self._examine()

    @property
    def data(self) -> mujoco.MjData:
        """State in MuJoCo."""
        return self._data

    # -- actuators ------------------------------------------------------------------------------

    def command(self, linear_mps: float, angular_radps: float, stamp_s: float | None = None
                ) -> bool:
        """Pass a velocity command of a time, by default now; return whether it is valid."""
        stamp_s = self.time_s if stamp_s is None else stamp_s
        return self._drive.command(linear_mps, angular_radps, stamp_s)

    def brake(self, engaged: bool) -> None:
        """Engage or release the brake."""
        self._drive.brake_ordered = engaged

    def order_fault(self, order: m.ActuatorFault) -> None:
        """Start a fault of the actuators, or end it (duration 0).

        Raises:
            WorldError: invalid wheel, strength or duration, or nothing to end.
        """
        self._faults.order(order, self.time_s)
        self._faulty = True

    def fault_news(self) -> list[FaultNews]:
        """Return the news of actuator faults since the last call, oldest first."""
        return self._faults.take_news()

    # -- time -----------------------------------------------------------------------------------

    def step_to(self, t_s: float) -> None:
        """Advance to time `t_s` in ticks of 10 ms.

        Raises:
            WorldError: the time is not finite.
        """
        if not math.isfinite(t_s):
            raise WorldError(f"step_to: {t_s}: time must be finite")
        behind_s = t_s - self.time_s
        if behind_s > self._max_catch_up_s:
            skip_s = math.floor((behind_s - self._max_catch_up_s) / TICK_S) * TICK_S
            self.skipped_s += skip_s
            self._set_time()
        while self.time_s + TICK_S <= t_s + 1e-9:
            self._tick()

    def _set_time(self) -> None:
        # From the tick count, so that rounding errors do not add up.
        self.time_s = self._start_s + self.skipped_s + self._ticks * TICK_S

    def _tick(self) -> None:
        if self._faulty:
            self._actuate_with_faults()
        else:
            targets = self._drive.update(self.time_s, TICK_S)
            if targets != self._targets:  # writing them is slow
                self._servos[:] = self._targets = targets
            if self._drive.locked != self._locked:
                self._locked = self._drive.locked
                self._damping[:] = LOCKED_DAMPING if self._locked else self._free_damping
        mujoco.mj_step(self._model, self._data, self._steps_per_tick)
        self._ticks += 1
        self._set_time()
        if self._data.ncon != 4 or self._obstacle_clearance_m < NEAR_M:
            self._count_contacts()
        if self.time_s >= self._examine_at_s - 1e-9:
            self._bring_obstacles()
            self._examine()

    def _actuate_with_faults(self) -> None:
        """Apply the actuator faults; the tick after the last one restores the model."""
        self._faults.expire(self.time_s)
        self._faulty = bool(self._faults)
        drive = self._drive
        drive.brake_share = self._faults.brake_share
        targets = drive.update(self.time_s, TICK_S)
        speeds = _four(self._wheel_v)
        actuation = self._faults.actuate(targets, speeds, drive.braking)
        self._servos[:] = actuation.targets_radps
        self._targets = None
        self._torque_ranges[:] = actuation.torques_nm
        self._locked = drive.locked
        blocked = np.array(actuation.blocked) | self._locked
        self._damping[:] = np.where(blocked, LOCKED_DAMPING, self._free_damping)
        if drive.braking and drive.brake_share < 1:
            drive.give_way(*robot.twist_from_wheels(speeds))

    # -- sensors --------------------------------------------------------------------------------

    @property
    def pose(self) -> Pose:
        """True pose of `base_link` in `map`: x m, y m, yaw rad; also the absolute pose."""
        x, y, _, qw, qx, qy, qz = self._base_q.tolist()
        return x, y, math.atan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz))

    def scan(self, laser: int = 0) -> sensors.Floats:
        """Return a sweep of the lower (0) or upper (1) laser, m."""
        # Without an obstacle in range no rays are needed. The clearance is from the footprint and
        # may be one period old, in which the robot moves less than the footprint's radius.
        if self._obstacle_clearance_m > self.laser.range_max_m:
            return np.full(self.laser.rays, self.laser.range_max_m)
        # Both sweep at the same time, the lower one first, with the same rays.
        if laser == 0 or self._echoes[0] != self._ticks:
            self._echoes = self._ticks, self._lasers[0].cast(self._model, self._data, self.pose)
        return self._lasers[laser].sweep(self._echoes[1])

    def laser_reference(self, laser: int = 0) -> float:
        """Return a laser's measurement of the target in its housing, m; one per sweep."""
        return self._lasers[laser].reference()

    def gps(self) -> m.GpsFix:
        """Return a GPS fix."""
        x_m, y_m, _ = self.pose
        vx, vy, *_ = self._base_v.tolist()
        return self._gps.read(x_m, y_m, vx, vy)

    def imu(self) -> m.Imu:
        """Return an IMU reading."""
        vx, vy, *_ = self._base_v.tolist()
        return self._imu.read(self.time_s, self.pose[2], vx, vy)

    def odometry(self) -> m.Odometry:
        """Return the odometry."""
        return self._odometry.read(_four(self._wheel_q), self.time_s)

    def light(self) -> float:
        """Return a reading of the light sensor, lux."""
        return self._light.read(self.pose)

    def base_status(self) -> m.BaseStatus:
        """Return the state of the base."""
        return m.BaseStatus(
            self._drive.braking, self._drive.dead_man_tripped(self.time_s),
            max(0.0, min(NEVER_S, self._drive.command_age_s(self.time_s))), _four(self._wheel_v))

    # -- obstacles ------------------------------------------------------------------------------

    @property
    def obstacles(self) -> tuple[Solid, ...]:
        """Present obstacles."""
        return tuple(self._scene.present.values())

    def add_obstacle(self, name: str, x_m: float, y_m: float, radius_m: float) -> None:
        """Add or move an obstacle; a preset keeps its shape.

        Raises:
            WorldError: not finite, out of bounds, on the robot, or too many.
        """
        self._scene.put(name, x_m, y_m, radius_m, footprint(self.pose))
        self._changed(name)

    def remove_obstacle(self, name: str) -> bool:
        """Remove an obstacle or a waiting preset; return whether it was present."""
        self._changed(name)
        return self._scene.remove(name)

    def _changed(self, name: str) -> None:
        """Reset the time window of an obstacle, and the known clearance."""
        self._waiting = [waiting for waiting in self._waiting if waiting.name != name]
        self._leaving.pop(name, None)
        self._near_obstacle.forget()
        self._examine_at_s = self.time_s

    def _bring_obstacles(self) -> None:
        """Add and remove presets by their time windows."""
        elapsed_s = self.time_s - self._began_s
        for name in [name for name, until in self._leaving.items() if elapsed_s >= until]:
            self.remove_obstacle(name)
        x_m, y_m, _ = self.pose
        for preset in list(self._waiting):
            near_m = preset.appears_within_m
            is_far = near_m is not None and math.dist((x_m, y_m), (preset.x_m, preset.y_m)) > near_m
            if elapsed_s < preset.present_from_s or is_far:
                continue
            try:
                self.add_obstacle(preset.name, preset.x_m, preset.y_m, preset.radius_m)
            except WorldError:
                continue  # the robot is there: it appears when the place is free
            if preset.gone_after_s is not None:
                self._leaving[preset.name] = elapsed_s + preset.gone_after_s

    def _restore(self, kept: WorldKept) -> None:
        self._began_s = kept.began_s
        self._collisions, self._prohibited_s = kept.collisions, kept.prohibited_s
        for obstacle in kept.obstacles:
            with contextlib.suppress(WorldError):  # on the robot, which has moved
                self.add_obstacle(*obstacle)
        self._waiting = [preset for preset in self._waiting if preset.name in kept.waiting]
        self._leaving.update(kept.leaving)

    def keep(self) -> WorldKept:
        """Return the state for a resumed run."""
        return WorldKept(
            self.pose, tuple((o.name, o.x_m, o.y_m, o.radius_m) for o in self.obstacles),
            tuple(preset.name for preset in self._waiting), dict(self._leaving), self._began_s,
            self._collisions, self._prohibited_s)

    # -- ground truth ---------------------------------------------------------------------------

    def truth(self, real_time_factor: float = 1.0) -> m.GroundTruth:
        """Return the ground truth; clearances are at most 50 ms old.

        `obstacle_clearance_m` is from the footprint to the nearest obstacle or building
        (`rampart.sim.osmosis.scene.NOTHING_M` without one), `prohibited_clearance_m` from the
        footprint's nearest corner to the prohibited area, negative inside. Both are exact below
        `EXACT_BELOW_M` and lower bounds above.
        """
        x_m, y_m, yaw_rad = self.pose
        vx, vy, *_ = self._base_v.tolist()
        return m.GroundTruth(
            m.Pose(x_m, y_m, sensors.wrap(yaw_rad)),
            m.Twist(vx * math.cos(yaw_rad) + vy * math.sin(yaw_rad), float(self._base_v[5])),
            self._collisions, self._prohibited_s, self._obstacle_clearance_m,
            self._prohibited_clearance_m, real_time_factor)

    def _count_contacts(self) -> None:
        for name in self._scene.touched():
            if self.time_s - self._contact_s.get(name, -math.inf) > SAME_CONTACT_S:
                self._collisions += 1
            self._contact_s[name] = self.time_s

    def _examine(self) -> None:
        pose = self.pose
        self._obstacle_clearance_m = self._near_obstacle.measure(pose)
        self._prohibited_clearance_m = self._near_prohibited.measure(pose)
        if self._prohibited_clearance_m <= robot.CIRCUMRADIUS_M and \
                self.airport.footprint_in_prohibited(footprint(pose)):
            self._prohibited_s += self.time_s - self._examined_s
        near = min(self._obstacle_clearance_m, self._prohibited_clearance_m) < NEAR_M
        self._examined_s = self.time_s
        self._examine_at_s = self.time_s + (CLOSE_TRUTH_PERIOD_S if near else TRUTH_PERIOD_S)

    def _prohibited_exactly(self, pose: Pose) -> float:
        """Return the distance of the footprint's nearest corner to the prohibited area, m."""
        corners = shapely.get_coordinates(footprint(pose))[:4]
        return float(self.airport.prohibited_distances_m(corners).min())


def _four(wheels: sensors.Floats) -> robot.WheelSpeeds:
    """Convert a view of the wheels to plain numbers."""
    fl, fr, rl, rr = wheels.tolist()
    return fl, fr, rl, rr


class Clearance:
    """Distance from the footprint to objects that stand still until `forget` is called.

    An exact distance is nearly as slow as the physics of the same 50 ms. No part of the robot comes
    nearer by more than it has moved, so the last exact distance minus the motion is a lower bound,
    which is used while it exceeds `EXACT_BELOW_M`.

    Args:
        exact: distance for a pose, m.
    """

    def __init__(self, exact: Callable[[Pose], float]) -> None:
        self._exact = exact
        self._pose: Pose = (0.0, 0.0, 0.0)
        self._distance_m = -math.inf

    def forget(self) -> None:
        """Make the next distance exact."""
        self._distance_m = -math.inf

    def measure(self, pose: Pose) -> float:
        """Return the distance for a pose, exact below `EXACT_BELOW_M`, else a lower bound, m."""
        x_m, y_m, yaw_rad = self._pose
        turned_rad = abs(math.remainder(pose[2] - yaw_rad, math.tau))
        moved_m = math.dist(pose[:2], (x_m, y_m)) + turned_rad * CIRCUMRADIUS_M
        bound_m = self._distance_m - moved_m
        if bound_m > EXACT_BELOW_M:
            return bound_m
        self._pose, self._distance_m = pose, self._exact(pose)
        return self._distance_m


def footprint(pose: Pose) -> Any:
    """Return the robot's footprint as a shapely polygon in `map`."""
    return rectangle(*pose, LENGTH_M, WIDTH_M)
