"""The guard, which stands between the navigation and the base."""

from __future__ import annotations

import math
from typing import Any

from rampart import Actor, Context, Header, every, on
from rampart.actors.runtime.parameters import TopicHeard
from rampart.manager.spec.tables import Positive
from warehouse import topics
from warehouse.topics import GuardState, Order, Velocity


class Guard(Actor):
    """Passes a velocity on that is young, within bounds, and leads into no obstacle."""

    class Parameters(Actor.Parameters, frozen=True, kw_only=True):
        """Which topics of the gateway it hears, and its bounds.

        Attributes:
            command: velocity that the navigation commands.
            scan: of the laser; it has a field `nearest_m`.
            top_mps, top_radps: bounds.
            stop_m: nothing may be nearer to the robot's middle than that: its radius of 0.3 m, what
                it goes in 0.2 s, the age of a sweep, and what it needs to stop from 0.8 m/s.
            stale_s: a command or sweep that is older stops the robot.
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
        said = self.parameters
        self._nearest_m, self._seen_s = math.nan, -math.inf
        self._told_s = -math.inf
        self._stop, self._why = False, "nothing was commanded"
        self._linear_mps = 0.0
        self.hear_topic(said.command, self._commanded)
        self.hear_topic(said.scan, self._scanned)

    def _scanned(self, message: Any, header: Header) -> None:
        self._nearest_m, self._seen_s = message.nearest_m, header.stamp

    @on(topics.ORDER)
    def order(self, message: Order, _header: Header) -> None:
        """Stand still while a recovery says so."""
        self._stop = message.stop

    def _commanded(self, message: Any, header: Header) -> None:
        said, now_s = self.parameters, self.clock.now()
        self._told_s = header.stamp
        linear, angular = message.linear_mps, message.angular_radps
        self._why = ""
        if self._stop:
            self._why = "a recovery has it stand"
        elif not (math.isfinite(linear) and math.isfinite(angular)):
            self._why = f"{linear} m/s, {angular} rad/s"
        elif now_s - self._seen_s > said.stale_s:
            self._why = "no sweep of the laser"
        elif not self._nearest_m > said.stop_m and linear > 0:
            self._why = f"{self._nearest_m:.2f} m to the next obstacle"
        if self._why:
            linear, angular = 0.0, angular if self._why.endswith("obstacle") else 0.0
        linear = max(-said.top_mps, min(said.top_mps, linear))
        angular = max(-said.top_radps, min(said.top_radps, angular))
        self._linear_mps = linear
        self.publish(topics.CHECKED, Velocity(linear, angular, header.stamp),
                     stamp=header.stamp)

    @every(0.1)
    def look(self) -> None:
        """Stop when the navigation is silent, and say what it does."""
        now_s = self.clock.now()
        if now_s - self._told_s > self.parameters.stale_s:
            self._why = "the navigation is silent"
            self._linear_mps = 0.0
            self.publish(topics.CHECKED, Velocity(0.0, 0.0, now_s))
        self.publish(topics.STATE, GuardState(bool(self._why), self._why, self._linear_mps))
