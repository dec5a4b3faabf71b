"""The guard between the navigation and the base."""

from __future__ import annotations

import math
from typing import Any

from rampart import Actor, Context, Header, TopicHeard, every, on
from rampart.manager.spec.tables import Positive
from warehouse import topics
from warehouse.topics import GuardState, Order, Velocity


class Guard(Actor):
    """Passes velocities that are recent, within bounds, and free of obstacles."""

    class Parameters(Actor.Parameters, frozen=True, kw_only=True):
        """Topics of the gateway, and bounds.

        Attributes:
            command: topic of the navigation's velocity.
            scan: topic of the laser, with a field `nearest_m`.
            top_mps, top_radps: largest velocities.
            stop_m: smallest distance of an obstacle from the robot's centre: its radius of 0.3 m,
                the way in 0.2 s, the age of a sweep, and the braking distance from 0.8 m/s.
            stale_s: an older command or sweep stops the robot.
        """

        command: TopicHeard
        scan: TopicHeard
        top_mps: Positive = 0.8
        top_radps: Positive = 1.5
        stop_m: Positive = 0.8
        stale_s: Positive = 0.3

    parameters: Parameters
    outputs = (topics.CHECKED, topics.STATE)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        given = self.parameters
        self._nearest_m, self._seen_s = math.nan, -math.inf
        self._commanded_s = self._released_s = -math.inf
        self._stop, self._why = False, "no command"
        self._linear_mps = 0.0
        self.hear_topic(given.command, self._command)
        self.hear_topic(given.scan, self._scan)

    def _scan(self, message: Any, header: Header) -> None:
        self._nearest_m, self._seen_s = message.nearest_m, header.stamp

    @on(topics.ORDER)
    def order(self, message: Order, header: Header) -> None:
        """Stop or release the robot, as a recovery orders."""
        if self._stop and not message.stop:
            self._released_s = header.stamp
        self._stop = message.stop

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
        elif now_s - self._seen_s > bounds.stale_s:
            self._why = "no sweep of the laser"
        elif not self._nearest_m > bounds.stop_m and linear > 0:
            self._why = f"{self._nearest_m:.2f} m to the next obstacle"
        if self._why:
            linear, angular = 0.0, angular if self._why.endswith("obstacle") else 0.0
        linear = max(-bounds.top_mps, min(bounds.top_mps, linear))
        angular = max(-bounds.top_radps, min(bounds.top_radps, angular))
        self._linear_mps = linear
        self.publish(topics.CHECKED, Velocity(linear, angular, header.stamp),
                     stamp=header.stamp)

    @every(0.1)
    def look(self) -> None:
        """Stop when the navigation is silent, and publish the state."""
        now_s = self.clock.now()
        if now_s - self._commanded_s > self.parameters.stale_s:
            self._why = "the navigation is silent"
            self._linear_mps = 0.0
            self.publish(topics.CHECKED, Velocity(0.0, 0.0, now_s))
        self.publish(topics.STATE, GuardState(bool(self._why), self._why, self._linear_mps))
