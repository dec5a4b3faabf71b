"""A real run beside an implementation of ROS 2 over Zenoh that is not ours."""

import json
import subprocess
import threading

import pytest

from rampart.testing import RealRun, free_port, wait_until
from tests import ROOT
from tests.actors.ros2.test_against_ros import PYTHON, ROS
from tests.actors.ros2.test_gateway import beside_foreign
from tests.real_tools import printed

pytestmark = [pytest.mark.ros, pytest.mark.processes]

PEER = ROOT / "tests/actors/ros2/sdk_peer.py"


class Peer:
    """The other implementation, and what it says."""

    def __init__(self, *command, python=PYTHON):
        self.lines = []
        self.process = subprocess.Popen(
            [python, *command], stdin=subprocess.PIPE, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()

    def _read(self):
        for line in self.process.stdout:
            self.lines.append(json.loads(line))

    def said(self, key):
        return [line[key] for line in self.lines if key in line]

    def wait_for(self, key):
        wait_until(lambda: self.said(key), 30)

    def ask(self, line):
        self.process.stdin.write(f"{line}\n")
        self.process.stdin.flush()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.reader.join()  # before what it reads is closed
        with self.process:
            pass


ROUTER = """
[[node]]
name = "router"
actor = "rampart.actors.ros2.router:RosRouter"
kind = "non-control"
parameters = {{ listen = "tcp/127.0.0.1:{port}" }}
"""

def echoed(run, key, count=1):
    lines = printed(run, "topic", "echo", key, "-n", str(count), "--json", "--duration", "15")
    return [json.loads(line)["message"] for line in lines.splitlines()]


def check_passing(run, peer):
    """Wait until topics pass both ways, and a service is called."""
    run.wait_until(lambda: len(peer.said("heard")) > 10, 30, "no command")
    assert set(peer.said("heard")) <= {0.5}
    run.wait_until(lambda: True in peer.said("shut"), 10, "no request")
    assert {one["linear_mps"] for one in echoed(run, "base/odometry", 20)} == {0.5}
    run.wait_until(lambda: [one["message"] for one in echoed(run, "base/is_shut")] == [
        "by the other implementation"], 10, "no answer")


def test_topics_and_services_both_ways(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    port = free_port()
    path = tmp_path / "guarded.toml"
    path.write_text(beside_foreign(connect=[f"tcp/127.0.0.1:{port}"], distribution="kilted")
                    + ROUTER.format(port=port))
    with RealRun(tmp_path, path) as run:
        with Peer(PEER, str(port), ROS / "share") as peer:
            check_passing(run, peer)
            shown = run.tool("status")
            assert "ros2      linked, 2 nodes, 0 messages refused" in shown.stdout, shown
            told = json.loads(run.tool("status", "--json").stdout)["ros2"]
            assert set(told["nodes"]) == {"/rampart", "/sdk_base"}
