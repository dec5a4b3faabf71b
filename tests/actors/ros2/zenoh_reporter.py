"""A node of ROS 2 over Zenoh that reports: python zenoh_reporter.py ENDPOINT.

Commands on standard input are those of `rclpy_peer.py reporter`.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
import time

from rampart.actors.ros2.node import RosNode
from rampart.actors.ros2.side import ZenohSide
from rampart.actors.ros2.translation.types import Types
from rampart.actors.ros2.wire import Qos

ARRAY, STATUS = "diagnostic_msgs/msg/DiagnosticArray", "diagnostic_msgs/msg/DiagnosticStatus"
LOG = "rcl_interfaces/msg/Log"
GOALS, GOAL = "action_msgs/msg/GoalStatusArray", "action_msgs/msg/GoalStatus"
ACTION = "nav2_msgs/action/NavigateToPose"


class Reporter:
    """The node."""

    def __init__(self, endpoint):
        self.level, self.result, self.ended = 0, 4, []
        self.types = types = Types("jazzy")
        side = ZenohSide([endpoint], asyncio.get_running_loop(), mode="peer")
        self.node = RosNode(side, types, "reporter", wall_ns=time.time_ns, refuse=print)
        self.puts = {kind: self.node.publisher(topic, kind, Qos(depth=10)) for topic, kind in (
            ("/diagnostics", ARRAY), ("/rosout", LOG), ("/count/_action/status", GOALS))}
        self.node.serve("/count/_action/send_goal", f"{ACTION}_SendGoal", self.accept)
        self.node.serve("/count/_action/get_result", f"{ACTION}_GetResult", self.end)

    def publish(self, kind, message):
        self.puts[kind](self.types.encode(kind, message))

    def report(self):
        if self.level is not None:
            message, status = self.types.blank(ARRAY), self.types.blank(STATUS)
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(time.time_ns(), 10**9)
            status.name, status.level = "lidar", self.level
            status.message = "no data" if self.level else "ok"
            message.status = [status]
            self.publish(ARRAY, message)

    def log(self):
        line = self.types.blank(LOG)
        line.name, line.level, line.msg = "reporter", 40, "no path"
        self.publish(LOG, line)

    def accept(self, _request):
        response = self.types.blank(f"{ACTION}_SendGoal_Response")
        response.accepted = True
        return self.types.encode(f"{ACTION}_SendGoal_Response", response)

    def end(self, _request):
        self.ended.append(self.result)
        goals, response = self.types.blank(GOALS), self.types.blank(f"{ACTION}_GetResult_Response")
        for second, result in enumerate(self.ended):
            goal = self.types.blank(GOAL)
            goal.goal_info.stamp.sec, goal.status = second, result
            goals.status_list.append(goal)
        self.publish(GOALS, goals)
        response.status = self.result
        return self.types.encode(f"{ACTION}_GetResult_Response", response)

    def obey(self):
        match os.read(0, 100).decode().strip():
            case "well" | "bad" | "quiet" as word:
                self.level = {"well": 0, "bad": 2, "quiet": None}[word]
            case "succeed" | "abort" as word:
                self.result = {"succeed": 4, "abort": 6}[word]
            case "log":
                self.log()


async def main():
    reporter = Reporter(sys.argv[1])
    asyncio.get_running_loop().add_reader(0, reporter.obey)
    os.write(1, json.dumps({"up": "reporter"}).encode() + b"\n")
    while True:
        reporter.report()
        await asyncio.sleep(0.1)


if __name__ == "__main__":
    asyncio.run(main())
