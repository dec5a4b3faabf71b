"""A gateway on another machine than ROS 2, in a network namespace each."""

from __future__ import annotations

import json
import subprocess
import sys
import time

import pytest

from benchmarks.ros2_lost_machine import Reader, start
from rampart.testing import free_port, wait_until
from tests import ROOT
from tests.actors.ros2.test_gateway import SYSTEM
from tests.whole.network import Network, network, why_not

pytestmark = [pytest.mark.processes, pytest.mark.skipif(bool(why_not()), reason=why_not())]

ROBOT, GROUND = "10.234.0.1", "10.234.0.2"
SPEAKER = """
import asyncio, sys, time
from rampart.actors.ros2.node import RosNode
from rampart.actors.ros2.side import ZenohSide
from rampart.actors.ros2.translation.types import Types
from rampart.actors.ros2.wire import Qos
async def main(where, mode):
    side = ZenohSide([where], asyncio.get_running_loop(), mode=mode)
    types, heard = Types("jazzy"), []
    node = RosNode(side, types, "rampart", wall_ns=time.time_ns, refuse=lambda *_: None)
    node.subscribe("/odom", "nav_msgs/msg/Odometry", Qos(depth=10), lambda *_: heard.append(1))
    say = node.publisher("/cmd_vel", "geometry_msgs/msg/Twist", Qos(depth=10))
    twist = types.blank("geometry_msgs/msg/Twist")
    twist.linear.x = 0.25
    until_s = time.monotonic() + 4
    while time.monotonic() < until_s:
        say(types.encode("geometry_msgs/msg/Twist", twist))
        await asyncio.sleep(0.05)
    print(len(heard))
    side.close()
asyncio.run(main(*sys.argv[1:]))
"""


@pytest.fixture(params=["false", "true"], ids=["as-ros-2-ships", "with-brokering"])
def robot(request, tmp_path):
    """A robot on another machine: the network, where its router is, and the file of its output."""
    network = Network({"robot": ROBOT, "ground": GROUND})
    network.open()
    port, output = free_port(), tmp_path / "robot.txt"
    with output.open("w") as out:
        process = subprocess.Popen(network.command(
            "robot", sys.executable, "-m", "tests.actors.ros2.far_robot", ROBOT, str(port),
            request.param), stdout=out, cwd=ROOT)
    try:
        until_s = time.monotonic() + 20
        while "up" not in output.read_text() and time.monotonic() < until_s:
            time.sleep(0.05)
        yield network, f"tcp/{ROBOT}:{port}", output
    finally:
        with process:
            process.kill()
        network.close()


def on_ground(network, *words):
    return subprocess.run(network.command("ground", sys.executable, *words), check=False,
                          capture_output=True, text=True, timeout=60, cwd=ROOT)


def checked(network, where, tmp_path, mode):
    path = tmp_path / f"{mode}.toml"
    said = f', mode = "{mode}"' if mode else ""
    path.write_text(SYSTEM.replace(
        'actor = "rampart.actors.ros2.gateway:Gateway"\n',
        'actor = "rampart.actors.ros2.gateway:Gateway"\n'
        f'parameters = {{ connect = ["{where}"]{said} }}\n'))
    done = on_ground(network, "-m", "rampart.cli.main", "ros2", "check", "--system", str(path),
                     "--json")
    return done.returncode, {one["what"]: one for one in json.loads(done.stdout)["findings"]}


def test_a_client_exchanges_messages_and_the_check_knows_that_a_peer_does_not(robot, tmp_path):
    network, where, output = robot
    done = on_ground(network, "-c", SPEAKER, where, "client")
    assert int(done.stdout) > 20, done.stderr
    assert output.read_text().count("0.25") > 20
    code, findings = checked(network, where, tmp_path, "")
    assert (code, findings["subscribe /odom"]["well"]) == (0, True)

    before = output.read_text().count("0.25")
    assert int(on_ground(network, "-c", SPEAKER, where, "peer").stdout) == 0
    assert output.read_text().count("0.25") == before
    code, findings = checked(network, where, tmp_path, "peer")
    assert code == 1
    for what in ("subscribe /odom", "publish /cmd_vel"):
        assert not findings[what]["well"]
        assert 'mode = "client"' in findings[what]["why"]


@pytest.mark.alone
def test_a_lost_machine_does_not_stop_the_messages_to_the_others():
    with network(["robot", "ground", "far"]) as net:
        port = free_port()
        near, far = f"tcp/127.0.0.1:{port}", f"tcp/{net.addresses['robot']}:{port}"
        parts = [start(net, "robot", "router", f"tcp/0.0.0.0:{port}", "rampart")]
        try:
            readers = {host: Reader(net, host, where, 10.0, "client") for host, where in (
                ("robot", near), ("ground", far), ("far", far))}
            parts += [one.process for one in readers.values()]
            parts += [start(net, "robot", part, near) for part in ("base", "journal", "log")]
            for one in readers.values():
                wait_until(lambda one=one: len(one.lines) > 200, 30)
            net.part(("robot", "far"), ("ground", "far"))  # 10 s before the router gives it up
            counts = {host: len(one.lines) for host, one in readers.items()}
            time.sleep(4.0)
            came = {host: len(one.lines) - counts[host] for host, one in readers.items()}
        finally:
            for part in parts:
                with part:
                    part.kill()
    assert came["far"] < 50
    for host in ("robot", "ground"):
        assert came[host] > 200, came  # of 400; with the settings of `rmw_zenohd` none
