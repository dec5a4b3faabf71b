"""The observer of Osmosis, and its injector of obstacles."""

from __future__ import annotations

import math
from typing import Any

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.runtime.actor import Header, on
from rampart.sim.faults.injector import Injector, PlannedAction
from rampart.sim.osmosis.trial.faults import SuddenObstacle
from rampart.sim.runs.observer import Observer


class OsmosisInjector(Injector):
    """Executes a scenario of planned faults."""

    outputs = (*Injector.outputs, topics.ACTUATOR_FAULT, topics.OBSTACLE)

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, **more)
        self._pose: m.Pose | None = None
        self._obstacles: dict[str, PlannedAction] = {}

    @on(topics.MISSION_STATUS)
    def mission(self, status: m.MissionStatus, _header: Header) -> None:
        """Take the current goal."""
        if status.phase is m.MissionPhase.RUNNING:
            self.goals_begun(status.step + 1)

    @on(topics.TRUTH)
    def truth(self, truth: m.GroundTruth, _header: Header) -> None:
        """Take the pose of the robot."""
        self._pose = truth.pose

    @on(topics.OBSTACLES)
    def obstacles(self, listed: m.ObstacleList, _header: Header) -> None:
        """Take the present obstacles."""
        for obstacle in listed.obstacles:
            if obstacle.present and obstacle.name in self._obstacles:
                self._obstacles[obstacle.name].hit = 1

    def carry_out(self, fault: PlannedAction) -> None:
        """Add an obstacle ahead of the robot."""
        action, pose = fault.action, self._pose
        if not isinstance(action, SuddenObstacle):
            raise TypeError(f"{action!r}: expected a SuddenObstacle")
        if pose is None:
            fault.reason = "the pose of the robot is unknown"
            return
        name = f"sudden-{self.planned.index(fault) + 1}"
        self._obstacles[name] = fault
        there = m.ObstacleCommand(
            name, True, pose.x_m + action.distance_m * math.cos(pose.yaw_rad),
            pose.y_m + action.distance_m * math.sin(pose.yaw_rad), action.radius_m)
        fault.reason = "no room for the obstacle"
        self.publish(topics.OBSTACLE, there)
        if math.isfinite(action.duration_s):
            gone = m.ObstacleCommand(name, False, there.x_m, there.y_m, there.radius_m)
            self.call_later(action.duration_s, lambda: self.publish(topics.OBSTACLE, gone))


class OsmosisObserver(Observer):
    """Passes the robot's messages to its sinks too."""

    @on(topics.MISSION_STATUS)
    @on(topics.CONTROL_STATUS)
    @on(topics.LIGHT_MEASURED)
    @on(topics.POSE)
    @on(topics.PILOT_STATUS)
    @on(topics.TRUTH)
    @on(topics.OBSTACLES)
    def robot_message(self, message: Any, header: Header) -> None:
        """Pass one message on."""
        self.heard(message, header)
