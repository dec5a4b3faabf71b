"""A drive of the simulated robot under faults, and who reads its sensors.

The world is driven open-loop, once for all tests: nothing that localization does changes the way.
Faults act through the project's own gate, as they do in the nodes. `watch` shows a drive to any
number of onlookers at once: localization, the voted DM1 and DM8.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import msgspec
from shapely.geometry import box

from rampart.actors.bus.topic import Topic
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.model import Airport, StartPose
from rampart.actors.osmosis.control.localization.pose_filter import PoseFilter
from rampart.actors.osmosis.detection.area.estimation_error import EstimationMonitor
from rampart.actors.osmosis.detection.area.voted_area import VotedPosition
from rampart.actors.runtime.injection import FaultGate, Outgoing
from rampart.sim.faults.topic_faults import Fault
from rampart.sim.osmosis.simulator import Schedule
from rampart.sim.osmosis.trial.faults import SENSOR_FAULTS, OsmosisFaults
from rampart.sim.osmosis.world import World

START_RAD = 0.7
SOURCES = {"gps": topics.GPS, "imu": topics.IMU, "odom": topics.ODOMETRY,
           "absolute-pose": topics.ABSOLUTE_POSE, "encoders": topics.BASE_STATUS}

STAMPED = (topics.GPS, topics.IMU, topics.ODOMETRY, topics.ABSOLUTE_POSE)


def sensor_faults() -> list[str]:
    """Names of the faults of the `SOURCES`, and of their topics."""
    named = [name for name in SENSOR_FAULTS if name.startswith(tuple(SOURCES))]
    ways = ("drop", "freeze", "delay", "corrupt")
    return named + [f"{way}:{topic.key}" for way in ways for topic in SOURCES.values()]


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
    readings = {topic.key: (topic, read) for topic, read in (
        (topics.GPS, world.gps), (topics.IMU, world.imu), (topics.ODOMETRY, world.odometry),
        (topics.BASE_STATUS, world.base_status),
        (topics.ABSOLUTE_POSE, lambda: m.Pose(*world.pose)))}
    out: list[Reading | Truth] = []
    for due_s, key in schedule.due(END_S):
        world.step_to(due_s)
        if key == "command":
            world.command(*_command(due_s))
        elif key == topics.TRUTH.key:
            t = world.truth()
            out.append(Truth(due_s, t.pose.x_m, t.pose.y_m, t.pose.yaw_rad, t.twist.linear_mps,
                             t.twist.angular_radps))
        else:
            topic, read = readings[key]
            out.append(Reading(topic, due_s, read()))
    return tuple(out)


def _command(now_s: float) -> tuple[float, float]:
    for lasts_s, linear_mps, angular_radps in LEGS:
        if now_s < lasts_s:
            return linear_mps, angular_radps
        now_s -= lasts_s
    return 0.0, 0.0


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
    return _altered(items, topic, from_s, lambda reading: [
        replace(reading, stamp_s=WRONG_STAMPS[wrong](reading.stamp_s))], once=once)


def with_absurd(items: Items, topic: Topic[Any], from_s: float
                ) -> Iterator[tuple[float, Reading | Truth]]:
    """Yield what arrives, and before one reading two whose numbers are too large for a square."""
    return _altered(items, topic, from_s, lambda reading: [
        Reading(topic, reading.stamp_s - 0.002, _filled(reading.body, 1e300)),
        Reading(topic, reading.stamp_s - 0.001, _filled(reading.body, -1e300)), reading],
        once=True)


def _filled(body: Any, number: float) -> Any:
    """Return a message with one number in all its fields."""
    return type(body)(*(_filled(value, number) if isinstance(value, msgspec.Struct) else number
                        for value in msgspec.structs.astuple(body)))


def _altered(items: Items, topic: Topic[Any], from_s: float,
             alter: Callable[[Reading], list[Reading]], *, once: bool
             ) -> Iterator[tuple[float, Reading | Truth]]:
    done = False
    for now_s, item in items:
        if isinstance(item, Reading) and item.topic is topic and now_s >= from_s and not done:
            done = once
            yield from ((now_s, reading) for reading in alter(item))
        else:
            yield now_s, item


# ---- who reads it --------------------------------------------------------------------------------


def watch(items: Items, *onlookers: Located | Voted | Accused, to_s: float = math.inf) -> None:
    for now_s, item in items:
        if now_s > to_s:
            break
        for onlooker in onlookers:
            onlooker.take(now_s, item)


@dataclass
class Located:
    """The filter of localization, compared with the truth at 20 Hz."""

    filter: PoseFilter = field(default_factory=PoseFilter)
    start_s: float = 0.0
    settle_s: float = 0.4
    judge_to_s: float = math.inf
    worst_m: float = 0.0
    worst_rad: float = 0.0
    lost_s: float = 0.0
    bridged_m: float = 0.0
    told: int = 0
    excluded: set[str] = field(default_factory=set)

    def take(self, now_s: float, item: Reading | Truth) -> None:
        if now_s < self.start_s:
            return
        if isinstance(item, Reading):
            take = {topics.IMU: self.filter.imu, topics.ODOMETRY: self.filter.odometry,
                    topics.GPS: self.filter.gps, topics.ABSOLUTE_POSE: self.filter.absolute_pose,
                    topics.BASE_STATUS: self.filter.encoders}
            take[item.topic](item.stamp_s, item.body, now_s)
        elif self.start_s + self.settle_s <= now_s <= self.judge_to_s:
            self._compare(item, now_s)

    def _compare(self, truth: Truth, now_s: float) -> None:
        status, estimate = self.filter.status(now_s), self.filter.estimate()
        self.excluded |= {name for name, _ in status.excluded}
        self.bridged_m = max(self.bridged_m, status.bridged_m)
        if estimate is None or now_s - estimate.stamp_s > 0.25:
            self.lost_s += 0.05
            return
        self.told += 1
        x_m, y_m, yaw_rad = truth.at(estimate.stamp_s)
        found = estimate.pose
        self.worst_m = max(self.worst_m, math.hypot(found.x_m - x_m, found.y_m - y_m))
        self.worst_rad = max(self.worst_rad, abs(math.remainder(found.yaw_rad - yaw_rad, math.tau)))


@dataclass
class Voted:
    """The voted DM1: its worst error beyond its bound, and how long it knew nothing."""

    where: VotedPosition = field(default_factory=lambda: VotedPosition(0.05, 10.0, 5.0))
    worst_m: float = 0.0
    unknown_s: float = 0.0
    seen_s: float = 0.0
    looked_s: float = 0.0
    truth: Truth | None = None

    def take(self, now_s: float, item: Reading | Truth) -> None:
        if isinstance(item, Truth):
            self.truth = item
            self.unknown_s = max(self.unknown_s, now_s - self.seen_s)
            return
        where, body, stamp_s = self.where, item.body, item.stamp_s
        take = {topics.IMU: where.vote.track.imu, topics.ODOMETRY: where.odometry,
                topics.GPS: where.gps, topics.BASE_STATUS: where.vote.see_encoders}
        if item.topic in take:
            take[item.topic](body, stamp_s, now_s)
        else:
            where.vote.see_position(stamp_s, (body.x_m, body.y_m), now_s, body.yaw_rad)
        if item.topic is topics.GPS or now_s - self.looked_s >= 0.1:
            self._look(now_s)

    def _look(self, now_s: float) -> None:
        self.looked_s, found = now_s, self.where.look(now_s)
        if found is None or self.truth is None:
            return
        (fix, stamp_s), self.seen_s = found, now_s
        x_m, y_m, _ = self.truth.at(stamp_s)
        off_m = math.dist((fix.x_m, fix.y_m), (x_m, y_m))
        self.worst_m = max(self.worst_m, off_m - fix.accuracy_m)


def honest(truth: Truth, _now_s: float) -> m.Pose | None:
    return m.Pose(truth.x_m, truth.y_m, truth.yaw_rad)


@dataclass
class Accused:
    """DM8 and a localization that says `lie` of the truth: when it was accused, (since s, to s)."""

    lie: Callable[[Truth, float], m.Pose | None] = honest
    monitor: EstimationMonitor = field(default_factory=lambda: EstimationMonitor(-math.inf))
    spans: list[tuple[float, float]] = field(default_factory=list)

    def take(self, now_s: float, item: Reading | Truth) -> None:
        monitor = self.monitor
        if isinstance(item, Truth):
            said = self.lie(item, now_s)
            if said is not None:
                monitor.pose(said, now_s, now_s, "localization#1")
        elif item.topic is not topics.ABSOLUTE_POSE:
            take = {topics.IMU: monitor.vote.track.imu, topics.GPS: monitor.gps,
                    topics.ODOMETRY: monitor.vote.track.odometry,
                    topics.BASE_STATUS: monitor.vote.see_encoders}
            take[item.topic](item.body, item.stamp_s, now_s)
        under_way = bool(self.spans) and self.spans[-1][1] == math.inf
        if monitor.active and not under_way:
            self.spans.append((now_s, math.inf))
        elif under_way and not monitor.active:
            self.spans[-1] = (self.spans[-1][0], now_s)
