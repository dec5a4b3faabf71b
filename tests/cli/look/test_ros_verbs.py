"""`rampart ros2 check` and `rampart topic … --ros` beside a robot that is there, and none."""

from __future__ import annotations

import asyncio
import json
import threading
import time

import pytest

from rampart.actors.ros2.node import RosNode
from rampart.actors.ros2.side import ZenohSide
from rampart.actors.ros2.translation.types import Types
from rampart.actors.ros2.wire import Qos
from rampart.cli.look import ros_topics
from rampart.cli.main import main
from rampart.testing import free_port
from tests.actors.ros2.test_gateway import SYSTEM


class Robot:
    """A node of ROS 2 with a router, in a thread of its own."""

    def __init__(self, port, publishes="nav_msgs/msg/Odometry", distribution="jazzy"):
        self.where, self._stop = f"tcp/127.0.0.1:{port}", threading.Event()
        self._publishes, self._types = publishes, Types(distribution)
        self._thread = threading.Thread(target=lambda: asyncio.run(self._live()))
        self._up = threading.Event()

    def __enter__(self):
        self._thread.start()
        assert self._up.wait(10)
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()

    async def _live(self):
        import zenoh

        config = zenoh.Config()
        for name, value in {"mode": "router", "listen/endpoints": [self.where],
                            "scouting/multicast/enabled": False}.items():
            config.insert_json5(name, json.dumps(value))
        router = zenoh.open(config)
        side = ZenohSide([self.where], asyncio.get_running_loop(), mode="peer")
        node = RosNode(side, self._types, "base", wall_ns=time.time_ns, refuse=lambda *_: None)
        say = node.publisher("/odom", self._publishes, Qos(depth=10))
        node.subscribe("/cmd_vel", "geometry_msgs/msg/Twist", Qos(depth=10), lambda *_: None)
        while not side.is_linked():
            await asyncio.sleep(0.01)
        self._up.set()
        blank = self._types.encode(self._publishes, self._types.blank(self._publishes))
        while not self._stop.is_set():
            say(blank)
            await asyncio.sleep(0.05)
        side.close()
        router.close()


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    monkeypatch.setattr(ros_topics, "_LINK_S", 1.0)
    monkeypatch.setattr(ros_topics, "_GRAPH_S", 0.3)


@pytest.fixture
def system(tmp_path):
    def write(port, distribution="jazzy", mode="client"):
        path = tmp_path / "guarded.toml"
        path.write_text(SYSTEM.replace(
            'actor = "rampart.actors.ros2.gateway:Gateway"\n',
            'actor = "rampart.actors.ros2.gateway:Gateway"\nparameters = { connect = '
            f'["tcp/127.0.0.1:{port}"], distribution = "{distribution}", mode = "{mode}" }}\n'))
        return str(path)

    return write


def checked(capsys, path):
    code = main(["ros2", "check", "--system", path, "--json"])
    said = json.loads(capsys.readouterr().out)
    return code, {one["what"]: (one["well"], one["why"]) for one in said["findings"]}


@pytest.mark.parametrize("mode", ["client", "peer"])
def test_a_robot_that_fits(capsys, system, mode):
    port = free_port()
    with Robot(port):
        code, found = checked(capsys, system(port, mode=mode))
    assert code == 0
    assert found["subscribe /odom"] == (True, "/base, nav_msgs/msg/Odometry")
    assert found["publish /cmd_vel"] == (True, "/base, geometry_msgs/msg/Twist")


@pytest.mark.parametrize(("robot", "distribution", "why"), [
    ({"publishes": "std_msgs/msg/String"}, "jazzy",
     "/odom: /base has the type std_msgs/msg/String; expected nav_msgs/msg/Odometry"),
    ({"distribution": "humble"}, "jazzy", "another definition of nav_msgs/msg/Odometry")])
def test_a_robot_that_does_not_fit(capsys, system, robot, distribution, why):
    port = free_port()
    with Robot(port, **robot):
        code, found = checked(capsys, system(port, distribution))
    assert code == 1
    assert found["subscribe /odom"][0] is False
    assert why in found["subscribe /odom"][1]


def test_without_a_router_it_is_said_once(capsys, system):
    code, found = checked(capsys, system(1))
    assert code == 1
    assert list(found) == ["router of gateway"]
    assert "no router of ROS 2 at tcp/127.0.0.1:1" in found["router of gateway"][1]


def test_a_system_without_ros_2_is_refused(capsys):
    assert main(["ros2", "check", "--system", "paper"]) == 2
    assert "paper has no [[ros2]]" in capsys.readouterr().err


def test_topics_are_listed_shown_and_measured(capsys):
    port = free_port()
    with Robot(port) as robot:
        assert main(["topic", "list", "--ros", robot.where, "--json"]) == 0
        listed = json.loads(capsys.readouterr().out)
        assert {"topic": "/odom", "types": ["nav_msgs/msg/Odometry"], "publishers": ["/base"],
                "subscribers": []} in listed
        assert main(["topic", "echo", "/odom", "--ros", robot.where, "-n", "2", "--json"]) == 0
        first, second = map(json.loads, capsys.readouterr().out.splitlines())
        assert second["sequence"] == first["sequence"] + 1
        assert first["message"]["pose"]["pose"]["orientation"]["w"] == 1.0
        assert main(["topic", "hz", "/odom", "--ros", robot.where, "--json"]) == 0
        measured, = json.loads(capsys.readouterr().out)
        assert 5 < measured["rate_hz"] < 25
        assert main(["topic", "echo", "/imu", "--ros", robot.where, "-n", "1"]) == 1
        assert "no node publishes /imu; topics: /cmd_vel, /odom" in capsys.readouterr().err


@pytest.mark.parametrize(("name", "value", "why"), [
    ("ROS_DOMAIN_ID", "x", "ROS_DOMAIN_ID=x: expected a number"),
    ("ROS_DISTRO", "melodic", "ROS_DISTRO=melodic: unknown; known: humble")])
def test_an_environment_that_makes_no_sense_is_refused(capsys, monkeypatch, name, value, why):
    monkeypatch.setenv(name, value)
    assert main(["topic", "echo", "/odom", "--ros", "tcp/127.0.0.1:1"]) == 2
    assert why in capsys.readouterr().err
