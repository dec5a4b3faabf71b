"""A gateway at a router of ROS 2: with TLS and access rules, and on another machine."""

import asyncio
import json
import subprocess
import sys
import time

import pytest

from benchmarks.ros2_lost_machine import Reader, start
from rampart.actors.ros2.node import RosNode
from rampart.actors.ros2.side import Tls, ZenohSide
from rampart.actors.ros2.translation.types import Types
from rampart.actors.ros2.wire import Qos
from rampart.testing import RealRun, free_port, wait_until
from tests import ROOT
from tests.actors.ros2.test_gateway import configured
from tests.cli.look import test_ros_verbs as verbs
from tests.real_tools import printed
from tests.whole.network import network, why_not

pytestmark = pytest.mark.processes

ODOM, TWIST, MAP = (
    "nav_msgs/msg/Odometry", "geometry_msgs/msg/Twist", "nav_msgs/msg/OccupancyGrid")
LIVELINESS = ["liveliness_token", "liveliness_query", "declare_liveliness_subscriber"]
LOST, BACK = "; the gateway goes on dialling", " again"


def written(tmp_path, port):
    """Write the system of a gateway at a router with TLS, without the stand-in of the robot."""
    verbs.make_credentials(tmp_path)
    path = tmp_path / "guarded.toml"
    path.write_text(configured(verbs.shown(), connect=[f"tls/127.0.0.1:{port}"]).replace('''
[[node]]
name = "base"
actor = "tests.actors.ros2.robot:Base"
kind = "world"
''', "").replace('frame = "odom"\n', ""))
    return path


def in_ros2(run):
    return next((line for line in printed(run, "status").splitlines()
                 if line.startswith("ros2 ")), "")


