"""How a machine that vanishes without a word disturbs the others at a router of ROS 2.

    python -m benchmarks.ros2_lost_machine [--router ros|rampart] [--far client|router]
                                           [--load WHAT …] [--lease S] [--json]

Three machines are network namespaces. The robot has a router and a node that publishes odometry
100 times and sweeps 40 times a second. Clients on the robot, on the ground and on a third machine
subscribe to both, and so does a peer on the robot. From second 5 on, all packets of the third
machine are dropped. Per client, before and after the loss: the longest time from sending to
arrival, the longest time between two messages and when it began, how many messages were lost, and
the longest time for which the client's own process did not run.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import subprocess
import sys
import threading
import time
from collections import deque
from itertools import pairwise
from pathlib import Path
from typing import Any

import zenoh

from rampart.actors.ros2.node import RosNode
from rampart.actors.ros2.router import router_config
from rampart.actors.ros2.side import ZenohSide
from rampart.actors.ros2.translation.types import Types
from rampart.actors.ros2.wire import Attachment, Qos
from rampart.cli.output import print_json, print_table
from rampart.testing import free_port
from tests.whole.network import Network, network, why_not

ODOMETRY, SCAN = "nav_msgs/msg/Odometry", "sensor_msgs/msg/LaserScan"
LOADS = ("joining", "camera", "journal", "log")
BEFORE_S, AFTER_S = 5.0, 25.0
ROS_LEASE_S = 60.0
_STALL_S = 0.01

_SHIPPED = {
    "transport/unicast/open_timeout": 60_000, "transport/unicast/accept_timeout": 60_000,
    "transport/unicast/accept_pending": 10_000, "transport/unicast/max_sessions": 10_000,
    "transport/link/tx/keep_alive": 2, "transport/link/tx/lease": int(ROS_LEASE_S * 1e3),
    "transport/link/tx/queue/congestion_control": {
        "drop": {"wait_before_drop": 1000, "max_wait_before_drop_fragments": 50_000},
        "block": {"wait_before_close": 5_000_000}},
    "transport/shared_memory/enabled": False}
"""`DEFAULT_RMW_ZENOH_ROUTER_CONFIG.json5` of rmw_zenoh, where it differs from `RosRouter`."""


def router(where: str, kind: str, dial: str = "") -> None:
    """Be a router with the settings of `rmw_zenohd` ("ros") or of `RosRouter` ("rampart")."""
    config = router_config(where)
    for name, value in {**(_SHIPPED if kind == "ros" else {}),
                        "connect/endpoints": [dial] if dial else []}.items():
        config.insert_json5(name, json.dumps(value))
    zenoh.init_log_from_env_or("off")
    with zenoh.open(config):
        threading.Event().wait()


async def node(where: str, name: str) -> RosNode:
    """Join the graph, as a node of ROS 2 does."""
    side = ZenohSide([where], asyncio.get_running_loop(), mode="peer")
    return RosNode(side, Types("jazzy"), name, wall_ns=time.time_ns, refuse=lambda *_: None)


async def base(where: str) -> None:
    """Publish odometry and sweeps."""
    here = await node(where, "base")
    blank = here.types.blank(SCAN)
    blank.ranges = here.types.numbers([5.0] * 541)
    publish = {kind: (here.publisher(topic, kind, Qos(depth=10)), payload) for kind, topic, payload
               in ((ODOMETRY, "/odom", here.types.encode(ODOMETRY, here.types.blank(ODOMETRY))),
                   (SCAN, "/scan", here.types.encode(SCAN, blank)))}
    began_s, ticks = time.monotonic(), 0
    while True:
        for kind, (say, payload) in publish.items():
            if kind == ODOMETRY or ticks * 40 // 100 != (ticks + 1) * 40 // 100:
                say(payload)
        ticks += 1
        await asyncio.sleep(max(0.0, began_s + ticks / 100 - time.monotonic()))


async def load(where: str, topic: str, size: int, rate_hz: float, keep_all: bool) -> None:
    """Publish messages of a size."""
    here = await node(where, topic.strip("/"))
    publish = here.publisher(topic, "sensor_msgs/msg/Image", Qos(keep_all=keep_all, depth=10))
    while True:
        publish(bytes(size))
        await asyncio.sleep(1 / rate_hz)


async def joining(where: str) -> None:
    """Have nodes join, ten endpoints each, and leave again."""
    for number in range(10**6):
        here = await node(where, f"joining{number % 5}")
        for topic in range(10):
            here.publisher(f"/joining{number}_{topic}", ODOMETRY, Qos(depth=10))
        await asyncio.sleep(1.0)
        here._side.close()


async def reader(where: str, lease_s: float, mode: str) -> None:
    """Print arrival, delay and number of each odometry, and each stall of this process."""
    config = zenoh.Config()
    for name, value in {"mode": mode, "connect/endpoints": [where], "connect/timeout_ms": -1,
                        "connect/exit_on_failure": False,
                        "listen/endpoints": ["tcp/127.0.0.1:0"] if mode == "peer" else [],
                        "scouting/multicast/enabled": False,
                        "transport/link/tx/lease": int(lease_s * 1e3)}.items():
        config.insert_json5(name, json.dumps(value))
    arrivals: deque[tuple[float, float, int]] = deque()

    def arrived(sample: zenoh.Sample) -> None:
        sent = Attachment.unpack(sample.attachment.to_bytes() if sample.attachment else None)
        arrivals.append((time.monotonic(), (time.time_ns() - sent.stamp_ns) / 1e9, sent.sequence))

    with zenoh.open(config) as session:
        held: list[Any] = [
            session.declare_subscriber("0/odom/**", zenoh.handlers.Callback(
                arrived, indirect=False)),
            *(session.declare_subscriber(f"0/{topic}/**", lambda _: None)
              for topic in ("scan", "camera", "journal", "log")),
            session.liveliness().declare_subscriber("@ros2_lv/0/**", lambda _: None, history=True)]
        last_s = time.monotonic()
        while held:
            await asyncio.sleep(0.002)
            now_s = time.monotonic()
            if now_s - last_s > _STALL_S:
                print("stall", now_s, now_s - last_s, flush=True)
            last_s = now_s
            while arrivals:
                print("odom", *arrivals.popleft(), flush=True)


class Reader:
    """A subscriber in a process of its own, and what it prints."""

    def __init__(self, net: Network, host: str, where: str, lease_s: float, mode: str
                 ) -> None:
        self.process = start(net, host, "reader", where, str(lease_s), mode, stdout=subprocess.PIPE)
        self.lines: list[list[bytes]] = []
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        self.lines.extend(line.split() for line in self.process.stdout)

    def during(self, from_s: float, to_s: float) -> dict[str, float]:
        """Return longest delay, gap and stall, s, when, and how many messages were lost."""
        lines = [line for line in self.lines if from_s <= float(line[1]) < to_s]
        odom = [(float(line[1]), float(line[2]), int(line[3])) for line in lines
                if line[0] == b"odom"] or [(from_s, to_s - from_s, 0)]
        gap_s, gap_at_s = max(((after[0] - one[0], one[0]) for one, after in pairwise(odom)),
                              default=(to_s - from_s, from_s))
        return {"delay_s": max(one[1] for one in odom), "gap_s": gap_s, "gap_at_s": gap_at_s,
                "lost": odom[-1][2] - odom[0][2] + 1 - len(odom),
                "stall_s": max((float(line[2]) for line in lines if line[0] == b"stall"),
                               default=0.0)}


def start(net: Network, host: str, *words: str, **more: Any) -> subprocess.Popen[bytes]:
    """Start a part on a machine."""
    return subprocess.Popen(net.command(
        host, sys.executable, "-m", __spec__.name, "--part", *words), **more)


def measure(options: argparse.Namespace) -> None:
    """Run all parts and print the delays."""
    with network(["robot", "ground", "far"]) as net:
        port = free_port()
        near, far = f"tcp/127.0.0.1:{port}", f"tcp/{net.addresses['robot']}:{port}"
        parts = [start(net, "robot", "router", f"tcp/0.0.0.0:{port}", options.router)]
        time.sleep(1.0)
        parts.append(start(net, "robot", "base", near))
        if options.far == "router":
            parts.append(start(net, "far", "router", near, options.router, far))
            time.sleep(1.0)
        readers = {f"{host}, {mode}": Reader(net, host, where, options.lease, mode)
                   for host, where, mode in (
                       ("robot", near, "client"), ("robot", near, "peer"),
                       ("ground", far, "client"),
                       ("far", near if options.far == "router" else far, "client"))}
        parts += [one.process for one in readers.values()]
        lease_s = ROS_LEASE_S if options.far == "router" else options.lease
        try:
            time.sleep(4.0)
            parts += [start(net, "robot", part, near) for part in options.load]
            time.sleep(2.0)
            began_s = time.monotonic()
            time.sleep(BEFORE_S)
            net.part(("robot", "far"), ("ground", "far"))
            cut_s = time.monotonic()
            time.sleep(lease_s + AFTER_S)
            end_s = time.monotonic()
        finally:
            for part in parts:
                with part:
                    part.kill()
    rows = [(host, phase, readers[host].during(*times)) for host in readers
            for phase, times in (("before", (began_s, cut_s)), ("after", (cut_s, end_s)))]
    if options.json:
        print_json([{"subscriber": host, "phase": phase, **found} for host, phase, found in rows])
    else:
        print_table(
            ("subscriber", "phase", "longest delay", "longest gap", "at", "lost", "longest stall"),
            [(host, phase, f"{1e3 * found['delay_s']:.0f} ms", f"{1e3 * found['gap_s']:.0f} ms",
              f"{found['gap_at_s'] - cut_s:+.1f} s", int(found["lost"]),
              f"{1e3 * found['stall_s']:.0f} ms") for host, phase, found in rows])


def main() -> None:
    """Measure, or be a part."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.ros2_lost_machine", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lease", type=float, default=10.0, metavar="S",
                        help="lease of the clients, s (10, Zenoh's; ROS 2 has 60)")
    parser.add_argument("--router", choices=("ros", "rampart"), default="ros",
                        help="settings of the router: as rmw_zenohd ships, or RosRouter (ros)")
    parser.add_argument("--far", choices=("client", "router"), default="client",
                        help="what the third machine is to the robot's router (client)")
    parser.add_argument("--load", nargs="*", choices=LOADS, default=(),
                        help="nodes that join and leave; 1 MB ten times a second; "
                             "topics that wait for slow readers")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--part", nargs="+", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.part:
        part, where, *more = options.part
        if part == "router":
            router(where, *more)
        elif part == "base":
            asyncio.run(base(where))
        elif part == "joining":
            asyncio.run(joining(where))
        elif part in {"camera", "journal", "log"}:
            asyncio.run(load(where, f"/{part}", *((2**20, 10.0, False) if part == "camera" else
                                                  (2**12, 50.0, True))))
        else:
            asyncio.run(reader(where, float(more[0]), more[1]))
    elif why_not():
        sys.exit(why_not())
    else:
        os.environ.setdefault("PYTHONPATH", str(Path(__file__).resolve().parents[1]))
        measure(options)


if __name__ == "__main__":
    main()
