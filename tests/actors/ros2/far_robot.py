"""A robot in ROS 2 with its router, or who speaks with it, for a network namespace of its own.

    python -m tests.actors.ros2.far_robot ADDRESS PORT [client|peer]

The router has the settings with which `rmw_zenohd` ships; the node is a peer that listens on its
own machine alone, as nodes of `rmw_zenoh` do. It publishes /odom and writes each speed it gets.
With a mode, commands are sent for four seconds, and the number of odometries is written.
"""

import asyncio
import sys
import threading
import time

from rampart.actors.ros2.node import RosNode
from rampart.actors.ros2.side import ZenohSide
from rampart.actors.ros2.translation.types import Types
from rampart.actors.ros2.wire import Qos
from tests.cli.look.test_ros_verbs import Robot

TWIST = "geometry_msgs/msg/Twist"


class FarRobot(Robot):
    def _take(self, payload, _attachment):
        print(self._types.decode(TWIST, payload).linear.x, flush=True)


async def speak(where, mode):
    side, types = ZenohSide([where], asyncio.get_running_loop(), mode=mode), Types("jazzy")
    heard = []
    node = RosNode(side, types, "rampart", wall_ns=time.time_ns, refuse=lambda *_: None)
    node.subscribe("/odom", "nav_msgs/msg/Odometry", Qos(depth=10), lambda *_: heard.append(1))
    say = node.publisher("/cmd_vel", TWIST, Qos(depth=10))
    twist = types.blank(TWIST)
    twist.linear.x = 0.25
    until_s = time.monotonic() + 4
    while time.monotonic() < until_s:
        say(types.encode(TWIST, twist))
        await asyncio.sleep(0.05)
    print(len(heard))
    side.close()


if __name__ == "__main__":
    address, port, *mode = sys.argv[1:]
    if mode:
        asyncio.run(speak(f"tcp/{address}:{port}", *mode))
    else:
        with FarRobot(port, router={
                "listen/endpoints": [f"tcp/{one}:{port}" for one in (address, "127.0.0.1")],
                "scouting/gossip/enabled": True, "timestamping/enabled": True}):
            print("up", flush=True)
            threading.Event().wait()
