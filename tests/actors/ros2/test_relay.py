"""The gateway beside nodes in rclpy, over DDS; a lifecycle node that is killed again and again."""

import asyncio
import itertools
import json
import os
import shutil
import signal
import sys
import time

import psutil
import pytest

from rampart.actors.ros2.node import RosNode
from rampart.actors.ros2.relay_side import RelayError, RelaySide
from rampart.actors.ros2.translation.types import Types
from rampart.actors.ros2.wire import UNKNOWN_GID, Qos
from rampart.actors.supervision.kill_node import signal_node
from rampart.testing import RealRun, wait_until
from tests import ROOT
from tests.actors.ros2.test_against_ros import PYTHON, ROS, Peer, check_passing, echoed
from tests.actors.ros2.test_gateway import beside_foreign
from tests.actors.ros2.test_reports import REPORTS
from tests.cli.look.test_ros_verbs import checked
from tests.real_tools import printed

pytestmark = [pytest.mark.ros, pytest.mark.processes]

PEER = ROOT / "tests/actors/ros2/rclpy_peer.py"
TWIST = "geometry_msgs/msg/Twist"
NUMBERS = itertools.count(0, 7)
SETUP = ROS.resolve() / "bin/activate"


@pytest.fixture(autouse=True)
def domain(monkeypatch):
    """A domain of this test, on this machine only: killed nodes stay in a graph for 20 s."""
    number = (os.getpid() + next(NUMBERS)) % 100 + 1
    for name, value in {"ROS_DOMAIN_ID": str(number), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
                        "PYTHONPATH": str(ROOT)}.items():
        monkeypatch.setenv(name, value)
    return number


@pytest.fixture
def system(tmp_path, domain):
    def write(more="", setup=SETUP):
        text = beside_foreign(middleware="rclpy", setup=str(setup), domain=domain,
                              distribution="kilted", interfaces=["interfaces"])
        path = tmp_path / "guarded.toml"
        path.write_text(text.replace('frame = "odom"\n', 'frame = "odom"\nreliable = false\n')
                        + more)
        where = tmp_path / "interfaces/test_msgs/action"
        where.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROS / "share/test_msgs/action/Fibonacci.action", where)
        return path

    return write


def relay_of(run):
    relay, = psutil.Process(run.pid("gateway")).children()
    return relay


COUNT = """
[[node]]
name = "counter"
actor = "tests.actors.ros2.robot:Asker"
kind = "non-control"
parameters = { topic = "count/goal", body = { order = 3 } }

[[ros2]]
goal = "/count"
type = "test_msgs/action/Fibonacci"
from = "count/goal"
to = "count/state"
"""

KEPT = """
[[node]]
name = "navigation"
command = ["sh", "-c", "exec {python} {peer} base >> {log}"]
kind = "non-control"
heartbeat = {{ key = "base/odometry", timeout_s = 2.0 }}

[[detection]]
name = "D_NODES"
title = "A node is missing, or the gateway is bypassed"
actor = "rampart.actors.ros2.ros_nodes:RosNodes"
parameters = {{ gateway = "gateway", nodes = ["/base"], alone = true }}
within_s = 2.0

[[mechanism]]
name = "M_NODES"
detect = "D_NODES"
recover = "R_RESTART"
event = "missing"
against = {{ within_s = 5.0, hazard = "the robot stands" }}
"""


def test_topics_services_and_actions_over_dds(tmp_path, system):
    path = system(COUNT)
    with Peer(PEER, "base") as peer:
        peer.wait_for("up")
        with RealRun(tmp_path, path) as run:
            check_passing(run, peer)
            assert relay_of(run).environ()["FASTDDS_BUILTIN_TRANSPORTS"] == "UDPv4"
            run.wait_until(lambda: 3 in peer.said("goal"), 10, "no goal")
            assert "succeeded" in {one["phase"] for one in echoed(run, "count/state", 6)}
            told = json.loads(run.tool("status", "--json").stdout)["ros2"]
            assert set(told["nodes"]) == {"/rampart", "/base", "/camera"}
            assert run.tool("node", "log", "gateway").returncode == 0
        wait_until(lambda: peer.said("heard")[-1] == 0.0, 5, "the last command is not zero")
        assert peer.said("heard").count(0.0) == 1


