"""`rampart ros2 check` beside a robot that is there, and none."""

from __future__ import annotations

import asyncio
import contextlib
import datetime as dt
import json
import re
import socket
import threading
import time
from pathlib import Path

import pytest
import zenoh

from rampart.actors.access.certificates import new_authority, new_certificate, public_part
from rampart.actors.ros2.node import RosNode
from rampart.actors.ros2.side import ZenohSide
from rampart.actors.ros2.translation.types import Types
from rampart.actors.ros2.wire import Qos
from rampart.cli.look import ros_check
from rampart.cli.main import main
from rampart.testing import free_port
from tests.actors.ros2.test_gateway import configured


def opened(settings):
    """Open a router."""
    config = zenoh.Config()
    for name, value in {"mode": "router", "scouting/multicast/enabled": False, **settings}.items():
        config.insert_json5(name, json.dumps(value))
    return zenoh.open(config)


class Robot:
    """A node of ROS 2 with a router, in a thread of its own."""

    def __init__(self, port, publishes="nav_msgs/msg/Odometry", distribution="jazzy", domain=0,
                 router=None):
        self.where, self._stop = f"tcp/127.0.0.1:{port}", threading.Event()
        self._domain, self._router = domain, router or {}
        self.heard = 0
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

    def _take(self, *_):
        self.heard += 1

    async def _live(self):
        with opened({"listen/endpoints": [self.where], **self._router}):
            await self._publish()

    async def _publish(self):
        side = ZenohSide([self.where], asyncio.get_running_loop(), mode="peer")
        node = RosNode(side, self._types, "base", wall_ns=time.time_ns, refuse=lambda *_: None,
                       domain=self._domain)
        say = node.publisher("/odom", self._publishes, Qos(depth=10))
        node.subscribe("/cmd_vel", "geometry_msgs/msg/Twist", Qos(depth=10), self._take)
        while not side.is_linked():
            await asyncio.sleep(0.01)
        self._up.set()
        blank = self._types.encode(self._publishes, self._types.blank(self._publishes))
        while not self._stop.is_set():
            say(blank)
            await asyncio.sleep(0.05)
        side.close()


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    monkeypatch.setattr(ros_check, "_LINK_S", 1.0)
    monkeypatch.setattr(ros_check, "_GRAPH_S", 0.3)


@pytest.fixture
def system(tmp_path):
    def write(port, distribution="jazzy", mode="client", protocol="tcp", more=""):
        path = tmp_path / "guarded.toml"
        path.write_text(configured(more, connect=[f"{protocol}/127.0.0.1:{port}"],
                                   distribution=distribution, mode=mode))
        return str(path)

    return write


def checked(capsys, path):
    code = main(["ros2", "check", "--system", str(path), "--json"])
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


@pytest.mark.parametrize(("robot", "what", "words"), [
    ({"publishes": "std_msgs/msg/String"}, "subscribe /odom",
     ["/odom: /base has the type std_msgs/msg/String; expected nav_msgs/msg/Odometry"]),
    ({"distribution": "humble"}, "subscribe /odom",
     ["another definition of nav_msgs/msg/Odometry", "'humble' has this definition"]),
    ({"domain": 5}, "graph",
     ["no node in domain 0: ROS_DOMAIN_ID is 5 on the robot"]),
    ({"expected": 'publisher = "/localization"\n'}, "subscribe /odom",
     ["published by /base; expected /localization"])])
def test_a_robot_that_does_not_fit(capsys, system, robot, what, words):
    port = free_port()
    expected = robot.pop("expected", "")
    path = Path(system(port))
    path.write_text(path.read_text().replace('frame = "odom"\n', f'frame = "odom"\n{expected}'))
    with Robot(port, **robot):
        code, found = checked(capsys, path)
    assert (code, found[what][0]) == (1, False)
    for word in words:
        assert word in found[what][1]


EVERYTHING = ["put", "delete", "declare_subscriber", "query", "reply", "declare_queryable",
              "liveliness_token", "liveliness_query", "declare_liveliness_subscriber"]


def rules(denied):
    """Return the settings of a router that denies keys to all sessions of this machine."""
    return {"access_control": {
        "enabled": True, "default_permission": "allow",
        "rules": [{"id": "no", "messages": EVERYTHING, "flows": ["ingress", "egress"],
                   "permission": "deny", "key_exprs": denied}],
        "subjects": [{"id": "them", "interfaces": ["lo"]}],
        "policies": [{"rules": ["no"], "subjects": ["them"]}]}}


@pytest.mark.parametrize(("denied", "what", "why"), [
    ("0/odom/**", "subscribe /odom", "an access rule of the router denies 0/odom/nav_msgs::"),
    ("0/cmd_vel/**", "publish /cmd_vel", "an access rule of the router denies 0/cmd_vel/"),
    ("@ros2_lv/**", "graph", "an access rule of the router denies liveliness on @ros2_lv/0/**")])
