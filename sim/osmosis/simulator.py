"""The simulator actor: it has the Summit XL layer's topics, like the driver of a real robot.

Only it has the ground truth, which it publishes on `world/` for the judge and the tests. A timer of
20 ms steps the physics to the clock's time and publishes all readings that are due, each with its
own stamp.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from heapq import heapreplace
from typing import Any, ClassVar

import numpy as np

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.bounds import clip
from rampart.actors.bus.topic import Topic
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.ftm.holders import Holders
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.runtime.actor import Actor, Context, Header, every, on
from rampart.actors.runtime.run_context import NO_SYSTEM
from rampart.actors.runtime.timer import Timer
from rampart.manager.spec.tables import Positive
from rampart.sim.osmosis.actuator_faults import FaultNews
from rampart.sim.osmosis.scene import WorldError
from rampart.sim.osmosis.world import WORLD_STATE, World
from rampart.sim.runs.physics import report_instability

WAKE_UP_S = 0.02
MAX_CATCH_UP_S = 1.0

_KEEP_S = 0.1
"""Simulated seconds between two checkpoints of the world, for a resumed run."""

_JOBS = (topics.IMU, topics.ODOMETRY, topics.ABSOLUTE_POSE, topics.SCAN, topics.UPPER_SCAN,
         topics.LIGHT, topics.GPS, topics.BASE_STATUS, topics.TRUTH, topics.OBSTACLES)


class Simulator(Actor):
    """Runs the `World` on the actor's clock."""

    class Parameters(Actor.Parameters, frozen=True):
        """Robot and world; the run sets the first four.

        Attributes:
            seed: seed of all noise.
            obstacles: number of obstacle presets.
            dead_man: whether the base brakes without commands.
            dead_man_timeout_s: time without a command until it brakes, s.
            upper_laser: whether the robot has a second laser.
        """

        seed: int = 0
        obstacles: int = 0
        dead_man: bool = True
        dead_man_timeout_s: Positive = 0.4
        upper_laser: bool = False

    parameters: Parameters
    outputs: ClassVar[tuple[Topic[Any], ...]] = (*_JOBS, ftm_topics.HOLDS)
    node_kind = "world"

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._airport = Osmosis.of(context).airport
        self._asked_s = self._skipped_s = 0.0
        self._keep_at_s = -math.inf
        self._real_time_factor = 1.0
        self._brakes: Holders[bool] = Holders(
            None if context.run.system is NO_SYSTEM
            else [recovery.name for recovery in context.run.system.recoveries], True)
        self._holds_timer: Timer | None = None

    def on_start(self) -> None:
        """Build the world."""
        now_s, parameters = self.clock.now(), self.parameters
        kept = self.kept(WORLD_STATE) if self.context.run.plan.part else None
        self._world = world = World(
            self._airport, Osmosis.of(self.context).world, parameters.seed, parameters.obstacles,
            dead_man_timeout_s=parameters.dead_man_timeout_s if parameters.dead_man else None,
            start_s=now_s, max_catch_up_s=MAX_CATCH_UP_S, kept=kept)
        self._asked_s = now_s
        readings: dict[Topic[Any], Callable[[], Any]] = {
            topics.IMU: world.imu, topics.ODOMETRY: world.odometry,
            topics.ABSOLUTE_POSE: lambda: m.Pose(*world.pose), topics.SCAN: lambda: self._scan(0),
            topics.LIGHT: lambda: m.LightSample(world.light()), topics.GPS: world.gps,
            topics.BASE_STATUS: world.base_status,
            topics.TRUTH: lambda: world.truth(self._real_time_factor),
            topics.OBSTACLES: self._obstacles}
        if parameters.upper_laser:
            readings[topics.UPPER_SCAN] = lambda: self._scan(1)
        self._readings = {topic.key: (topic, read) for topic, read in readings.items()}
        self._schedule = Schedule(
            {topic.key: topic.rate_hz for topic in _JOBS if topic in readings},
            now_s, keep_s=MAX_CATCH_UP_S)

    # -- inputs ---------------------------------------------------------------------------------

    @on(topics.BASE_COMMAND)
    def command(self, message: m.BaseCommand, header: Header) -> None:
        """Pass a velocity command to the base, with its stamp."""
        self._advance()
        stamp_s = min(header.stamp, self.clock.now())
        if not self._world.command(message.linear_mps, message.angular_radps, stamp_s):
            self.report_diagnostic("velocity command", "refused: not finite", header.source)

    @on(topics.BRAKE)
    def brake(self, message: m.BrakeCommand, header: Header) -> None:
        """Hold or release the brake for the source; a source releases only its own hold."""
        self._advance()
        unknown = self._brakes.unknown
        if message.engaged:
            self._brakes.hold(header.source, True)
            if self._brakes.is_unknown(header.source):
                self.report_diagnostic("brake", f"held by {header.source!r}, which is not a "
                                       "recovery module of this system; rampart reset releases it",
                                       header.source)
        else:
            self._brakes.let_go(header.source)
        self._braked(unknown)

    @on(ftm_topics.RESET)
    def reset(self, message: fm.Reset, _header: Header) -> None:
        """Release the brake for a holder that is not a recovery module."""
        self._advance()
        unknown = self._brakes.unknown
        if self._brakes.reset(message.recovery):
            self._braked(unknown)

    def _braked(self, unknown_before: tuple[str, ...]) -> None:
        self._world.brake(bool(self._brakes))
        if self._brakes.unknown != unknown_before:
            self._tell_holds()

    def _tell_holds(self) -> None:
        """Publish the unknown holders of the brake, and repeat it while there are some."""
        unknown = self._brakes.unknown
        self.publish(ftm_topics.HOLDS, fm.Holds("brake", unknown))
        if self._holds_timer is not None:
            self._holds_timer.cancel()
        self._holds_timer = self.call_later(
            1.0 / ftm_topics.HOLDS.rate_hz, self._tell_holds) if unknown else None

    @on(topics.OBSTACLE)
    def obstacle(self, message: m.ObstacleCommand, header: Header) -> None:
        """Add or remove an obstacle."""
        self._advance()
        try:
            if message.present:
                self._world.add_obstacle(message.name, message.x_m, message.y_m, message.radius_m)
            else:
                self._world.remove_obstacle(message.name)
        except WorldError as error:
            self.report_diagnostic("obstacle", str(error), header.source)
            return
        self.publish(topics.OBSTACLES, self._obstacles())

    @on(topics.ACTUATOR_FAULT)
    def actuator_fault(self, message: m.ActuatorFault, header: Header) -> None:
        """Start or end a fault of the actuators.

        It reports the start, the first effect and the end; a refused fault is reported as finished
        with the reason.
        """
        self._advance()
        try:
            self._world.order_fault(message)
        except WorldError as error:
            self.report_diagnostic("actuator fault", str(error), header.source)
            self._report_fault(FaultNews(message.injection, 0, finished=True), str(error))
        self._report_faults()

    # -- time -----------------------------------------------------------------------------------

    @every(WAKE_UP_S)
    def tick(self) -> None:
        """Step the physics to now and publish the readings that are due."""
        self._advance()
        if self.clock.now() >= self._keep_at_s and not self.context.run.plan.virtual:
            self._keep_at_s = self.clock.now() + _KEEP_S
            self.keep(WORLD_STATE, self._world.keep())

    def _advance(self) -> None:
        now_s = self.clock.now()
        for due_s, job in self._schedule.due(now_s):
            topic, read = self._readings[job]
            if self.has_readers(topic):
                self._world.step_to(due_s)
                if report_instability(self, self._world.data):
                    return
                self.publish(topic, read(), stamp=due_s)
        self._world.step_to(now_s)
        self._report_faults()
        self._measure_speed(now_s)

    def _report_faults(self) -> None:
        for news in self._world.fault_news():
            self._report_fault(news)

    def _report_fault(self, news: FaultNews, reason: str = "") -> None:
        self.publish(bus_topics.INJECTION_REPORT, bm.InjectionReport(
            news.injection, self.name, news.affected_ticks, news.finished, clip(reason)))

    def _measure_speed(self, now_s: float) -> None:
        """Measure the simulated share of the clock's time over each second."""
        asked_s = now_s - self._asked_s
        if asked_s >= 1.0:
            skipped_s = self._world.skipped_s - self._skipped_s
            self._real_time_factor = self.clock.rate * max(0.0, 1.0 - skipped_s / asked_s)
            self._asked_s, self._skipped_s = now_s, self._world.skipped_s

    # -- readings -------------------------------------------------------------------------------

    def _scan(self, which: int) -> m.LaserScan:
        ranges = self._world.scan(which).astype(np.dtype("<f4")).tobytes()
        laser = self._world.laser
        return m.LaserScan(laser.angle_min_rad, laser.angle_increment_rad, laser.range_max_m,
                           ranges, self._world.laser_reference(which))

    def _obstacles(self) -> m.ObstacleList:
        return m.ObstacleList(tuple(
            m.ObstacleCommand(solid.name, True, solid.x_m, solid.y_m, solid.radius_m)
            for solid in self._world.obstacles))