def test_what_is_killed_comes_back_alone_and_a_rival_and_a_missing_node_are_reported(
        tmp_path, system):
    """A gateway or relay that died was blamed on the command whose heartbeat it passes on."""
    log = tmp_path / "log"
    log.touch()

    def heard():
        return [one["heard"] for one in map(json.loads, log.read_text().splitlines())
                if "heard" in one]

    with RealRun(tmp_path, system(KEPT.format(python=PYTHON, peer=PEER, log=log))) as run:
        run.wait_until(lambda: len(heard()) > 40, 30, "no command")
        program = psutil.Process(signal_node("navigation", "CONT", run.port).pid)
        for strike, line in (
                (lambda: relay_of(run).kill(), "the relay to ROS 2 ended: signal 9"),
                (lambda: relay_of(run).suspend(), "the relay to ROS 2 hung: no answer for 1 s"),
                (lambda: run.kill("gateway"), "gateway crashed")):
            gateway, relay = run.pid("gateway"), relay_of(run)
            strike()
            run.wait_for(line, 10)
            run.wait_until(lambda relay=relay: not relay.is_running(), 5, "the relay is left")
            run.wait_until(lambda killed=gateway: run.pid("gateway") not in {None, killed}, 10,
                           "no new gateway")
            before = len(heard())
            run.wait_until(lambda before=before: len(heard()) > before + 50, 20, "no command")
            assert set(heard()) <= {0.5}
        assert "navigation crashed" not in run.story  # with a time-out of 2 s

        def idle():
            return echoed(run, "detection/D_NODES")[0]["state"] == "idle"

        run.wait_until(idle, 10, "the node is missing still")
        with Peer(PEER, "rival") as rival:
            run.wait_until(lambda: "two publishers, /base and /rival" in printed(
                run, "topic", "echo", "diagnostic/gateway", "-n", "3", "--duration", "3"),
                10, "not refused")
            assert {one["linear_mps"] for one in echoed(run, "base/odometry", 20)} == {0.5}
            run.wait_for("(D_NODES): /cmd_vel: /rival publishes besides /rampart", 10)
            rival.process.terminate()  # else it stays in the graph for 20 s
            rival.process.wait()
        run.wait_until(idle, 30, "the rival is there still")
        program.terminate()
        run.wait_for("(D_NODES): /base: not in the graph of ROS 2", 10)
        run.wait_for("navigation respawned by supervisor, incarnation 2", 10)
        assert {one["linear_mps"] for one in echoed(run, "base/odometry", 20)} == {0.5}
        signal_node("navigation", "STOP", run.port)
        run.wait_for("navigation crashed, incarnation 2: ", 10)
        run.wait_for("navigation respawned by supervisor, incarnation 3", 10)


REPORTED = REPORTS[REPORTS.index('[[ros2]]\nsubscribe = "/diagnostics"'):]
for old, new in {"/navigate_to_pose": "/count", "nav/state": "count/state", "planner*": "rep*",
                 ", count = 3, within_s = 1.0": "", ', suspects = ["gateway"]': ""}.items():
    assert old in REPORTED, old
    REPORTED = REPORTED.replace(old, new)


def test_statuses_lines_and_goals_that_other_nodes_report(tmp_path, system):
    with Peer(PEER, "reporter") as peer, RealRun(tmp_path, system(COUNT + REPORTED)) as run:
        run.wait_until(lambda: run.pid("gateway"), 30, "the run did not start")
        with Peer("-P", "-m", "rampart.cli.main", "topic", "echo", "detection/*", "--json",
                  "--port", str(run.port), python=sys.executable) as reports:
            def until(module, state, reason=""):
                def is_so():
                    said = [line["message"] for line in list(reports.lines)
                            if line["source"] == module]
                    return bool(said) and said[-1]["state"] == state and (
                        reason in said[-1]["reason"])
                run.wait_until(is_so, 40, f"{module} is not {state}: {reason}")

            for module in ("D_STATUS", "D_LOG", "D_GOAL", "D_OWN"):
                until(module, "idle")
            for word, module, reason in (("bad", "D_STATUS", "lidar: error: no data"),
                                         ("log", "D_LOG", "reporter: no path")):
                peer.ask(word)
                until(module, "active", reason)
                peer.ask("well")
                until(module, "idle")
            peer.ask("abort")
            until("D_OWN", "active", "aborted")
            until("D_GOAL", "active", "a goal aborted")
            peer.ask("succeed")
            until("D_GOAL", "idle")
            peer.process.kill()
            until("D_STATUS", "active", "lidar: no status for 2 s")


# -- without a run ---------------------------------------------------------------------------------


