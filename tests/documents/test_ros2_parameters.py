"""docs/reference/ros2.md: its tables have the parameters that the classes have."""

from __future__ import annotations

import re

import msgspec
import pytest

from rampart.actors.ros2.stand_in import StandIn
from rampart.actors.system.members import load_class
from tests.documents.page import Page

PAGE = Page("reference/ros2")
FILLED_IN = {"ros2"}  # by the gateway itself


def listed_in(text: str, header: str) -> set[str]:
    """Return the names in the first column of the table with a header."""
    table = text.partition(header)[2].partition("\n\n")[0]
    return {name for row in re.findall(r"^\| (`.*?) \|", table, re.MULTILINE)
            for name in re.findall(r"`(\w+)", row)}


@pytest.mark.parametrize(("heading", "path"), [
    ("The gateway's parameters", "rampart.actors.ros2.gateway:Gateway"),
    ("The router", "rampart.actors.ros2.router:RosRouter"),
    ("Stand-ins", "rampart.actors.ros2.stand_in:StandIn"),
    ("Missing nodes", "rampart.actors.ros2.ros_nodes:RosNodes")])
def test_the_table_has_each_parameter(heading, path):
    listed = listed_in(PAGE.section(f"## {heading}"), "| parameter |")
    known = {field.name for field in msgspec.structs.fields(load_class(path).Parameters)}
    assert listed == known - FILLED_IN


def test_a_stand_in_has_the_members_that_the_page_lists():
    names = listed_in(PAGE.text, "| member |")
    assert len(names) >= 6
    for name in names - {"types"}:  # of each object
        assert hasattr(StandIn, name), name
