"""Stand-ins for the three nodes of the navigation, which on a robot come from Nav2.

Each has the topics and services of the real node that the way around a rack needs.
"""

from __future__ import annotations

import math
from typing import Any

from rampart import Header, on
from rampart.actors.ros2.stand_in import StandIn
from rampart.actors.ros2.wire import Qos
from rampart.actors.runtime.actor import every
from warehouse import topics
from warehouse.hall import DEPTH_M, WAY_M, WIDTH_M
from warehouse.topics import Skew, Trouble

UNCONFIGURED, INACTIVE, ACTIVE = 1, 2, 3
"""States of lifecycle_msgs/msg/State."""
TRANSITIONS = {(UNCONFIGURED, 1): INACTIVE, (INACTIVE, 3): ACTIVE, (ACTIVE, 4): INACTIVE,
               (INACTIVE, 2): UNCONFIGURED}
"""State and transition (configure, activate, deactivate, clean up) to the next state."""

EXECUTING, CANCELED, ABORTED = 2, 5, 6
"""Of action_msgs/msg/GoalStatus."""

ERROR = 40
"""Of rcl_interfaces/msg/Log."""

SPEED_MPS = 0.7


def heading_rad(rotation: Any) -> float:
    """Return the heading of a quaternion about z."""
    return 2 * math.atan2(rotation.z, rotation.w)


class Lifecycle(StandIn):
    """A lifecycle node. Nav2's lifecycle manager has activated it at the start of the system.

    A process that is started later is unconfigured, and publishes nothing until it is active.
    """

    trouble = Trouble(False, False, False)

    @on(topics.TROUBLE)
    def take_trouble(self, message: Trouble, _header: Header) -> None:
        """Take the errors to report."""
        self.trouble = message

    def declare(self) -> None:
        """Declare the services of the life cycle."""
        self._state = ACTIVE if self.context.incarnation == 1 else UNCONFIGURED
        self.serve(f"/{self.node_name}/get_state", "lifecycle_msgs/srv/GetState", self._tell)
        self.serve(f"/{self.node_name}/change_state", "lifecycle_msgs/srv/ChangeState",
                   self._change)

    @property
    def is_active(self) -> bool:
        """Whether it works."""
        return self._state == ACTIVE

    def _tell(self, _request: Any, response: Any) -> None:
        response.current_state.id = self._state

    def _change(self, request: Any, response: Any) -> None:
        state = TRANSITIONS.get((self._state, request.transition.id))
        response.success = state is not None
        self._state = state or self._state


class Amcl(Lifecycle):
    """Localization: /amcl_pose from /odom."""

    node_name = "amcl"
    _skew_m = 0.0

    def declare(self) -> None:
        """Declare topics."""
        super().declare()
        self._odometry: Any = None
        self._publish = self.publisher("/amcl_pose", "geometry_msgs/msg/PoseWithCovarianceStamped",
                                   Qos(transient_local=True, depth=1))
        self.subscribe("/odom", "nav_msgs/msg/Odometry", self._take_odometry)

    def _take_odometry(self, message: Any) -> None:
        self._odometry = message

    @on(topics.SKEW)
    def skew(self, message: Skew, _header: Header) -> None:
        """Take the error to add to the pose."""
        self._skew_m = message.x_m

    @every(0.1)
    def pose(self) -> None:
        """Publish the pose."""
        if self.is_active and self._odometry is not None:
            message = self.types.blank("geometry_msgs/msg/PoseWithCovarianceStamped")
            message.header.frame_id = "map"
            message.pose.pose = self._odometry.pose.pose
            message.pose.pose.position.x += self._skew_m
            self._publish(message)
            self._odometry = None