class Side:
    """A relay of the test itself, and what comes from it."""

    def __init__(self, domain, setup=SETUP, distribution="kilted", node="rampart", **more):
        self.lost, self.refused, self.types = [], [], Types(distribution)
        self.side = RelaySide(node, "/", domain, distribution, str(setup),
                              lost=self.lost.append, **more)
        self.node = RosNode(self.side, self.types, node, wall_ns=time.time_ns,
                            refuse=lambda *what: self.refused.append(what), domain=domain)

    def twist(self, speed_mps):
        message = self.types.blank(TWIST)
        message.linear.x = speed_mps
        return self.types.encode(TWIST, message)

    async def until(self, condition, timeout_s=20):
        until_s = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < until_s, (self.lost, self.side.problems)
            await asyncio.sleep(0.02)


async def test_a_command_that_waits_for_a_stopped_relay_is_not_repeated(domain):
    with Peer(PEER, "base") as peer:
        side = Side(domain)
        publish = side.node.publisher("/cmd_vel", TWIST, Qos(depth=10))

        def heard():
            publish(side.twist(1.0))
            return peer.said("heard")

        await side.until(heard)
        relay = psutil.Process(side.side._process.pid)
        relay.suspend()
        await side.until(lambda: relay.status() == psutil.STATUS_STOPPED)
        publish(side.twist(2.0))
        await asyncio.sleep(0.6)
        publish(side.twist(3.0))
        relay.resume()
        await side.until(lambda: 3.0 in peer.said("heard"))
        assert 2.0 not in peer.said("heard")
        side.side.close()


@pytest.fixture
def older(tmp_path):
    """A setup whose rclpy is as before Kilted: a message does not name its publisher."""
    (tmp_path / "sitecustomize.py").write_text("""
from rclpy.subscription import Subscription

init = Subscription.__init__

def older(self, impl, msg_type, topic, callback, *rest, **more):
    init(self, impl, msg_type, topic, lambda message, info: callback(message, {
        key: value for key, value in info.items() if key != "publisher_gid"}), *rest, **more)

Subscription.__init__ = older
""")
    setup = tmp_path / "setup.bash"
    setup.write_text(f". {SETUP}\nexport PYTHONPATH={tmp_path}\n")
    return setup


async def test_publishers_that_an_older_rclpy_does_not_tell_apart_have_no_gid(domain, older):
    side, gids = Side(domain, older), []
    side.node.subscribe("/odom", "nav_msgs/msg/Odometry", Qos(reliable=False, depth=10),
                        lambda _, attachment: gids.append(attachment.gid))
    with Peer(PEER, "base"):
        await side.until(lambda: len(gids) > 5)
        base, = set(gids)
        assert base != UNKNOWN_GID
    with Peer(PEER, "base"):  # a killed node stays in the graph for 20 s; it is the same node
        before = len(gids)
        await side.until(lambda: len(gids) > before + 10 and UNKNOWN_GID not in gids[-10:])
        with Peer(PEER, "rival"):
            await side.until(lambda: gids[-40:] == [UNKNOWN_GID] * 40)
    side.side.close()


@pytest.mark.parametrize("is_older", [False, True])
async def test_a_node_does_not_receive_its_own_messages(domain, older, is_older):
    """A detection on /diagnostics stayed active because of the gateway's report about it."""
    side, got = Side(domain, older if is_older else SETUP), []
    other = Side(domain, node="other")
    publish, publish_too = (one.node.publisher("/cmd_vel", TWIST, Qos(depth=10))
                            for one in (side, other))
    side.node.subscribe("/cmd_vel", TWIST, Qos(depth=10), lambda payload, _: got.append(payload))

    def received():
        publish(side.twist(1.0))
        publish_too(side.twist(2.0))
        return len(got) > 10

    await side.until(received)
    assert set(got) == {side.twist(2.0)}
    side.side.close()
    other.side.close()


async def test_an_environment_of_another_distribution_passes_nothing(domain):
    side = Side(domain, distribution="jazzy")
    side.node._endpoint = lambda *what: type(side.node)._endpoint(side.node, *what)
    side.types._hashes[TWIST] = "RIHS01_" + 64 * "0"
    got = []
    side.node.subscribe("/cmd_vel", TWIST, Qos(depth=10), lambda *_: got.append(1))
    await side.until(lambda: side.side.problems)
    assert "another definition of geometry_msgs/msg/Twist" in side.side.problems[0]
    assert "nothing passes" in side.side.problems[0]
    side.side.close()


