"""Run by the Python that has the wheels of ROS 2: nodes of a robot in rclpy, over DDS.

    python rclpy_peer.py base|camera|rival|wrong|reporter

`base` publishes /odom 20 times a second (best effort) and its name once (transient local), and
offers /base/shut, the action /count and the lifecycle node /camera. `camera` is that lifecycle node
alone. `rival` publishes /odom and /cmd_vel too; `wrong` publishes texts on /odom. Each writes a
line of JSON for each message, request and transition.

`reporter` publishes the status of a lidar ten times a second, logs, and ends goals of /count. A
word on standard input sets that: well, bad or quiet (no status); log (a line); succeed or abort.
"""

import json
import os
import signal
import sys
import threading
import time

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rclpy.action import ActionServer
from rclpy.executors import MultiThreadedExecutor
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import String
from std_srvs.srv import SetBool
from test_msgs.action import Fibonacci


def say(**what):
    os.write(1, f"{json.dumps({'pid': os.getpid(), 'at_s': time.time(), **what})}\n".encode())


class Camera(LifecycleNode):
    """A node with states."""

    def __init__(self):
        super().__init__("camera")

    def on_configure(self, state):
        say(state="inactive")
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state):
        say(state="active")
        return super().on_activate(state)


def publish_odometry(node, speed_mps):
    publisher = node.create_publisher(
        Odometry, "/odom", QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT))
    began = time.monotonic()

    def step():
        message = Odometry()
        message.header.stamp = node.get_clock().now().to_msg()
        message.header.frame_id, message.child_frame_id = "odom", "base_link"
        message.pose.pose.position.x = time.monotonic() - began
        message.twist.twist.linear.x = speed_mps
        publisher.publish(message)

    node.create_timer(0.05, step)


def base():
    node = rclpy.create_node("base")
    node.create_subscription(Twist, "/cmd_vel", lambda message: say(heard=message.linear.x), 10)
    publish_odometry(node, 0.5)
    name = node.create_publisher(String, "/base/name", QoSProfile(
        depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    name.publish(String(data="osmosis"))

    def shut(request, response):
        say(shut=request.data)
        response.success, response.message = request.data, "by the other implementation"
        return response

    node.create_service(SetBool, "/base/shut", shut)

    def count(goal):
        say(goal=goal.request.order)
        goal.succeed()
        return Fibonacci.Result(sequence=[0, 1])

    node.held = name, ActionServer(node, Fibonacci, "/count", count)
    return [node, Camera()]


def rival():
    node = rclpy.create_node("rival")
    publish_odometry(node, 9.0)
    command = node.create_publisher(Twist, "/cmd_vel", 10)
    node.create_timer(0.05, lambda: command.publish(Twist()))
    return [node]


def wrong():
    node = rclpy.create_node("wrong")
    node.held = node.create_publisher(String, "/odom", 10)
    return [node]


def reporter():
    node = rclpy.create_node("reporter")
    publisher = node.create_publisher(DiagnosticArray, "/diagnostics", 10)
    state = {"level": b"\0", "end": "succeed"}

    def step():
        if state["level"] is not None:
            message = DiagnosticArray(status=[DiagnosticStatus(
                name="lidar", level=state["level"], message="no data")])
            message.header.stamp = node.get_clock().now().to_msg()
            publisher.publish(message)

    def end(goal):
        getattr(goal, state["end"])()
        return Fibonacci.Result()

    def listen():
        for line in sys.stdin:
            match line.strip():
                case "well" | "bad" | "quiet" as word:
                    state["level"] = {"well": b"\0", "bad": b"\2", "quiet": None}[word]
                case "succeed" | "abort" as word:
                    state["end"] = word
                case "log":
                    node.get_logger().error("no path")

    node.create_timer(0.1, step)
    node.held = ActionServer(node, Fibonacci, "/count", end)
    threading.Thread(target=listen, daemon=True).start()
    return [node]


def main():
    is_over = threading.Event()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    signal.signal(signal.SIGTERM, lambda *_: is_over.set())
    executor = MultiThreadedExecutor(2)
    nodes = {"base": base, "camera": lambda: [Camera()], "rival": rival, "wrong": wrong,
             "reporter": reporter}[sys.argv[1]]()
    for node in nodes:
        executor.add_node(node)
    say(up=sys.argv[1])
    while not is_over.is_set():
        executor.spin_once(0.1)
    for node in nodes:
        node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
