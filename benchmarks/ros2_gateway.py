"""What the gateway to ROS 2 adds to a message, and what it costs.

    python -m benchmarks.ros2_gateway [SECONDS] [--setup FILE]

A robot of ROS 2 says sweeps of 541 rays 40 times a second and odometry 100 times; a small system
hears both by its gateway. Each message carries the monotonic clock in its numbers. Three medians
with the 95th percentile: from ROS 2 to ROS 2, from ROS 2 by the gateway to an actor's place on
the system's bus, and what lies between them; and the share of a core that the gateway takes.
Then the same for a command that a guard passes on: to the gateway, the guard, the gateway, and
back to ROS 2. With --setup the gateway works by its relay in the ROS 2 that FILE sets up, beside
nodes in rclpy, and only the command is measured.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import statistics
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import msgspec
import psutil
import zenoh

from rampart.actors.bus.messages import Message
from rampart.actors.bus.topic import ROOT, Topic
from rampart.actors.bus.topic import Qos as BusQos
from rampart.actors.bus.zenoh_session import endpoints, open_session
from rampart.actors.ros2.node import RosNode
from rampart.actors.ros2.side import ZenohSide
from rampart.actors.ros2.translation.types import Types
from rampart.actors.ros2.wire import Qos
from rampart.actors.runtime.actor import Actor, Context
from rampart.actors.runtime.parameters import TopicHeard
from rampart.testing import RealRun, free_port

ODOMETRY, SCAN = "nav_msgs/msg/Odometry", "sensor_msgs/msg/LaserScan"
TWIST = "geometry_msgs/msg/Twist"
PEER = Path(__file__).with_name("ros2_peer.py")

_DISCOVERY_S = 3.0
_SETTLE = 300
"""Messages that are left out at the begin."""

_SYSTEM = """
name = "gateway_bench"
title = "What the gateway adds"
[[node]]
name = "gateway"
actor = "rampart.actors.ros2.gateway:Gateway"
kind = "non-control"
respawn = "R_RESTART"
parameters = {{ {where} }}
[[node]]
name = "guard"
actor = "benchmarks.ros2_gateway:Guard"
kind = "control"
[[node]]
name = "manager"
actor = "rampart.manager.actor:FtmManager"
kind = "manager"
[[ros2]]
subscribe = "/command"
type = "geometry_msgs/msg/Twist"
to = "bench/command"
[[ros2]]
publish = "/guarded"
type = "geometry_msgs/msg/Twist"
from = "bench/guarded"
[[ros2]]
subscribe = "/odom"
type = "nav_msgs/msg/Odometry"
to = "bench/odometry"
[[ros2]]
subscribe = "/scan"
type = "sensor_msgs/msg/LaserScan"
to = "bench/scan"
fields = {{ range_min_m = "range_min" }}
[[detection]]
name = "D_CRASH"
title = "The gateway has crashed"
actor = "rampart.actors.detection.watchdog:Watchdog"
parameters = {{ watch = ["gateway"], timeout_s = "heartbeat_timeout_s" }}
[[recovery]]
name = "R_RESTART"
title = "Restart it"
actor = "rampart.actors.recovery.respawn:Respawn"
kind = "masking"
[[mechanism]]
name = "M_CRASH"
detect = "D_CRASH"
recover = "R_RESTART"
event = "crash"
against = {{ within_s = 5.0, hazard = "none" }}
[[event]]
name = "crash"
[orders.safer]
"""


def spread(delays_s: list[float]) -> str:
    """Return median and 95th percentile in milliseconds."""
    ordered = sorted(delays_s)
    return (f"{statistics.median(ordered) * 1e3:.2f} ms "
            f"(95 % within {ordered[int(len(ordered) * 0.95)] * 1e3:.2f}), {len(ordered)} messages")


def router(where: str) -> zenoh.Session:
    """Return a router of ROS 2."""
    config = zenoh.Config()
    for name, value in {"mode": "router", "listen/endpoints": [where],
                        "scouting/multicast/enabled": False}.items():
        config.insert_json5(name, json.dumps(value))
    return zenoh.open(config)


class Guarded(Message, frozen=True):
    """Time of a command."""

    linear_mps: float


GUARDED = Topic("bench/guarded", Guarded, BusQos.SENSOR, 100, "", "Commands that were passed on.")


class Guard(Actor):
    """Passes commands on."""

    class Parameters(Actor.Parameters, frozen=True, kw_only=True):
        """Topic of the commands."""

        command: TopicHeard = "bench/command"

    parameters: Parameters
    outputs = (GUARDED,)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.hear_topic(self.parameters.command, lambda message, header: self.publish(
            GUARDED, Guarded(message.linear_mps), stamp=header.stamp))


class Robot:
    """Publishes odometry, commands and sweeps, with the time in a position, speed or range."""

    def __init__(self, where: str) -> None:
        self._types = Types("jazzy")
        loop = asyncio.get_running_loop()
        sides = [ZenohSide([where], loop) for _ in range(2)]
        self._node, self._ear = (RosNode(side, self._types, name, wall_ns=time.time_ns,
                                         refuse=lambda *_: None)
                                 for side, name in zip(sides, ("base", "ear"), strict=True))
        self._say = {kind: self._node.publisher(topic, kind, Qos(depth=10))
                     for kind, topic in ((ODOMETRY, "/odom"), (SCAN, "/scan"),
                                         (TWIST, "/command"))}
        self.commands_s: dict[str, list[float]] = {"/command": [], "/guarded": []}
        speed = self._types.decoder(TWIST)
        for topic, delays_s in self.commands_s.items():
            self._ear.subscribe(topic, TWIST, Qos(depth=10), lambda payload, _, to=delays_s:
                                to.append(time.monotonic() - speed(payload).linear.x))
        self.direct_s: list[float] = []
        decode = self._types.decoder(ODOMETRY)
        self._ear.subscribe("/odom", ODOMETRY, Qos(depth=10), lambda payload, _: self.direct_s
                            .append(time.monotonic() - decode(payload).pose.pose.position.x))

    def say(self, kind: str) -> None:
        """Say one message now."""
        message: Any = self._types.blank(kind)
        if kind == TWIST:
            message.linear.x = time.monotonic()
            self._say[kind](self._types.encode(kind, message))
            return
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(time.time_ns(), 10**9)
        if kind == ODOMETRY:
            message.pose.pose.position.x = time.monotonic()
        else:
            message.ranges = self._types.numbers([5.0] * 541)
        self._say[kind](self._types.encode(kind, message))

    async def go(self, seconds: float) -> None:
        """Say 100 odometries, 100 commands and 40 sweeps a second."""
        loop = asyncio.get_running_loop()
        began, ticks = loop.time(), 0
        while (now := loop.time()) < began + seconds:
            self.say(ODOMETRY)
            self.say(TWIST)
            if ticks * 40 // 100 != (ticks + 1) * 40 // 100:
                self.say(SCAN)
            ticks += 1
            await asyncio.sleep(max(0.0, began + ticks / 100 - now))


def print_commands(direct_s: list[float], guarded_s: list[float]) -> None:
    """Print what a guard adds to a command."""
    print(f"command to ROS 2:        {spread(direct_s)}")
    print(f"command by the guard:    {spread(guarded_s)}")
    added_ms = 1e3 * (statistics.median(guarded_s) - statistics.median(direct_s))
    print(f"the guard's way adds:    {added_ms:.2f} ms at the median")


def measure_relay(seconds: float, setup: Path) -> None:
    """Measure a guarded command between nodes in rclpy."""
    os.environ["ROS_DOMAIN_ID"] = domain = str(os.getpid() % 100 + 1)
    with tempfile.TemporaryDirectory() as directory:
        system = Path(directory, "bench.toml")
        where = f'middleware = "rclpy", distribution = "kilted", domain = {domain}, '
        system.write_text(_SYSTEM.format(where=f'{where}setup = "{setup.absolute()}"'),
                          encoding="utf-8")
        with RealRun(Path(directory), system) as run:
            while run.pid("gateway") is None:
                time.sleep(0.1)
            time.sleep(_DISCOVERY_S)
            peers = [subprocess.Popen(
                ["bash", "-c", '. "$0" && exec python3 "$@"', setup.absolute(), PEER, role,
                 str(seconds)], stdout=subprocess.PIPE) for role in ("ear", "talker")]
            time.sleep(_DISCOVERY_S)
            gateway = psutil.Process(run.pid("gateway"))
            processes = {"gateway": gateway, "relay": gateway.children()[0]}
            before, began = {n: p.cpu_times() for n, p in processes.items()}, time.monotonic()
            time.sleep(seconds - 2 * _DISCOVERY_S)
            after, took_s = {n: p.cpu_times() for n, p in processes.items()}, (
                time.monotonic() - began)
            print_commands(*(json.loads(peer.communicate()[0])[_SETTLE:] for peer in peers))
            for name in processes:
                used_s = sum(after[name][:2]) - sum(before[name][:2])
                print(f"processor of the {name}: {100 * used_s / took_s:.1f} % of a core")


async def measure(seconds: float) -> None:
    """Run all of it and print what came out."""
    where = f"tcp/127.0.0.1:{free_port()}"
    there = router(where)
    with tempfile.TemporaryDirectory() as directory:
        system = Path(directory, "bench.toml")
        system.write_text(_SYSTEM.format(where=f'connect = ["{where}"]'), encoding="utf-8")  # noqa: ASYNC240 no loop yet
        with RealRun(Path(directory), system) as run:
            robot = Robot(where)
            by_gateway_s: list[float] = []
            sweeps = 0

            def arrived(sample: zenoh.Sample) -> None:
                nonlocal sweeps
                body = msgspec.msgpack.decode(sample.payload.to_bytes())[4]
                if str(sample.key_expr).endswith("odometry"):
                    by_gateway_s.append(time.monotonic() - body["x_m"])
                elif str(sample.key_expr).endswith("scan"):
                    sweeps += 1

            while run.pid("gateway") is None:  # noqa: ASYNC110 polled for a moment
                await asyncio.sleep(0.1)
            ear = open_session(endpoints(run.info.folder))
            held = ear.declare_subscriber(f"{ROOT}/bench/*", zenoh.handlers.Callback(
                arrived, indirect=False))
            await robot.go(2.0)
            for delays_s in (robot.direct_s, by_gateway_s, *robot.commands_s.values()):
                delays_s.clear()
            gateway = psutil.Process(run.pid("gateway"))
            before, began = gateway.cpu_times(), time.monotonic()
            sweeps = 0
            await robot.go(seconds)
            after, took_s = gateway.cpu_times(), time.monotonic() - began
            used_s = after.user + after.system - before.user - before.system
            print(f"ROS 2 to ROS 2:          {spread(robot.direct_s)}")
            print(f"by the gateway:          {spread(by_gateway_s)}, {sweeps} sweeps")
            added_ms = 1e3 * (statistics.median(by_gateway_s) - statistics.median(robot.direct_s))
            print(f"the gateway adds:        {added_ms:.2f} ms at the median")
            print(f"processor of the gateway: {100 * used_s / took_s:.1f} % of a core")
            print_commands(*robot.commands_s.values())
            held.undeclare()
            ear.close()
    there.close()


if __name__ == "__main__":
    os.environ.setdefault("PYTHONPATH", str(Path(__file__).resolve().parents[1]))
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.ros2_gateway", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seconds", nargs="?", type=float, default=20.0, metavar="SECONDS",
                        help="how long it is measured (20)")
    parser.add_argument("--setup", type=Path, metavar="FILE",
                        help="measure the relay with the ROS 2 that FILE sets up")
    options = parser.parse_args()
    if options.setup:
        measure_relay(options.seconds, options.setup)
    else:
        asyncio.run(measure(options.seconds))
