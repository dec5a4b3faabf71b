"""Osmosis Control: computes the velocity command from route, pose and scan, 20 times a second.

It always publishes a command, zero without a route, since DM2 treats silence as an error.
"""

from __future__ import annotations

import math
from typing import Any, ClassVar

from rampart.actors.bus.topic import Topic
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.route_check import RouteCheck
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.osmosis.control.following.dead_reckoning import DeadReckoning
from rampart.actors.osmosis.control.following.light_ledger import RowInspection
from rampart.actors.osmosis.control.following.light_row import RowLimits
from rampart.actors.osmosis.control.following.motion_loop import MotionLoop
from rampart.actors.osmosis.control.following.route_control import (
    CONTROL_STATE,
    PERIOD_S,
    RouteControl,
)
from rampart.actors.osmosis.control.pilot.laser_pair import LOWER, UPPER
from rampart.actors.osmosis.readings import is_light
from rampart.actors.runtime.actor import Actor, Context, Header, every, on
from rampart.manager.spec.tables import NonNegative


class OsmosisControl(Actor):
    """Wires `RouteControl` to topics and timers.

    Class attributes:
        command_topic: topic of the command; a standby has its own.
    """

    class Parameters(Actor.Parameters, frozen=True):
        """Extensions to the paper's node.

        Attributes:
            check_route: whether a route is checked before it is followed.
            pass_after_s: waiting time in a row before the robot passes an obstacle, s; 0: never.
            has_standby: whether a standby follows, which needs changes of the lateral offset at
                once.
            yaw_loop: whether the turn rate has a closed loop (`motion_loop`).
            bridge_m: distance driven by odometry without a fresh pose, m; 0: it computes from the
                last pose, however old, and does not subscribe to odometry.
        """

        check_route: bool = False
        pass_after_s: NonNegative = 0.0
        has_standby: bool = False
        yaw_loop: bool = False
        bridge_m: NonNegative = 0.0

    parameters: Parameters

    command_topic: ClassVar[Topic[m.Twist]] = topics.COMMAND
    outputs: ClassVar[tuple[Topic[Any], ...]] = (
        topics.COMMAND, topics.CONTROL_STATUS, topics.LIGHT_MEASURED)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        system, airport = context.run.system, Osmosis.of(context).airport
        parameters = self.parameters
        measures = topics.LIGHT_MEASURED in self.outputs
        self._lights = RowInspection(airport.lights if measures else (),
                                     goes_back=measures and system.layers.checkpoints)
        self.core = RouteControl(
            system, airport, self.report_diagnostic, context.clock.now(),
            RowLimits(pass_after_s=parameters.pass_after_s or math.inf),
            lights=self._lights, check=RouteCheck(airport) if parameters.check_route else None,
            bridge=DeadReckoning(parameters.bridge_m) if parameters.bridge_m else None,
            loop=MotionLoop(system.robot.top_turn_rate_radps) if parameters.yaw_loop else None,
            has_standby=parameters.has_standby)

    def listens(self, topic: Topic[Any]) -> bool:
        """Whether it subscribes to a topic: odometry only if it bridges."""
        return self.parameters.bridge_m > 0 or topic is not topics.ODOMETRY

    def on_start(self) -> None:
        """Restore the checkpoint; the robot continues when the route arrives."""
        if (kept := self.kept(CONTROL_STATE)) is not None:
            self.core.restore(kept)

    @on(topics.MISSION_STATUS)
    def mission(self, message: m.MissionStatus, _header: Header) -> None:
        """Take the lights that the Mission Manager has."""
        self._lights.confirm(message)

    @on(topics.POSE)
    def pose(self, message: m.Pose, header: Header) -> None:
        """Take a pose."""
        self.core.pose(message, header.stamp, self.clock.now())
        self._begin()

    @on(topics.SCAN)
    def scan(self, message: m.LaserScan, header: Header) -> None:
        """Take a sweep."""
        self.core.scan(LOWER, message, header.stamp, self.clock.now())
        self._begin()

    @on(topics.UPPER_SCAN)
    def upper_scan(self, message: m.LaserScan, header: Header) -> None:
        """Take a sweep of the second laser, if the robot has one."""
        self.core.scan(UPPER, message, header.stamp, self.clock.now())
        self._begin()

    @on(topics.LIGHT)
    def light(self, message: m.LightSample, header: Header) -> None:
        """Take a reading of the light sensor."""
        if is_light(message):
            self._lights.inspection.sample(header.stamp, message.illuminance_lux)

    @on(topics.GOAL)
    def goal(self, message: m.GoalOrder, _header: Header) -> None:
        """Take the goal."""
        if self.core.goal(message):
            self._set_out()

    @on(topics.ROUTE)
    def route(self, message: m.Route, _header: Header) -> None:
        """Take a route."""
        if self.core.route(message):
            self._set_out()

    @on(topics.ODOMETRY)
    def odometry(self, message: m.Odometry, header: Header) -> None:
        """Take odometry."""
        self.core.odometry(message, header.stamp, self.clock.now())

    def _set_out(self) -> None:
        self._remember()
        self._begin()

    def _begin(self) -> None:
        if self.core.begins():
            self.control()

    @every(0.5)
    def _remember(self) -> None:
        """Save the checkpoint, always before its consequences are published."""
        if (kept := self.core.kept) is not None:
            self.keep(CONTROL_STATE, kept)

    @every(PERIOD_S)
    def control(self) -> None:
        """Publish the command."""
        now_s = self.clock.now()
        self.publish(self.command_topic, self.core.step(now_s))
        self.inform(now_s)

    def inform(self, now_s: float) -> None:
        """Publish measurements, and the status if it has changed."""
        lights = self.core.measure(now_s)
        if lights:
            self._remember()
        for light in lights:
            self.publish(topics.LIGHT_MEASURED, light)
        if self.core.report():
            self.publish(topics.CONTROL_STATUS, self.core.status)

    @every(0.2)
    def repeat(self) -> None:
        """Repeat the status and unconfirmed measurements."""
        self.publish(topics.CONTROL_STATUS, self.core.status)
        for light in self._lights.ledger.to_send_again(self.clock.now()):
            self.publish(topics.LIGHT_MEASURED, light)
