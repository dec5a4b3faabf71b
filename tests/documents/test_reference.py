"""Pages of docs/reference: what they list is there, and what is there is listed."""

from __future__ import annotations

import importlib
import json
import math
import re
import subprocess
import sys

import msgspec
import pytest

import rampart
import rampart.testing
from rampart.actors.ros2.stand_in import StandIn
from rampart.actors.ros2.translation.tables import Ros2Link
from rampart.actors.system.members import load_class
from rampart.cli.main import main
from rampart.manager.spec.hosts import HostSpec, Link
from rampart.manager.spec.schema import (
    BlackBox,
    DetectionSpec,
    EventSpec,
    FaultSpec,
    Layers,
    MechanismSpec,
    NodeSpec,
    RecoverySpec,
    Robot,
    Supervision,
    SystemSpec,
    Timing,
)
from rampart.manager.spec.specification import parse_specification
from rampart.manager.spec.tables import End
from rampart.testing import virtual_run
from tests import ROOT, TANK
from tests.documents.page import Page

PAGE = Page("reference/specification")
MODULES, JUDGE = PAGE.of("python")
JUDGED = PAGE.of("toml")[1]
OWN = TANK.replace("rampart.actors.runtime.stub_node:StubNode", "tank_actors:Gauge").replace(
    "rampart.actors.detection.stub:StubDetection", "tank_actors:LevelTooHigh")


def toml(value: object) -> str:
    """A default as the document writes it; "" if it has no value, is derived, or a table."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return "" if math.isnan(value) else f"{value:g}"
    if isinstance(value, str):
        return json.dumps(value)
    if value is None or isinstance(value, msgspec.Struct):
        return ""
    return "{}" if value == {} else "[]"


@pytest.mark.parametrize(("heading", "tables"), [
    ("Top level", (SystemSpec,)), ("`[end]`", (End,)), ("`[robot]`", (Robot,)),
    ("`[timing]`", (Timing,)), ("`[layers]`", (Layers,)), ("`[supervision]`", (Supervision,)),
    ("`[black_box]`", (BlackBox,)),
    ("`[[host]]` and `[link]` (optional)", (HostSpec, Link)), ("`[[node]]`", (NodeSpec,)),
    ("`[[detection]]`", (DetectionSpec,)), ("`[[recovery]]`", (RecoverySpec,)),
    ("`[[mechanism]]`", (MechanismSpec,)), ("`[[event]]`", (EventSpec,)),
    ("`[[fault]]`", (FaultSpec,)), ("`[[ros2]]`", (Ros2Link,))])
def test_the_table_has_every_field_with_its_default(heading, tables):
    rows = {name: default
            for names, default in re.findall(r"^\| (`\w+`(?:, `\w+`)*) \| ([^|]+) \| ",
                                             PAGE.section(f"### {heading}").partition("\n## ")[0],
                                             re.MULTILINE)
            for name in re.findall(r"\w+", names)}
    fields = {f.encode_name: f for table in tables for f in msgspec.structs.fields(table)}
    assert rows.keys() == fields.keys()
    for name, field in fields.items():
        if field.required:
            assert rows[name] == "required", name
            continue
        default = field.default_factory() if field.default is msgspec.NODEFAULT else field.default
        written = toml(default)
        if tables == (SystemSpec,) and isinstance(default, tuple | dict):  # tables
            written = ""
        assert rows[name] == f"`{written}`" if written else "`" not in rows[name], name


def test_the_worked_example_is_a_sound_system(tmp_path, capsys):
    spec = parse_specification(TANK, "tank.toml")
    assert spec.build_ftm_tree().parents == {"M_LEVEL": None, "M_CRASH": "M_LEVEL"}
    (tmp_path / "tank.toml").write_text(TANK, encoding="utf-8")
    assert main(["table", "--system", str(tmp_path / "tank.toml"), "--json"]) == 0
    assert [row["rm"] for row in json.loads(capsys.readouterr().out)] == [
        ["R_SHUT"], ["R_RESTART"], ["R_SHUT", "R_RESTART"]]


@pytest.mark.parametrize(("brim_m", "safe", "margin_m", "why"), [
    (1.5, True, 0.3, "its time is over"), (1.0, False, -0.2, "the tank runs over")])
def test_the_judge_that_it_shows_judges(tmp_path, brim_m, safe, margin_m, why):
    for file, text in (("tank_actors.py", MODULES), ("tank_judge.py", JUDGE),
                       ("tank.toml", OWN + JUDGED.replace("1.5", str(brim_m)))):
        (tmp_path / file).write_text(text, encoding="utf-8")
    done = virtual_run(tmp_path / "tank.toml")
    assert done.failures == ()
    assert done.why == why
    assert done.judgement.safe is done.judgement.success is safe
    assert done.judgement.margins == {"brim": pytest.approx(margin_m)}
    assert (done.record.duration_s > 599) == safe


ROS2 = Page("reference/ros2")
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
    listed = listed_in(ROS2.section(f"## {heading}"), "| parameter |")
    known = {field.name for field in msgspec.structs.fields(load_class(path).Parameters)}
    assert listed == known - FILLED_IN


def test_a_stand_in_has_the_members_that_the_page_lists():
    names = listed_in(ROS2.text, "| member |")
    assert len(names) >= 6
    for name in names - {"types"}:  # of each object
        assert hasattr(StandIn, name), name


API = Page("reference/api")
NAMES = re.findall(r"^\| `(\w+)` \| `(rampart\.[\w.]+)` \|", API.text, re.MULTILINE)
CLASSES = re.findall(r"^\| `(rampart\.[\w.]+:\w+)` \|", API.text, re.MULTILINE)


@pytest.mark.parametrize(("name", "module"), NAMES)
def test_a_name_is_imported_from_rampart_itself(name, module):
    assert getattr(rampart, name) is getattr(importlib.import_module(module), name)


def test_the_page_lists_what_rampart_exports():
    assert sorted(name for name, _ in NAMES) == sorted(rampart.__all__) == dir(rampart)
    with pytest.raises(AttributeError, match="module 'rampart' has no attribute 'nonsense'"):
        _ = rampart.nonsense


def test_to_import_rampart_costs_nothing():
    done = subprocess.run(
        [sys.executable, "-c", "import rampart, sys; print(*sys.modules)"], cwd=ROOT, check=True,
        capture_output=True, text=True)
    assert not {"numpy", "zenoh", "msgspec", "asyncio"} & set(done.stdout.split())


@pytest.mark.parametrize("path", CLASSES)
def test_a_class_for_specifications_can_be_loaded(path):
    assert load_class(path).__name__ == path.partition(":")[2]


def test_every_name_for_tests_is_listed():
    rows = re.findall(r"^\| (`.*?) \|", API.section("## Tests"), re.MULTILINE)
    listed = re.findall(r"`(\w+)`", "".join(rows))
    assert set(listed) == set(rampart.testing.__all__)
