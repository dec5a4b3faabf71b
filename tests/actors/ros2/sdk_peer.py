"""Run by the Python that has zenoh-ros2-sdk: a robot's base, by an implementation that is not ours.

    python sdk_peer.py PORT SHARE

It says its odometry 20 times a second, offers /base/shut, and writes a line of JSON for each
command that it hears.
"""

import json
import os
import sys
import time

from zenoh_ros2_sdk import message_registry
from zenoh_ros2_sdk.publisher import ROS2Publisher
from zenoh_ros2_sdk.service_server import ROS2ServiceServer
from zenoh_ros2_sdk.session import ZenohSession
from zenoh_ros2_sdk.subscriber import ROS2Subscriber


def say(**what):
    os.write(1, f"{json.dumps(what)}\n".encode())  # whole: several threads say something


def main():
    port, share = int(sys.argv[1]), sys.argv[2]
    ZenohSession.get_instance("127.0.0.1", port)
    registry = message_registry.get_registry(share)
    for name in ("nav_msgs/msg/Odometry", "geometry_msgs/msg/Twist"):
        assert registry.load_message_type(name), name
    for name in ("std_srvs/srv/SetBool",):
        assert registry.load_service_type(name), name
    there = {"router_port": port, "node_name": "sdk_base"}
    ROS2Subscriber("/cmd_vel", "geometry_msgs/msg/Twist", lambda message: say(
        heard=message.linear.x, turn=message.angular.z), **there)
    odometry = ROS2Publisher("/odom", "nav_msgs/msg/Odometry", **there)

    def shut(request):
        say(shut=bool(request.data))
        response = registry.get_message_class("std_srvs/srv/SetBool_Response")
        return response(success=bool(request.data), message="by the other implementation")

    ROS2ServiceServer("/base/shut", "std_srvs/srv/SetBool", shut, **there)
    types = registry.session.store.types

    def made(name, **fields):
        return types[name](**fields)

    import numpy as np
    began = time.monotonic()
    point, turn = "geometry_msgs/msg/Point", "geometry_msgs/msg/Quaternion"
    while True:
        now = time.time_ns()
        x = time.monotonic() - began
        vector = made("geometry_msgs/msg/Vector3", x=0.5, y=0.0, z=0.0)
        zero = made("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        odometry.publish(
            header=made("std_msgs/msg/Header", frame_id="odom", stamp=made(
                "builtin_interfaces/msg/Time", sec=now // 10**9, nanosec=now % 10**9)),
            child_frame_id="base_link",
            pose=made("geometry_msgs/msg/PoseWithCovariance", covariance=np.zeros(36), pose=made(
                "geometry_msgs/msg/Pose", position=made(point, x=x, y=0.0, z=0.0),
                orientation=made(turn, x=0.0, y=0.0, z=0.0, w=1.0))),
            twist=made("geometry_msgs/msg/TwistWithCovariance", covariance=np.zeros(36),
                       twist=made("geometry_msgs/msg/Twist", linear=vector, angular=zero)))
        time.sleep(0.05)


if __name__ == "__main__":
    main()
