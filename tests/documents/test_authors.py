"""Pages of docs/how-to for authors of robots: their examples are run, their tables complete."""

from __future__ import annotations

import asyncio
import json
import re
import tomllib
from pathlib import Path

import msgspec
import pytest

from rampart import testing
from rampart.actors.ftm import topics
from rampart.actors.system.members import load_class
from rampart.testing import VirtualSystem, run
from tests import ROOT, TANK
from tests.documents.page import Page, execute, succeed

TESTING = Page("how-to/testing")
ACTORS = Page("reference/specification").of("python")[0]
EXAMPLES = dict(re.findall(r"^## ([^\n]*)\n(?:(?!^## ).)*?```python\n(.*?)```", TESTING.text,
                           re.DOTALL | re.MULTILINE))
GAUGE = '[[node]]\nname = "gauge"\nactor = "tank_actors:Gauge"\nkind = "non-control"\n\n'


def outcome(folder: Path, *sections: str) -> str:
    """Return what pytest says of the examples of some sections, in a folder with the tank."""
    (folder / "tank_actors.py").write_text(ACTORS)
    system = TANK.replace("rampart.actors.detection.stub:StubDetection",
                          "tank_actors:LevelTooHigh")
    (folder / "tank.toml").write_text(system.replace("[[node]]", GAUGE + "[[node]]", 1))
    (folder / "test_tank.py").write_text("\n\n".join(EXAMPLES[name] for name in sections))
    (folder / "pytest.ini").write_text("[pytest]\n")
    return succeed("python -m pytest -q -p no:cacheprovider", folder).splitlines()[-1]


def test_what_runs_in_virtual_time(tmp_path):
    assert outcome(tmp_path, "Actors in virtual time", "Faults", "Detection as a timeline"
                  ).startswith("8 passed")


@pytest.mark.processes
def test_what_runs_on_processes(tmp_path):
    assert outcome(tmp_path, "Real runs").startswith("1 passed")


def test_everything_there_is_has_its_place():
    assert [name for name in testing.__all__ if f"`{name}`" not in TESTING.text
            and name not in {"Heard", "HEEDS_SIGNALS", "turns"}] == []


MUJOCO = Page("how-to/mujoco-world")
FILES = re.findall(r"^```\w+\n(?:# |<!-- )(\S+)[^\n]*\n(.*?)^```", MUJOCO.text,
                   re.DOTALL | re.MULTILINE)

@pytest.fixture
def robot(tmp_path):
    succeed("rampart new courier", tmp_path)
    assert [name for name, _ in FILES] == ["courier/rail.xml", "courier/world.py"]
    for name, text in FILES:
        (tmp_path / "courier" / name).write_text(text, encoding="utf-8")
    return tmp_path / "courier"


def test_the_commands_succeed_and_the_robot_passes_its_own_tests(robot):
    for line in MUJOCO.of("sh")[0].splitlines():
        printed = succeed(line, robot)
    assert "14 passed" in printed


def test_an_unstable_world_ends_the_run(robot):
    model = robot / "courier/rail.xml"
    text = model.read_text(encoding="utf-8")
    model.write_text(re.sub(r'kv="100" forcerange="[^"]*"', 'kv="-1e9"', text), encoding="utf-8")
    done = execute("rampart run --system courier.toml --virtual --json", robot)
    assert done.returncode == 4
    assert "physics unstable" in json.loads(done.stdout)["reasons"][0]


MODULES = Page("how-to/ready-modules")
ROWS = re.findall(r"^\| `(\w+):(\w+)` \| (.*) \|$", MODULES.text, re.MULTILINE)


def test_the_check_points_are_supervised_in_their_order():
    (row,) = tomllib.loads(MODULES.block("toml", "[[detection]]"))["detection"]
    chosen = msgspec.convert(row["parameters"], load_class(row["actor"]).Parameters)
    assert chosen.each
    assert [step.at for step in chosen.steps] == ["measured", "checked", "commanded"]


def test_the_system_detects_and_shuts_the_inlet(tmp_path, monkeypatch):
    (tmp_path / "tank.py").write_text(MODULES.block("python"))
    (tmp_path / "tank.toml").write_text(MODULES.block("toml", "name = "))
    monkeypatch.syspath_prepend(tmp_path)

    async def scenario() -> None:
        async with VirtualSystem.load(tmp_path / "tank.toml") as system:
            states = system.hear(topics.RECOVERY)
            reports = system.hear(topics.DETECTION)
            valve = system.hear(system.layout.topics["tank/valve"])
            for name in system.layout.members:
                if name not in {"supervisor", "observer"}:
                    system.start_node(name)
            await asyncio.sleep(60.0)
            assert {heard.message.state.value for heard in reports
                    if heard.header.source != "D_PUMP"} == {"idle"}
            first_s = min(heard.time_s for heard in reports if heard.message.state == "active")
            assert first_s == pytest.approx(20 + 10, abs=0.5)  # filling, and busy for ever
            assert any(heard.message.phase.value == "degraded" for heard in states)
            assert valve[-1].message.shut
            await asyncio.sleep(50.0)
            assert any(heard.header.source == "D_LEVEL" and heard.message.state == "active"
                       for heard in reports)

    run(scenario)


@pytest.mark.parametrize(("module", "name", "said"), ROWS, ids=[row[1] for row in ROWS])
def test_the_table_has_the_parameters_there_are(module, name, said):
    room = "detection" if (ROOT / "actors" / "detection" / f"{module}.py").is_file() else "recovery"
    actor = load_class(f"rampart.actors.{room}.{module}:{name}")
    known = {field.name for field in msgspec.structs.fields(actor.Parameters)}
    assert set(re.findall(r"`([a-z_]+)`", said)) <= known
