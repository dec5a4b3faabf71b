"""The guard between the navigation and the base."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rampart import Actor, Context, Header, TopicHeard, every, on
from rampart.manager.spec.tables import Positive
from warehouse import topics
from warehouse.topics import GuardState, Limit, Order, Velocity

EXECUTING = 2
"""Of action_msgs/msg/GoalStatus."""

TURNED_S = 0.4
"""Time in which a command is replaced or the robot brakes: it then drives in another direction."""


class Guard(Actor):
    """Passes velocities that are recent, within bounds, and free of obstacles."""

    class Parameters(Actor.Parameters, frozen=True, kw_only=True):
        """Topics of the gateway, and bounds.

        Attributes:
            command: topic of the navigation's velocity.
            scan: topic of the laser, translated from a LaserScan.
            goals: topic of the navigation's goals, translated from a GoalStatusArray.
            top_mps, top_radps: largest velocities.
            slow_mps: largest speed while a recovery limits it.
            ahead_m: smallest distance of an obstacle in the direction of the drive: the robot's
                radius of 0.3 m, the way in 0.3 s, the age of a sweep, and the braking distance from
                0.8 m/s.
            beside_m: smallest distance of an obstacle to the side.
            stale_s: an older command or sweep stops the robot.
        """

        command: TopicHeard
        scan: TopicHeard
        goals: TopicHeard
        top_mps: Positive = 0.8
        top_radps: Positive = 1.5
        slow_mps: Positive = 0.5
        ahead_m: Positive = 0.9
        beside_m: Positive = 0.4
        stale_s: Positive = 0.3

    parameters: Parameters
    outputs = (topics.CHECKED, topics.STATE)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        given = self.parameters
        self._angles_rad = self._ranges_m = np.empty(0)
        self._seen_s = self._commanded_s = self._released_s = -math.inf
        self._stop = self._slow = self._has_goal = False
        self._why = "no command"
        self._passed = (0.0, 0.0)
        self.hear_topic(given.command, self._command)
        self.hear_topic(given.scan, self._scan)
        self.hear_topic(given.goals, self._goals)

    def _scan(self, message: Any, header: Header) -> None:
        self._ranges_m = np.nan_to_num(np.frombuffer(message.ranges_f32, np.float32), nan=0.0)
        self._angles_rad = (message.angle_min_rad
                            + message.angle_increment_rad * np.arange(len(self._ranges_m)))
        self._seen_s = header.stamp

    def _goals(self, message: Any, _header: Header) -> None:
        self._has_goal = any(goal.status == EXECUTING for goal in message.status_list)

    @on(topics.ORDER)
    def order(self, message: Order, header: Header) -> None:
        """Stop or release the robot, as a recovery orders."""
        if self._stop and not message.stop:
            self._released_s = header.stamp
        self._stop = message.stop

    @on(topics.LIMIT)
    def limit(self, message: Limit, _header: Header) -> None:
        """Limit the speed or release it, as a recovery orders."""
        self._slow = message.slow

    def _command(self, message: Any, header: Header) -> None:
        bounds, now_s = self.parameters, self.clock.now()
        self._commanded_s = header.stamp
        linear, angular = message.linear_mps, message.angular_radps
        self._why = ""
        if self._stop:
            self._why = "stopped by a recovery"
        elif header.stamp < self._released_s:
            self._why = "commanded during a stop"
        elif not (math.isfinite(linear) and math.isfinite(angular)):
            self._why = f"{linear} m/s, {angular} rad/s"
        elif now_s - self._seen_s > bounds.stale_s or not len(self._ranges_m):
            self._why = "no sweep of the laser"
        if self._why:
            linear = angular = 0.0
        top_mps = bounds.slow_mps if self._slow else bounds.top_mps
        linear = max(-top_mps, min(top_mps, linear))
        angular = max(-bounds.top_radps, min(bounds.top_radps, angular))
        if linear and self._is_blocked(linear, angular):
            linear, self._why = 0.0, "an obstacle is too near"
        self._pass(Velocity(linear, angular, header.stamp), header.stamp)

    def _is_blocked(self, linear: float, angular: float) -> bool:
        """Return whether an obstacle is too near for this velocity, now or after the turn."""
        ahead_rad = 0.0 if linear > 0 else math.pi
        aside_rad = self._angles_rad - ahead_rad - np.array([[0.0], [angular * TURNED_S]])
        needed_m = np.maximum(self.parameters.ahead_m * np.cos(aside_rad),
                              np.where(np.cos(aside_rad) >= 0, self.parameters.beside_m, 0.0))
        return bool((self._ranges_m < needed_m).any())

    def _pass(self, velocity: Velocity, stamp_s: float) -> None:
        self._passed = velocity.linear_mps, velocity.angular_radps
        self.publish(topics.CHECKED, velocity, stamp=stamp_s)

    @every(0.1)
    def look(self) -> None:
        """Stop when the navigation is silent, and publish the state."""
        now_s = self.clock.now()
        if now_s - self._commanded_s > self.parameters.stale_s:
            self._why = "the navigation is silent"
            self._pass(Velocity(0.0, 0.0, now_s), now_s)
        self.publish(topics.STATE, GuardState(
            bool(self._why), self._has_goal and not self._stop and not self._passed[0], self._slow,
            self._why, *self._passed))
