"""A robot in ROS 2 with its router, for a network namespace of its own.

    python far_robot.py ADDRESS PORT BROKERING

The router has the settings with which `rmw_zenohd` ships; the node is a peer that listens on its
own machine alone, as nodes of `rmw_zenoh` do. It publishes /odom and writes each speed it gets.
"""

from __future__ import annotations

import sys
import threading

from tests.cli.look.test_ros_verbs import Robot


class FarRobot(Robot):
    def _take(self, payload, _attachment):
        print(self._types.decode("geometry_msgs/msg/Twist", payload).linear.x, flush=True)


if __name__ == "__main__":
    address, port, brokering = sys.argv[1:]
    with FarRobot(port, router={
            "listen/endpoints": [f"tcp/{one}:{port}" for one in (address, "127.0.0.1")],
            "scouting/gossip/enabled": True, "timestamping/enabled": True,
            "routing/router/peers_failover_brokering": brokering == "true"}):
        print("up", flush=True)
        threading.Event().wait()
