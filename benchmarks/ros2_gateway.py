"""What the gateway to ROS 2 adds to a message, and what it costs.

    python -m benchmarks.ros2_gateway [SECONDS]

A robot of ROS 2 says sweeps of 541 rays 40 times a second and odometry 100 times; a small system
hears both by its gateway. Each message carries the monotonic clock in its numbers. Three medians
with the 95th percentile: from ROS 2 to ROS 2, from ROS 2 by the gateway to an actor's place on
the system's bus, and what lies between them; and the share of a core that the gateway takes.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import msgspec
import psutil
import zenoh

from rampart.actors.bus.topic import ROOT
from rampart.actors.bus.zenoh_session import endpoints, open_session
from rampart.actors.ros2.node import RosNode
from rampart.actors.ros2.side import ZenohSide
from rampart.actors.ros2.translation.types import Types
from rampart.actors.ros2.wire import Qos
from rampart.testing import RealRun, free_port

ODOMETRY, SCAN = "nav_msgs/msg/Odometry", "sensor_msgs/msg/LaserScan"
_SYSTEM = """
name = "gateway_bench"
title = "What the gateway adds"
[[node]]
name = "gateway"
actor = "rampart.actors.ros2.gateway:Gateway"
kind = "non-control"
respawn = "R_RESTART"
parameters = {{ connect = ["{where}"] }}
[[node]]
name = "manager"
actor = "rampart.manager.actor:FtmManager"
kind = "manager"
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


class Robot:
    """Says odometry and sweeps, each with the time in its position or its smallest range."""

    def __init__(self, where: str) -> None:
        self._types = Types("jazzy")
        loop = asyncio.get_running_loop()
        sides = [ZenohSide([where], loop) for _ in range(2)]
        self._node, self._ear = (RosNode(side, self._types, name, wall_ns=time.time_ns,
                                         refuse=lambda *_: None)
                                 for side, name in zip(sides, ("base", "ear"), strict=True))
        self._say = {kind: self._node.publisher(topic, kind, Qos(depth=10))
                     for kind, topic in ((ODOMETRY, "/odom"), (SCAN, "/scan"))}
        self.direct_s: list[float] = []
        decode = self._types.decoder(ODOMETRY)
        self._ear.subscribe("/odom", ODOMETRY, Qos(depth=10), lambda payload, _: self.direct_s
                            .append(time.monotonic() - decode(payload).pose.pose.position.x))

    def say(self, kind: str) -> None:
        """Say one message now."""
        message: Any = self._types.blank(kind)
        now_ns = time.time_ns()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(now_ns, 10**9)
        if kind == ODOMETRY:
            message.pose.pose.position.x = time.monotonic()
        else:
            message.ranges = self._types.numbers([5.0] * 541)
        self._say[kind](self._types.encode(kind, message))

    async def go(self, seconds: float) -> None:
        """Say 100 odometries and 40 sweeps a second."""
        loop = asyncio.get_running_loop()
        began, ticks = loop.time(), 0
        while (now := loop.time()) < began + seconds:
            self.say(ODOMETRY)
            if ticks * 40 // 100 != (ticks + 1) * 40 // 100:
                self.say(SCAN)
            ticks += 1
            await asyncio.sleep(max(0.0, began + ticks / 100 - now))


async def measure(seconds: float) -> None:
    """Run all of it and print what came out."""
    where = f"tcp/127.0.0.1:{free_port()}"
    there = router(where)
    with tempfile.TemporaryDirectory() as directory:
        system = Path(directory, "bench.toml")
        system.write_text(_SYSTEM.format(where=where), encoding="utf-8")  # noqa: ASYNC240 no loop yet
        with RealRun(Path(directory), system) as run:
            robot = Robot(where)
            by_gateway_s: list[float] = []
            sweeps = 0

            def arrived(sample: zenoh.Sample) -> None:
                nonlocal sweeps
                body = msgspec.msgpack.decode(sample.payload.to_bytes())[4]
                if str(sample.key_expr).endswith("odometry"):
                    by_gateway_s.append(time.monotonic() - body["x_m"])
                else:
                    sweeps += 1

            while run.pid("gateway") is None:  # noqa: ASYNC110 polled for a moment
                await asyncio.sleep(0.1)
            ear = open_session(endpoints(run.info.folder))
            held = ear.declare_subscriber(f"{ROOT}/bench/*", zenoh.handlers.Callback(
                arrived, indirect=False))
            await robot.go(2.0)
            robot.direct_s.clear(), by_gateway_s.clear()
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
    asyncio.run(measure(parser.parse_args().seconds))
