"""docs/how-to/mujoco-world.md: its world replaces that of a new robot, and does what it claims."""

from __future__ import annotations

import json
import re

import pytest

from tests.documents.page import Page, execute, succeed

PAGE = Page("how-to/mujoco-world")
FILES = re.findall(r"^```\w+\n(?:# |<!-- )(\S+)[^\n]*\n(.*?)^```", PAGE.text,
                   re.DOTALL | re.MULTILINE)
BEHAVIOUR = '''
import asyncio
from pathlib import Path

from courier import topics
from courier.topics import Brake, Speed
from rampart.testing import VirtualSystem, run

SYSTEM = Path(__file__).resolve().parents[1] / "courier.toml"


async def drive(system, seconds):
    for _ in range(round(seconds / 0.05)):
        system.say(topics.DRIVE, Speed(1.0), source="driver")
        await asyncio.sleep(0.05)


def test_the_world():
    async def scenario():
        async with VirtualSystem.load(SYSTEM) as system:
            states = system.hear(topics.STATE)
            system.start_node("world")
            await system.settle()
            await drive(system, 2.0)
            assert abs(states[-1].message.speed_mps - 1.0) < 0.1
            assert 5.5 < states[-1].message.position_m < 7.5
            await asyncio.sleep(1.2)
            assert abs(states[-1].message.speed_mps) < 0.01
            await drive(system, 1.0)
            assert states[-1].message.speed_mps > 0.5
            system.say(topics.BRAKE, Brake(True), source="R_BRAKE")
            await drive(system, 1.0)
            assert states[-1].message.braked
            assert abs(states[-1].message.speed_mps) < 0.01

    run(scenario)
'''


@pytest.fixture
def robot(tmp_path):
    succeed("rampart new courier", tmp_path)
    assert [name for name, _ in FILES] == ["courier/rail.xml", "courier/world.py"]
    for name, text in FILES:
        (tmp_path / "courier" / name).write_text(text, encoding="utf-8")
    return tmp_path / "courier"


def test_the_commands_succeed_and_actuators_obey(robot):
    (robot / "tests/test_world.py").write_text(BEHAVIOUR, encoding="utf-8")
    for line in PAGE.of("sh")[0].splitlines():
        printed = succeed(line, robot)
    assert "15 passed" in printed


def test_an_unstable_world_ends_the_run(robot):
    model = robot / "courier/rail.xml"
    text = model.read_text(encoding="utf-8")
    model.write_text(re.sub(r'kv="100" forcerange="[^"]*"', 'kv="-1e9"', text), encoding="utf-8")
    done = execute("rampart run --system courier.toml --virtual --json", robot)
    assert done.returncode == 4
    assert "physics unstable" in json.loads(done.stdout)["reasons"][0]