def activate(monkeypatch, environment):
    """Activate a virtual environment, as its `bin/activate` does, without a sourced ROS 2."""
    for name in ("AMENT_PREFIX_PATH", "ROS_DISTRO"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("VIRTUAL_ENV", str(environment))
    monkeypatch.setenv("PATH", f"{environment}/bin{os.pathsep}{os.environ['PATH']}")


async def test_a_setup_that_is_not_there_is_refused(domain, monkeypatch):
    with pytest.raises(RelayError, match=r"setup = '/nowhere/setup\.bash': no such file"):
        Side(domain, "/nowhere/setup.bash")
    activate(monkeypatch, "/nowhere")
    with pytest.raises(RelayError, match=(
            r"no ROS 2: no environment is sourced, .* with rclpy is active, .* "
            r"/opt/ros/kilted/setup.bash; source one, or set setup .* of the gateway")):
        Side(domain, "")


# -- verbs -----------------------------------------------------------------------------------------


def test_the_check_finds_the_nodes_on_dds_in_the_active_environment(capsys, monkeypatch, system):
    activate(monkeypatch, SETUP.parent.parent)
    with Peer(PEER, "base") as peer:
        peer.wait_for("up")
        code, found = checked(capsys, system(COUNT, setup=""))
    assert found["relay of gateway"] == (True, "rclpy")
    for what, kind in (("subscribe /odom", "nav_msgs/msg/Odometry"), ("publish /cmd_vel", TWIST),
                       ("call /base/shut", "std_srvs/srv/SetBool"),
                       ("goal /count", "test_msgs/action/Fibonacci")):
        assert found[what] == (True, f"/base, {kind}")
    assert code == 0


def test_the_check_finds_wrong_and_missing_types_and_a_rival(capsys, system):
    with Peer(PEER, "wrong") as wrong, Peer(PEER, "rival") as rival, Peer(PEER, "base") as base:
        for peer in (wrong, rival, base):
            peer.wait_for("up")
        code, found = checked(capsys, system("""
[[ros2]]
publish = "/rampart/pose"
type = "bond/msg/Status"
from = "base/wanted"
fields = { heartbeat_period = "linear_mps" }
"""))
    assert code == 1
    assert "/wrong has the type std_msgs/msg/String" in found["subscribe /odom"][1]
    assert "/rival publishes it too" in found["publish /cmd_vel"][1]
    assert "this ROS 2 has no bond/msg/Status" in found["types"][1]


def test_the_check_without_rclpy_is_one_line_and_exit_code_2(refused, system, tmp_path):
    (tmp_path / "empty.bash").write_text("")
    error = refused("ros2", "check", "--system", system(setup="empty.bash"), "--json")
    assert "No module named 'rclpy'" in error


KILLS = 10
PAUSE_S = 1.0
CAMERA = """
[recovery.parameters]
lifecycle = ["camera"]
ask = ["camera/ask"]
state = ["camera/state:current_state.id"]
change = ["camera/change"]

[[node]]
name = "camera"
command = ["sh", "-c", "exec {python} {peer} camera >> {log}"]
kind = "non-control"
respawn = "R_RESTART"

[[ros2]]
call = "/camera/get_state"
type = "lifecycle_msgs/srv/GetState"
from = "camera/ask"
to = "camera/state"

[[ros2]]
call = "/camera/change_state"
type = "lifecycle_msgs/srv/ChangeState"
from = "camera/change"
to = "camera/changed"
"""


@pytest.mark.slow
def test_a_lifecycle_node_is_active_again_after_each_kill(tmp_path, system):
    log = tmp_path / "log"
    log.touch()

    def active(state="active"):
        told = map(json.loads, log.read_text().splitlines())
        return [one["pid"] for one in told if state in (one.get("state"), *one)]

    path = system()
    parameters, rest = CAMERA.format(python=PYTHON, peer=PEER, log=log).split("\n[[node]]", 1)
    respawn = 'actor = "rampart.actors.recovery.respawn:Respawn"\nkind = "masking"\n'
    path.write_text(path.read_text().replace(
        respawn, respawn.replace("recovery.respawn:Respawn",
                                 "ros2.respawn_lifecycle:RespawnLifecycle")
        + "deadline_s = 15.0\n" + parameters).replace(
            '"driver", "gateway"]', '"driver", "gateway", "camera"]') + f"\n[[node]]{rest}")
    with RealRun(tmp_path, path, "--rate", "1") as run:
        run.wait_until(lambda: active("up"), 30, "it does not run")
        (program,) = active("up")
        for kill in range(KILLS):
            os.kill(program, signal.SIGKILL)
            run.wait_until(lambda kill=kill: len(active()) > kill, 20,
                           f"kill {kill + 1}: it is not active")
            assert len(active()) == kill + 1
            program = active()[-1]
            time.sleep(PAUSE_S)
