"""Bytes, hashes and a run beside those that ROS 2 itself makes, and others (`make ros-wheels`)."""

import json
import os
import subprocess
import threading
from pathlib import Path

import numpy as np
import pytest

from rampart.actors.ros2.translation.types import Types
from rampart.testing import RealRun, free_port, wait_until
from tests import ROOT
from tests.actors.ros2.test_gateway import beside_foreign
from tests.real_tools import printed

pytestmark = pytest.mark.ros

ROS = ROOT / ".venv-ros"
PYTHON = ROS / "bin/python"
ORACLE = Path(__file__).with_name("ros_oracle.py")
PARTS = ["std_srvs/srv/SetBool_Request", "std_srvs/srv/SetBool_Response",
         "std_srvs/srv/Trigger_Response", "lifecycle_msgs/srv/ChangeState_Request",
         "lifecycle_msgs/srv/ChangeState_Response", "action_msgs/srv/CancelGoal_Request",
         "action_msgs/srv/CancelGoal_Response"]
KILTED = Types("kilted")


def asked(*arguments):
    done = subprocess.run([PYTHON, ORACLE, *arguments], capture_output=True, text=True,
                          check=False, timeout=120, env={**os.environ, "PYTHONPATH": ""})
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def values(ours):
    """Return the fields of a message of ours as the oracle writes them."""
    if hasattr(ours, "__dataclass_fields__"):
        return {name: values(getattr(ours, name)) for name, field in
                ours.__dataclass_fields__.items() if not field.type.startswith("ClassVar")
                and name != "structure_needs_at_least_one_member"}
    if isinstance(ours, np.ndarray):
        ours = ours.tolist()
    if isinstance(ours, list):
        return [values(one) for one in ours]
    return repr(ours) if isinstance(ours, float) else ours


def without_padding(name, message, data, types):
    """Return the bytes of a message without those between its fields, which ROS 2 leaves as is."""
    definition = types._store.get_msgdef(name)
    size = definition.getsize_cdr(0, message, types._store)
    both = []
    for filling in (0, 255):
        both.append(memoryview(bytearray([filling] * size)))
        definition.serialize_cdr_le(both[-1], 0, message, types._store)
    kept = [True] * 4 + [zero == one for zero, one in zip(*both, strict=True)]
    return bytes(byte for byte, is_kept in zip(data, kept, strict=False) if is_kept)


@pytest.mark.parametrize("each", [5, pytest.param(100, marks=pytest.mark.nightly)])
def test_random_messages_of_every_type_are_read_and_written_as_ros_2_does(each):
    folder = (ROS / "share").resolve()
    types = Types("kilted", [folder])
    names = [*PARTS, *sorted(name for name in (f"{file.parts[-3]}/msg/{file.stem}"
                                               for file in folder.glob("*/msg/*.msg"))
                             if name not in types.left_out)]
    tails, count = {0}, 0
    for name, fields, theirs in map(json.loads, asked(str(each), *names)):
        data = bytes.fromhex(theirs)
        message = types.decode(name, data)
        assert values(message) == fields, name
        ours = types.encode(name, message)
        assert without_padding(name, message, ours, types) == without_padding(
            name, message, data[:len(ours)], types), name
        tails.add(len(data) - len(ours))  # that ROS 2 leaves
        count += 1
    assert count == each * len(names)
    assert max(tails) > 3


NOT_HERE = {"test_msgs/msg/WStrings",  # left out, and these are in IDL alone
            "test_msgs/msg/ComplexNestedKey", "test_msgs/msg/KeyedLong",
            "test_msgs/msg/KeyedString", "test_msgs/msg/NonKeyedWithNestedKey"}


def test_all_hashes_are_the_official_ones():
    official = {}
    for file in ROS.glob("share/*/*/*.json"):
        for one in json.loads(file.read_text()).get("type_hashes", ()):
            official[one["type_name"]] = one["hash_string"]
    folder = Types("kilted", [(ROS / "share").resolve()])
    for types, most in ((KILTED, 170), (folder, 290)):
        there = official.keys() & types.known
        assert {name: types.hash(name) for name in there} == {
            name: official[name] for name in there}
        assert len(there) > most
    assert official.keys() - folder.known == NOT_HERE


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


@pytest.mark.processes
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
