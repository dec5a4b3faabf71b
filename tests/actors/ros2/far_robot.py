"""A robot in ROS 2 with its router, for a network namespace of its own.

    python far_robot.py ADDRESS PORT BROKERING

The router has the settings with which `rmw_zenohd` ships; the node is a peer that listens on its
own machine alone, as nodes of `rmw_zenoh` do. It publishes /odom and writes each speed it gets.
"""

from __future__ import annotations

import asyncio
import json
import sys
import time

import zenoh

from rampart.actors.ros2.node import RosNode
from rampart.actors.ros2.side import ZenohSide
from rampart.actors.ros2.translation.types import Types
from rampart.actors.ros2.wire import Qos

ODOMETRY, TWIST = "nav_msgs/msg/Odometry", "geometry_msgs/msg/Twist"


def router(address, port, brokering):
    """Open a router as ROS 2 ships it."""
    config = zenoh.Config()
    for name, value in {
            "mode": "router",
            "listen/endpoints": [f"tcp/{one}:{port}" for one in (address, "127.0.0.1")],
            "scouting/multicast/enabled": False, "scouting/gossip/enabled": True,
            "routing/router/peers_failover_brokering": brokering,
            "timestamping/enabled": True}.items():
        config.insert_json5(name, json.dumps(value))
    return zenoh.open(config)


async def main():
    """Be there until the process is killed."""
    address, port, brokering = sys.argv[1], sys.argv[2], sys.argv[3] == "true"
    there = router(address, port, brokering)
    side = ZenohSide([f"tcp/127.0.0.1:{port}"], asyncio.get_running_loop(), mode="peer")
    types = Types("jazzy")
    node = RosNode(side, types, "base", wall_ns=time.time_ns, refuse=lambda *_: None)
    say = node.publisher("/odom", ODOMETRY, Qos(depth=10))
    decode = types.decoder(TWIST)
    node.subscribe("/cmd_vel", TWIST, Qos(depth=10), lambda payload, _: print(
        decode(payload).linear.x, flush=True))
    blank = types.encode(ODOMETRY, types.blank(ODOMETRY))
    print("up", flush=True)
    while there is not None:
        say(blank)
        await asyncio.sleep(0.05)


if __name__ == "__main__":
    asyncio.run(main())
