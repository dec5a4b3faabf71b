"""Run by the Python of an installation of ROS 2, for `benchmarks.ros2_gateway --setup`.

    python ros2_peer.py talker|ear SECONDS

`talker` publishes the monotonic clock on /command 100 times a second, and receives it on /guarded;
`ear` receives it on /command. Each prints its delays in seconds, as a list in JSON.
"""

from __future__ import annotations

import json
import sys
import time

import rclpy
from geometry_msgs.msg import Twist


def main() -> None:
    """Measure for some seconds."""
    role, seconds = sys.argv[1], float(sys.argv[2])
    rclpy.init()
    node = rclpy.create_node(role)
    delays_s: list[float] = []
    node.create_subscription(
        Twist, "/guarded" if role == "talker" else "/command",
        lambda message: delays_s.append(time.monotonic() - message.linear.x), 10)
    if role == "talker":
        publisher = node.create_publisher(Twist, "/command", 10)

        def say() -> None:
            message = Twist()
            message.linear.x = time.monotonic()
            publisher.publish(message)

        node.create_timer(0.01, say)
    until_s = time.monotonic() + seconds
    while time.monotonic() < until_s:
        rclpy.spin_once(node, timeout_sec=0.1)
    print(json.dumps(delays_s))


main()
