"""A robot in ROS 2 for tests: a base that hears commands and tells its odometry, and services."""

from __future__ import annotations

from typing import Any

import msgspec

from rampart.actors.bus.messages import Message
from rampart.actors.bus.topic import Qos, Topic
from rampart.actors.ros2.stand_in import StandIn
from rampart.actors.runtime.actor import Actor, every
from rampart.actors.runtime.parameters import TopicPublished

GOAL, GOAL_TYPE = "/navigate_to_pose", "nav2_msgs/action/NavigateToPose"
ODOM_TYPE, TWIST_TYPE = "nav_msgs/msg/Odometry", "geometry_msgs/msg/Twist"


class Speed(Message, frozen=True):
    """How fast the robot is to go."""

    linear_mps: float
    angular_radps: float = 0.0


WANTED = Topic("base/wanted", Speed, Qos.SENSOR, 20, "base_link", "How fast it is to go.")


class Driver(Actor):
    """Says how fast the robot is to go."""

    outputs = (WANTED,)
    speed_mps = 0.5

    @every(0.05)
    def drive(self) -> None:
        """Say it."""
        self.publish(WANTED, Speed(self.speed_mps))


class Base(StandIn):
    """Drives as it is told, and says where it is."""

    node_name = "base"
    offset_ns = 0
    namespace = "/robot"

    def declare(self) -> None:
        """Declare what it says, hears and serves."""
        self.heard, self.shut, self.goals = [], 0, []
        self.x_m, self.speed_mps = 0.0, 0.0
        self.say_odometry = self.publisher("/odom", ODOM_TYPE)
        self.subscribe("/cmd_vel", TWIST_TYPE, self.command)
        self.serve("/base/shut", "std_srvs/srv/SetBool", self.set)
        self.serve(f"{GOAL}/_action/send_goal", f"{GOAL_TYPE}_SendGoal", self.take_goal)
        self.serve(f"{GOAL}/_action/get_result", f"{GOAL_TYPE}_GetResult", self.end_goal)

    def command(self, message) -> None:
        """Go as fast."""
        self.heard.append(message.linear.x)
        self.speed_mps = message.linear.x

    def set(self, request, response) -> None:
        """Shut, or refuse."""
        self.shut += 1
        response.success = bool(request.data)
        response.message = "shut" if request.data else "it has to be open"

    def take_goal(self, request, response) -> None:
        """Take a goal that is ahead."""
        self.goals.append(bytes(request.goal_id.uuid))
        response.accepted = request.goal.pose.pose.position.x > 0

    def end_goal(self, request, response) -> None:
        """Say that it is reached."""
        assert bytes(request.goal_id.uuid) == self.goals[-1]
        response.status = 4

    @every(0.05)
    def step(self) -> None:
        """Drive on."""
        self.x_m += 0.05 * self.speed_mps
        message = self.types.blank(ODOM_TYPE)
        message.header.frame_id, message.child_frame_id = "odom", "base_link"
        message.pose.pose.position.x = self.x_m
        message.twist.twist.linear.x = self.speed_mps
        self.say_odometry(message)

    def wall_ns(self) -> int:
        """Return what time it is, or what it lies."""
        return super().wall_ns() + self.offset_ns


class Reporter(StandIn):
    """Reports statuses, lines of a log, and goals of an action, as nodes of ROS 2 do."""

    def declare(self) -> None:
        """Declare its topics."""
        self.statuses = {"arm": (0, "ok")}
        self.is_silent = False
        self._diagnostics = self.publisher("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
        self._log = self.publisher("/rosout", "rcl_interfaces/msg/Log")
        self._goals = self.publisher(f"{GOAL}/_action/status", "action_msgs/msg/GoalStatusArray")

    @every(0.1)
    def repeat(self) -> None:
        """Report the statuses."""
        if not self.is_silent:
            self.report(self.statuses)

    def report(self, statuses) -> None:
        """Report statuses: level and message by name."""
        message = self.types.blank("diagnostic_msgs/msg/DiagnosticArray")
        for name, (level, text) in statuses.items():
            status = self.types.blank("diagnostic_msgs/msg/DiagnosticStatus")
            status.name, status.level, status.message = name, level, text
            message.status.append(status)
        self._diagnostics(message)

    def log(self, name, level, text) -> None:
        """Log a line."""
        message = self.types.blank("rcl_interfaces/msg/Log")
        message.name, message.level, message.msg = name, level, text
        self._log(message)

    def goals(self, states) -> None:
        """Report the states of goals, in the order of their acceptance."""
        message = self.types.blank("action_msgs/msg/GoalStatusArray")
        for number, state in enumerate(states):
            status = self.types.blank("action_msgs/msg/GoalStatus")
            status.goal_info.stamp.sec, status.status = number, state
            message.status_list.append(status)
        self._goals(message)


class Asker(Actor):
    """Asks the base to shut, or something else, once a second, by the gateway's own topic."""

    class Parameters(Actor.Parameters, frozen=True, kw_only=True):
        """Which topic, and what."""

        topic: TopicPublished = "base/shut"
        body: dict[str, Any] = msgspec.field(default_factory=lambda: {"data": True})

    parameters: Parameters

    @every(1.0)
    def ask(self) -> None:
        """Ask."""
        topic = self.chosen_topic(self.parameters.topic)
        self.publish(topic, msgspec.convert(self.parameters.body, topic.type))
