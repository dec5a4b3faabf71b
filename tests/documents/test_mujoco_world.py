"""docs/how-to/mujoco-world.md: its world replaces that of a new robot, and does what it claims."""

import json
import re

import pytest

from tests.documents.page import Page, execute, succeed

PAGE = Page("how-to/mujoco-world")
FILES = re.findall(r"^```\w+\n(?:# |<!-- )(\S+)[^\n]*\n(.*?)^```", PAGE.text,
                   re.DOTALL | re.MULTILINE)

@pytest.fixture
def robot(tmp_path):
    succeed("rampart new courier", tmp_path)
    assert [name for name, _ in FILES] == ["courier/rail.xml", "courier/world.py"]
    for name, text in FILES:
        (tmp_path / "courier" / name).write_text(text, encoding="utf-8")
    return tmp_path / "courier"


def test_the_commands_succeed_and_the_robot_passes_its_own_tests(robot):
    for line in PAGE.of("sh")[0].splitlines():
        printed = succeed(line, robot)
    assert "14 passed" in printed


def test_an_unstable_world_ends_the_run(robot):
    model = robot / "courier/rail.xml"
    text = model.read_text(encoding="utf-8")
    model.write_text(re.sub(r'kv="100" forcerange="[^"]*"', 'kv="-1e9"', text), encoding="utf-8")
    done = execute("rampart run --system courier.toml --virtual --json", robot)
    assert done.returncode == 4
    assert "physics unstable" in json.loads(done.stdout)["reasons"][0]