class PlannerServer(Lifecycle):
    """Planner and its costmap; a goal of the navigation can be cancelled."""

    node_name = "planner_server"

    def declare(self) -> None:
        """Declare topics and services."""
        super().declare()
        self._is_cancelled = False
        self._publish_plan = self.publisher("/plan", "nav_msgs/msg/Path")
        self._publish_map = self.publisher("/global_costmap/costmap", "nav_msgs/msg/OccupancyGrid",
                                       Qos(transient_local=True, depth=1))
        self._publish_log = self.publisher("/rosout", "rcl_interfaces/msg/Log")
        self._publish_goals = self.publisher(
            "/navigate_to_pose/_action/status", "action_msgs/msg/GoalStatusArray")
        self.serve("/navigate_to_pose/_action/cancel_goal", "action_msgs/srv/CancelGoal",
                   self._cancel)

    def _cancel(self, _request: Any, response: Any) -> None:
        self._is_cancelled = True
        response.return_code = 0

    @every(0.5)
    def plan(self) -> None:
        """Publish plan and costmap."""
        if not self.is_active:
            return
        goals, goal = (self.types.blank(f"action_msgs/msg/{name}")
                       for name in ("GoalStatusArray", "GoalStatus"))
        goal.status = (ABORTED if self.trouble.aborted else
                       CANCELED if self._is_cancelled else EXECUTING)
        goals.status_list = [goal]
        self._publish_goals(goals)
        if self.trouble.no_way:
            line = self.types.blank("rcl_interfaces/msg/Log")
            line.name, line.level, line.msg = "planner_server", ERROR, "Failed to find a valid path"
            self._publish_log(line)
            return
        path = self.types.blank("nav_msgs/msg/Path")
        path.header.frame_id = "map"
        for x_m, y_m in () if self._is_cancelled else WAY_M:
            pose = self.types.blank("geometry_msgs/msg/PoseStamped")
            pose.pose.position.x, pose.pose.position.y = x_m, y_m
            path.poses.append(pose)
        self._publish_plan(path)
        grid = self.types.blank("nav_msgs/msg/OccupancyGrid")
        grid.header.frame_id = "map"
        grid.info.resolution = 0.5
        grid.info.width, grid.info.height = int(WIDTH_M * 2), int(DEPTH_M * 2)
        grid.data = self.types.numbers([0] * (grid.info.width * grid.info.height), "int8")
        self._publish_map(grid)


class ControllerServer(Lifecycle):
    """Controller: /cmd_vel_nav from /plan and /amcl_pose."""

    node_name = "controller_server"

    def declare(self) -> None:
        """Declare topics."""
        super().declare()
        self._plan: list[tuple[float, float]] = []
        self._pose: tuple[float, float, float] | None = None
        self._next: int | None = None
        self._publish = self.publisher("/cmd_vel_nav", "geometry_msgs/msg/Twist")
        self._publish_status = self.publisher(
            "/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
        self.subscribe("/plan", "nav_msgs/msg/Path", self._planned)
        self.subscribe("/amcl_pose", "geometry_msgs/msg/PoseWithCovarianceStamped", self._located,
                       Qos(transient_local=True, depth=1))

    @every(0.5)
    def report(self) -> None:
        """Publish whether the control loop keeps its rate."""
        array, status = (self.types.blank(f"diagnostic_msgs/msg/{name}")
                         for name in ("DiagnosticArray", "DiagnosticStatus"))
        status.name = "controller_server: rate"
        status.level, status.message = (
            (2, "control loop missed its rate") if self.trouble.late_control else (0, "20 Hz"))
        array.status = [status]
        self._publish_status(array)

    def _planned(self, message: Any) -> None:
        self._plan = [(p.pose.position.x, p.pose.position.y) for p in message.poses]

    def _located(self, message: Any) -> None:
        pose = message.pose.pose
        self._pose = pose.position.x, pose.position.y, heading_rad(pose.orientation)

    def _off_m(self, place: int) -> float:
        """Return the distance from the leg that begins at a corner, m."""
        assert self._pose is not None  # noqa: S101 for the type checker
        (x_m, y_m), there = self._plan[place], self._plan[(place + 1) % len(self._plan)]
        dx, dy = there[0] - x_m, there[1] - y_m
        away_x, away_y = self._pose[0] - x_m, self._pose[1] - y_m
        share = min(max((away_x * dx + away_y * dy) / (dx * dx + dy * dy), 0.0), 1.0)
        return math.hypot(away_x - share * dx, away_y - share * dy)

    def _away_m(self, place: int) -> float:
        assert self._pose is not None  # noqa: S101 for the type checker
        x_m, y_m = self._plan[place]
        return math.hypot(x_m - self._pose[0], y_m - self._pose[1])

    @every(0.05)
    def control(self) -> None:
        """Publish the velocity."""
        if not self.is_active:
            return
        message = self.types.blank("geometry_msgs/msg/Twist")
        if self._plan and self._pose is not None:
            if self._next is None:  # a new process continues where the robot is
                self._next = min(range(len(self._plan)), key=self._off_m) + 1
            if self._away_m(self._next % len(self._plan)) < 0.5:
                self._next += 1
            x_m, y_m = self._plan[self._next % len(self._plan)]
            off = math.atan2(y_m - self._pose[1], x_m - self._pose[0]) - self._pose[2]
            off = math.atan2(math.sin(off), math.cos(off))
            message.angular.z = max(-1.2, min(1.2, 2 * off))
            message.linear.x = SPEED_MPS * max(0.0, math.cos(off))
        self._publish(message)
