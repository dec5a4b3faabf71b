"""Stand-in for the robot's driver in ROS 2, with the simulated hall."""

from __future__ import annotations

import math
from typing import Any

from rampart import every
from rampart.actors.ros2.stand_in import StandIn
from warehouse import topics
from warehouse.hall import WAY_M, clearance_m, sweep_m
from warehouse.topics import Skew, Trouble, Truth

STEP_S = 0.02
RAYS, RANGE_M = 36, 6.0
MOST_MPS2 = 1.0
DEAD_MAN_S = 0.3
"""Simulated seconds without a command after which it stops, as a driver must."""


class Base(StandIn):
    """Subscribes to /cmd_vel; publishes /odom, /scan and /battery_state."""

    class Parameters(StandIn.Parameters, frozen=True, kw_only=True):
        """seed, dead_man, dead_man_timeout_s: as in every world; charge: at the start, 0 to 1."""

        seed: int = 0
        dead_man: bool = True
        dead_man_timeout_s: float = DEAD_MAN_S
        charge: float = 0.9

    parameters: Parameters
    node_name = "base_driver"
    outputs = (topics.TRUTH, topics.SKEW, topics.TROUBLE)
    node_kind = "world"

    def declare(self) -> None:
        """Begin at the first corner."""
        (self._x_m, self._y_m), self._yaw_rad = WAY_M[0], 0.0
        self._linear_mps = self._angular_radps = 0.0
        self._commanded = (0.0, 0.0)
        self._commanded_s = -math.inf
        self._corners = 0
        self._charge = self.parameters.charge
        self._publish_odometry = self.publisher("/odom", "nav_msgs/msg/Odometry")
        self._publish_scan = self.publisher("/scan", "sensor_msgs/msg/LaserScan")
        self._publish_battery = self.publisher("/battery_state", "sensor_msgs/msg/BatteryState")
        self.subscribe("/cmd_vel", "geometry_msgs/msg/Twist", self._command)

    def _command(self, message: Any) -> None:
        self._commanded = (message.linear.x, message.angular.z)
        self._commanded_s = self.clock.now()

    @every(STEP_S)
    def step(self) -> None:
        """Advance by one step."""
        wanted, turn = self._commanded
        if self.parameters.dead_man and self.clock.now() - self._commanded_s > DEAD_MAN_S:
            wanted = turn = 0.0
        most = MOST_MPS2 * STEP_S
        self._linear_mps += min(max(wanted - self._linear_mps, -most), most)
        self._angular_radps = turn
        self._yaw_rad += turn * STEP_S
        self._x_m += math.cos(self._yaw_rad) * self._linear_mps * STEP_S
        self._y_m += math.sin(self._yaw_rad) * self._linear_mps * STEP_S
        self._charge -= abs(self._linear_mps) * STEP_S * 1e-4
        there = WAY_M[(self._corners + 1) % len(WAY_M)]
        if math.hypot(there[0] - self._x_m, there[1] - self._y_m) < 0.6:
            self._corners += 1

    @every(0.05)
    def odometry(self) -> None:
        """Publish the odometry, which has no slip here."""
        message = self.types.blank("nav_msgs/msg/Odometry")
        message.header.frame_id, message.child_frame_id = "odom", "base_link"
        message.pose.pose.position.x, message.pose.pose.position.y = self._x_m, self._y_m
        message.pose.pose.orientation.z = math.sin(self._yaw_rad / 2)
        message.pose.pose.orientation.w = math.cos(self._yaw_rad / 2)
        message.twist.twist.linear.x = self._linear_mps
        message.twist.twist.angular.z = self._angular_radps
        self._publish_odometry(message)

    @every(0.1)
    def scan(self) -> None:
        """Publish the laser, and the ground truth for the judge."""
        message = self.types.blank("sensor_msgs/msg/LaserScan")
        message.header.frame_id = "base_link"
        message.angle_increment = 2 * math.pi / RAYS
        message.range_max = RANGE_M
        message.ranges = self.types.numbers(
            sweep_m(self._x_m, self._y_m, self._yaw_rad, RAYS, RANGE_M))
        self._publish_scan(message)
        self.publish(topics.TRUTH, Truth(
            self._x_m, self._y_m, clearance_m(self._x_m, self._y_m), self._corners / len(WAY_M)))
        self.publish(topics.SKEW, Skew(0.0))
        self.publish(topics.TROUBLE, Trouble(False, False, False))

    @every(1.0)
    def battery(self) -> None:
        """Publish the charge of the battery."""
        message = self.types.blank("sensor_msgs/msg/BatteryState")
        message.header.frame_id = "base_link"
        message.percentage = self._charge
        message.voltage = 22.0 + 3 * self._charge
        self._publish_battery(message)