def test_the_gateway_passes_and_finds_each_new_router(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    port = verbs.ports()
    path = written(tmp_path, port + 1)
    settings = verbs.secured(tmp_path, port)
    with RealRun(tmp_path, path) as run:
        wait_until(lambda: run.story.count(LOST) == 1, 20)
        for number in (1, 2):
            with verbs.Robot(port, router=settings) as robot:
                wait_until(lambda robot=robot: robot.heard > 20, 20)
                wait_until(lambda: "linked, 2 nodes" in in_ros2(run), 20)
                wait_until(lambda number=number: run.story.count(BACK) == number, 20)
            wait_until(lambda number=number: run.story.count(LOST) == number + 1, 20)
            assert run.pid("gateway") is not None
    assert run.story.count(LOST) == 3  # a line for each change, none for each attempt


TOPIC = ["put", "declare_subscriber"]
SERVICE = ["query", "reply"]
LISTED = {  # as docs/reference/ros2.md lists them
    "graph": (LIVELINESS, ["@ros2_lv/0/**"]),
    "topics": (TOPIC, ["0/odom/**", "0/cmd_vel/**"]),
    "kept": ([*TOPIC, *SERVICE, "declare_queryable", *LIVELINESS],
             ["0/map/**", "0/map/**/@adv/**"]),
    "services": (SERVICE, ["0/base/shut/**"])}


def only(listed):
    """Return the settings of a router that allows the gateway some messages, and tcp all."""
    return {"access_control": {
        "enabled": True, "default_permission": "deny",
        "rules": [{"id": name, "messages": messages, "flows": ["ingress", "egress"],
                   "permission": "allow", "key_exprs": keys}
                  for name, (messages, keys) in listed.items()] + [
                      {"id": "all", "messages": verbs.EVERYTHING, "flows": ["ingress", "egress"],
                       "permission": "allow", "key_exprs": ["**", "@ros2_lv/**", "**/@adv/**"]}],
        "subjects": [{"id": "gateway", "cert_common_names": ["gateway"]},
                     {"id": "own", "link_protocols": ["tcp"]}],
        "policies": [{"rules": list(listed), "subjects": ["gateway"]},
                     {"rules": ["all"], "subjects": ["own"]}]}}


@pytest.mark.parametrize("listed", [LISTED, {"graph": LISTED["graph"]}], ids=["all", "graph"])
async def test_the_listed_rules_are_enough_and_needed(tmp_path, listed):
    port = verbs.ports()
    verbs.make_credentials(tmp_path)
    loop, types, got = asyncio.get_running_loop(), Types("jazzy"), set()
    with verbs.opened({**verbs.secured(tmp_path, port), **only(listed)}):
        side = ZenohSide([f"tcp/127.0.0.1:{port}"], loop, mode="peer")
        robot = RosNode(side, types, "base", wall_ns=time.time_ns, refuse=lambda *_: None)
        pem = str(tmp_path / "robot-gateway.pem")
        other = ZenohSide([f"tls/127.0.0.1:{port + 1}"], loop,
                          tls=Tls(str(tmp_path / "robot-ca.pem"), pem, pem))
        own = RosNode(other, types, "rampart", wall_ns=time.time_ns, refuse=lambda *_: None)
        kept = robot.publisher("/map", MAP, Qos(transient_local=True, depth=1))
        while not side.is_linked():
            await asyncio.sleep(0.02)
        kept(types.encode(MAP, types.blank(MAP)))
        robot.subscribe("/cmd_vel", TWIST, Qos(depth=10), lambda *_: got.add("command"))
        robot.serve("/base/shut", "std_srvs/srv/SetBool", lambda _: b"")
        odometry = robot.publisher("/odom", ODOM, Qos(depth=10))
        own.subscribe("/odom", ODOM, Qos(depth=10), lambda *_: got.add("odometry"))
        command = own.publisher("/cmd_vel", TWIST, Qos(depth=10))
        other.tokens("@ros2_lv/0/**", lambda token, _: got.update(
            {"graph"} if "/base" in token else ()))
        while not other.is_linked():
            await asyncio.sleep(0.02)
        await asyncio.sleep(0.3)
        own.subscribe("/map", MAP, Qos(transient_local=True, depth=1), lambda *_: got.add("map"))
        ask = own.client("/base/shut", "std_srvs/srv/SetBool")
        for _ in range(10):
            odometry(types.encode(ODOM, types.blank(ODOM)))
            command(types.encode(TWIST, types.blank(TWIST)))
            ask(b"", 0.5, lambda payload, _: got.update({"answer"} if payload is not None else ()))
            await asyncio.sleep(0.1)
        other.close()
        side.close()
    assert got == ({"odometry", "command", "graph", "map", "answer"} if listed is LISTED
                   else {"graph"})


def on_ground(network, *words):
    return subprocess.run(network.command("ground", sys.executable, *words), check=False,
                          capture_output=True, text=True, timeout=60, cwd=ROOT)


@pytest.mark.skipif(bool(why_not()), reason=why_not())
def test_a_client_exchanges_messages_and_the_check_knows_that_a_peer_does_not(tmp_path):
    port, output = free_port(), tmp_path / "robot.txt"
    path = tmp_path / "guarded.toml"
    with network(["robot", "ground"]) as net, output.open("w") as out:
        robot = net.addresses["robot"]
        process = subprocess.Popen(net.command(
            "robot", sys.executable, "-m", "tests.actors.ros2.far_robot", robot, str(port)),
            stdout=out, cwd=ROOT)
        try:
            wait_until(lambda: "up" in output.read_text(), 20)
            for mode, passes in (("client", True), ("peer", False)):
                path.write_text(configured(connect=[f"tcp/{robot}:{port}"], mode=mode))
                before = output.read_text().count("0.25")
                done = on_ground(net, "-m", "tests.actors.ros2.far_robot", robot, str(port), mode)
                assert (int(done.stdout) > 20) is passes, done.stderr
                assert (output.read_text().count("0.25") > before + 20) is passes
                done = on_ground(net, "-m", "rampart.cli.main", "ros2", "check", "--system",
                                 str(path), "--json")
                found = {one["what"]: one for one in json.loads(done.stdout)["findings"]}
                assert done.returncode == int(not passes)
                for what in ("subscribe /odom", "publish /cmd_vel"):
                    assert found[what]["well"] is passes
                    assert passes or 'mode = "client"' in found[what]["why"]
        finally:
            with process:
                process.kill()


@pytest.mark.skipif(bool(why_not()), reason=why_not())
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