def test_an_access_rule_of_the_router_is_named(capsys, system, denied, what, why):
    port = free_port()
    with Robot(port, router=rules([denied])):
        code, found = checked(capsys, system(port))
    assert code == 1
    assert found[what][0] is False
    assert why in found[what][1]
    others = {"subscribe /odom", "publish /cmd_vel"} - {what} if what != "graph" else set()
    assert all(found[other][0] for other in others)


def test_machines_programs_and_names_that_do_not_answer(capsys, system, refused):
    def why(path) -> str:
        code, found = checked(capsys, path)
        assert (code, list(found)) == (1, ["router of gateway"])
        return found["router of gateway"][1]

    assert "no router of ROS 2 at tcp/127.0.0.1:1" in why(system(1))
    for backlog, words in (
            (0, "no answer; the machine is off, or a firewall drops packets"),  # the kernel drops
            (50, "a program listens there, but not a router of Zenoh without TLS")):
        with socket.socket() as silent:
            silent.bind(("127.0.0.1", 0))
            silent.listen(backlog)
            assert words in why(system(silent.getsockname()[1]))
    path = Path(system(7447))
    path.write_text(path.read_text().replace("127.0.0.1", "no-robot.invalid"))
    assert re.search(r"no-robot\.invalid:7447: .*(not known|resolution)", why(path))
    assert "paper has no [[ros2]]" in refused("ros2", "check", "--system", "paper")


@pytest.fixture
def credentials(tmp_path):
    return make_credentials(tmp_path)


def make_credentials(folder):
    """Write files of two authorities: the robot's, and a stranger's."""
    now = dt.datetime.now(dt.UTC)
    for owner in ("robot", "stranger"):
        authority = new_authority(now, 10)
        (folder / f"{owner}-ca.pem").write_bytes(public_part(authority))
        for name, kind in (("router", "router"), ("gateway", "node")):
            (folder / f"{owner}-{name}.pem").write_bytes(new_certificate(
                authority, name, kind, addresses=["127.0.0.1"] * (kind == "router"), now=now,
                days=5))
    return folder


def secured(folder, port):
    """Return the settings of a router with TLS beside the plain port of its own machine."""
    tls = "transport/link/tls"
    return {"listen/endpoints": [f"tcp/127.0.0.1:{port}", f"tls/127.0.0.1:{port + 1}"],
            f"{tls}/root_ca_certificate": str(folder / "robot-ca.pem"), f"{tls}/enable_mtls": True,
            f"{tls}/listen_private_key": str(folder / "robot-router.pem"),
            f"{tls}/listen_certificate": str(folder / "robot-router.pem")}


def shown(ca="robot", own="robot-gateway"):
    own = f', certificate = "{own}.pem", key = "{own}.pem"' if own else ""
    return f', tls = {{ ca = "{ca}-ca.pem"{own} }}'


def ports():
    """Return a free port whose successor is free, too."""
    while True:
        port = free_port()
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port + 1))
            return port


def test_a_router_with_tls_admits_the_gateway_and_says_whom_it_refuses(capsys, credentials, system):
    port = ports()
    with Robot(port, router=secured(credentials, port)):
        code, found = checked(capsys, system(port + 1, protocol="tls", more=shown()))
        assert (code, found["subscribe /odom"][0], found["publish /cmd_vel"][0]) == (0, True, True)
        for more, protocol, why in (
                (shown(own=""), "tls", "certificate required"),
                (shown(own="stranger-gateway"), "tls", "it refuses TLS: "),
                (shown(ca="stranger"), "tls", "its certificate is refused: "),
                ("", "tcp", "it requires TLS: expected connect = ['tls/…']")):
            code, found = checked(capsys, system(port + 1, protocol=protocol, more=more))
            assert (code, list(found)) == (1, ["router of gateway"])
            assert why in found["router of gateway"][1]
        code, found = checked(capsys, system(port, protocol="tls", more=shown()))
        assert code == 1
        assert "but not a router of Zenoh with TLS" in found["router of gateway"][1]


@pytest.mark.parametrize(("protocol", "more", "why"), [
    ("tls", "", "connect 'tls/127.0.0.1:1': expected tls = { ca = 'FILE' } with 'tls/…'"),
    ("tcp", shown(), "connect 'tcp/127.0.0.1:1': expected 'tls/…' with tls"),
    ("tls", ', tls = { ca = "ca.pem", key = "key.pem" }', "certificate and key: expected both"),
    ("tls", ', tls = { ca = "none.pem" }', "none.pem': No such file"),
    ("tls", ', tls = { ca = "robot-ca.pem", certificate = "robot-ca.pem", key = "robot-ca.pem" }',
     "robot-ca.pem': [SSL] PEM")])
@pytest.mark.usefixtures("credentials")
def test_files_and_endpoints_that_do_not_fit_are_refused(refused, system, protocol, more, why):
    assert why in refused("ros2", "check", "--system", system(1, protocol=protocol, more=more))