class Schedule:
    """Due times of periodic jobs on one grid, independent of the wake-ups.

    A wake-up may cover several due times of a job; each reading has the stamp of its due time.

    Args:
        rates_hz: rate of each job.
        start_s: first due time of all jobs.
        keep_s: older due times are dropped, so that a delayed simulator does not publish a flood
            of late readings.
    """

    def __init__(self, rates_hz: Mapping[str, float], start_s: float, keep_s: float) -> None:
        self._start_s = start_s
        self._keep_s = keep_s
        # Due time, place in the sequence, name, count of periods, period.
        self._queue = [(start_s, place, name, 0, 1.0 / rate_hz)
                       for place, (name, rate_hz) in enumerate(rates_hz.items())]

    def due(self, now_s: float) -> Iterator[tuple[float, str]]:
        """Yield (due time, job) in order of time up to `now_s`."""
        queue, start_s = self._queue, self._start_s
        oldest_s = now_s - self._keep_s
        while queue[0][0] < oldest_s:
            due_s, place, name, count, period_s = queue[0]
            count += int((oldest_s - due_s) / period_s) + 1
            heapreplace(queue, (start_s + count * period_s, place, name, count, period_s))
        while queue[0][0] <= now_s + 1e-9:
            due_s, place, name, count, period_s = queue[0]
            count += 1
            heapreplace(queue, (start_s + count * period_s, place, name, count, period_s))
            yield due_s, name
