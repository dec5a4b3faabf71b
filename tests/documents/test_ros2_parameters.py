"""docs/reference/ros2.md: its tables have the parameters that the classes have."""

from __future__ import annotations

import re

import msgspec
import pytest

from rampart.actors.ros2.stand_in import StandIn
from rampart.actors.system.members import load_class
from tests import ROOT

TEXT = (ROOT / "docs/reference/ros2.md").read_text(encoding="utf-8")
FILLED_IN = {"ros2"}  # by the gateway itself


@pytest.mark.parametrize(("heading", "path"), [
    ("The gateway's parameters", "rampart.actors.ros2.gateway:Gateway"),
    ("The router", "rampart.actors.ros2.router:RosRouter"),
    ("Stand-ins", "rampart.actors.ros2.stand_in:StandIn"),
    ("Missing nodes", "rampart.actors.ros2.ros_nodes:RosNodes")])
def test_the_table_has_each_parameter(heading, path):
    section = TEXT.partition(f"## {heading}\n")[2].partition("\n## ")[0]
    table = section.partition("| parameter |")[2].partition("\n\n")[0]
    listed = {name for row in re.findall(r"^\| (`.*?) \|", table, re.MULTILINE)
              for name in re.findall(r"`(\w+)`", row)}
    known = {field.name for field in msgspec.structs.fields(load_class(path).Parameters)}
    assert listed == known - FILLED_IN


def test_a_stand_in_has_the_members_that_the_page_lists():
    table = TEXT.partition("| member |")[2].partition("\n\n")[0]
    names = {name for row in re.findall(r"^\| (`.*?) \|", table, re.MULTILINE)
             for name in re.findall(r"`(\w+)", row)}
    assert len(names) >= 6
    for name in names - {"types"}:  # of each object
        assert hasattr(StandIn, name), name
