"""A drive of the simulated robot, its sensors' readings, and what becomes of them under faults.

The world is driven open-loop, once for all tests: nothing that localization does changes the way.
Faults act through the project's own gate, as they do in the nodes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from shapely.geometry import box

from rampart.actors.bus import messages as bm
from rampart.actors.bus.topic import Topic
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.model import Airport, StartPose
from rampart.actors.runtime.injection import FaultGate, Outgoing
from rampart.sim.faults.disturbance import Fault
from rampart.sim.osmosis.simulator import Schedule
from rampart.sim.osmosis.trial.faults import SENSOR_FAULTS, OsmosisFaults
from rampart.sim.osmosis.world import World

START_RAD = 0.7
SOURCES = {"gps": topics.GPS, "imu": topics.IMU, "odom": topics.ODOMETRY,
           "absolute-pose": topics.ABSOLUTE_POSE, "encoders": topics.BASE_STATUS}

STAMPED = (topics.GPS, topics.IMU, topics.ODOMETRY, topics.ABSOLUTE_POSE)


def sensor_faults(*sensors: str) -> list[str]:
    """Names of the faults of these sensors, and of their topics, by the names in `SOURCES`."""
    named = [name for name in SENSOR_FAULTS if name.startswith(sensors)]
    keys = [SOURCES[sensor].key for sensor in sensors]
    ways = ("drop", "freeze", "delay", "corrupt")
    return named + [f"{way}:{key}" for way in ways for key in keys]


# Seconds, m/s, rad/s: standing, straight, a bend, on the spot, backwards, a fast bend, standing.
LEGS = ((1.5, 0.0, 0.0), (4.0, 1.0, 0.0), (3.0, 0.8, 0.4), (3.0, 1.0, 0.0), (2.5, 0.0, 1.2),
        (3.0, 1.0, 0.0), (2.0, -0.5, 0.0), (3.0, 0.6, -0.9), (5.0, 1.0, 0.0), (2.0, 0.0, 0.0))
END_S = sum(leg[0] for leg in LEGS)


@dataclass(frozen=True)
class Reading:
    topic: Topic[Any]
    stamp_s: float
    body: Any


@dataclass(frozen=True)
class Truth:
    stamp_s: float
    x_m: float
    y_m: float
    yaw_rad: float
    linear_mps: float
    angular_radps: float

    def at(self, stamp_s: float) -> tuple[float, float, float]:
        dt_s = stamp_s - self.stamp_s
        middle = self.yaw_rad + self.angular_radps * dt_s / 2
        way_m = self.linear_mps * dt_s
        return (self.x_m + way_m * math.cos(middle), self.y_m + way_m * math.sin(middle),
                self.yaw_rad + self.angular_radps * dt_s)


def field_airport() -> Airport:
    return Airport("field", {"a": (0.0, 0.0), "b": (40.0, 0.0)}, (("a", "b"),),
                   box(-60.0, -60.0, 60.0, 60.0), StartPose(0.0, 0.0, START_RAD))


@cache
def drive(seed: int = 1) -> tuple[Reading | Truth, ...]:
    """Return readings and truth (at 20 Hz) in order of time."""
    world = World(field_airport(), seed=seed)
    rates = {**{t.key: t.rate_hz for t in SOURCES.values()}, topics.TRUTH.key: 20.0,
             "command": 20.0}
    schedule = Schedule(rates, 0.0, keep_s=1e9)
    by_key = {t.key: t for t in SOURCES.values()}
    out: list[Reading | Truth] = []
    for due_s, key in schedule.due(sum(leg[0] for leg in LEGS)):
        world.step_to(due_s)
        if key == "command":
            world.command(*_command(due_s))
        elif key == topics.TRUTH.key:
            t = world.truth()
            out.append(Truth(due_s, t.pose.x_m, t.pose.y_m, t.pose.yaw_rad, t.twist.linear_mps,
                             t.twist.angular_radps))
        else:
            out.append(Reading(by_key[key], due_s, _read(world, key)))
    return tuple(out)


def _command(now_s: float) -> tuple[float, float]:
    for lasts_s, linear_mps, angular_radps in LEGS:
        if now_s < lasts_s:
            return linear_mps, angular_radps
        now_s -= lasts_s
    return 0.0, 0.0


def _read(world: World, key: str) -> bm.Message:
    if key == topics.GPS.key:
        return world.gps()
    if key == topics.IMU.key:
        return world.imu()
    if key == topics.ODOMETRY.key:
        return world.odometry()
    if key == topics.BASE_STATUS.key:
        return world.base_status()
    return m.Pose(*world.pose)


def fault(name: str, *, on_s: float = 0.0, off_s: float = 0.0) -> Fault:
    return OsmosisFaults().find(name, 0, topics.ALL).varied(on_s=on_s, off_s=off_s)


def disturbed(faults: Iterable[tuple[Fault, float, float]], seed: int = 1,
              ) -> Iterator[tuple[float, Reading | Truth]]:
    """Yield the drive as it arrives, with faults given as (fault, from s, to s): (now, what)."""
    gate, late, orders = FaultGate(), [], []
    for number, (what, from_s, to_s) in enumerate(faults):
        orders += [(from_s, to_s, order) for order in what.orders(f"f{number}", None)]
    for item in drive(seed):
        now_s = item.stamp_s
        while late and late[0][0] <= now_s:
            yield late.pop(0)
        for from_s, to_s, order in orders:
            if from_s <= now_s < to_s and order.injection not in gate.in_force:
                assert gate.order(order, now_s) == ""
            elif now_s >= to_s:
                gate.expire(order.injection)
        if isinstance(item, Truth):
            yield now_s, item
            continue
        key = item.topic.at()
        out = gate.apply(key, item.body, now_s, now_s) if gate.in_force else Outgoing(
            item.body, now_s)
        if out is None:
            continue
        gate.last[key] = (out.body, out.stamp)
        reading = Reading(item.topic, out.stamp, out.body)
        if out.delay_s:
            late.append((now_s + out.delay_s, reading))
        else:
            yield now_s, reading


WRONG_STAMPS: dict[str, Callable[[float], float]] = {
    "far ahead": lambda now_s: now_s + 1e9, "ahead": lambda now_s: now_s + 0.25,
    "infinite": lambda _: math.inf, "no number": lambda _: math.nan}
"""Stamp of a reading at a time."""

Items = Iterable[tuple[float, Reading | Truth]]


def mis_stamped(items: Items, topic: Topic[Any], wrong: str, from_s: float, *, once: bool
                ) -> Iterator[tuple[float, Reading | Truth]]:
    """Yield what arrives; one reading of a topic, or all from then on, with a wrong stamp."""
    done = False
    for now_s, item in items:
        if isinstance(item, Reading) and item.topic is topic and now_s >= from_s and not done:
            done = once
            yield now_s, replace(item, stamp_s=WRONG_STAMPS[wrong](now_s))
        else:
            yield now_s, item


def with_absurd(items: Items, topic: Topic[Any], from_s: float
                ) -> Iterator[tuple[float, Reading | Truth]]:
    """Yield what arrives, and before one reading two whose numbers are too large for a square."""
    done = False
    for now_s, item in items:
        if now_s >= from_s and isinstance(item, Reading) and item.topic is topic and not done:
            done = True
            for number, behind_s in ((1e300, 0.002), (-1e300, 0.001)):
                yield now_s, Reading(topic, now_s - behind_s, {
                    topics.GPS: m.GpsFix(number, number, number, number, abs(number)),
                    topics.IMU: m.Imu(number, number, number, number),
                    topics.ODOMETRY: m.Odometry(
                        m.Pose(number, number, number), m.Twist(number, number)),
                    topics.ABSOLUTE_POSE: m.Pose(number, number, number)}[topic])
        yield now_s, item
