"""Pages of docs/how-to for authors of robots: their examples are run, their tables complete."""

from __future__ import annotations

import asyncio
import json
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import msgspec
import pytest

from rampart import testing
from rampart.actors.ftm import topics
from rampart.actors.system.members import load_class
from rampart.testing import RealRun, VirtualSystem, run
from tests import ROOT, TANK
from tests.actors.access.keyed import layout_of, make_keys
from tests.documents.page import Page, execute, succeed
from tests.real_tools import printed

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


LANGUAGES = Page("how-to/any-language")
TUG = LANGUAGES.block("toml", 'name = "tug"')
COMPILERS = {"c++": ["g++", "-x", "c++", "-Wall", "-Wextra", "-Werror"],
             "rust": ["rustc", "-Dwarnings"]}


def write_tug(folder, language: str = "") -> None:
    """Write the system of the page into a folder, with the wheels in a language."""
    (folder / "tug.toml").write_text(TUG)
    (folder / "cart.py").write_text(LANGUAGES.block("python", "from rampart"))
    if language == "bash":
        (folder / "wheels").write_text(LANGUAGES.block("bash"))
        (folder / "wheels").chmod(0o755)
    elif language:
        source = "wheels.rs" if language == "rust" else "wheels.c"
        (folder / source).write_text(LANGUAGES.block(language.removesuffix("++")))
        if language == "c++":  # the same file is C, too
            subprocess.run(["gcc", "-Wall", "-Wextra", "-Werror", "-fsyntax-only", source],
                           cwd=folder, check=True)
        subprocess.run([*COMPILERS[language], "-o", "wheels", source], cwd=folder, check=True)


def test_the_stand_in_plays_the_command_in_virtual_time(tmp_path, monkeypatch):
    write_tug(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)

    async def scenario():
        async with VirtualSystem.load(tmp_path / "tug.toml") as system:
            driver = system.start_node("driver")
            system.start_node("wheels")
            await asyncio.sleep(1.0)
            return msgspec.structs.astuple(driver.seen)

    assert run(scenario) == (5.0, 5.0)


@pytest.mark.processes
@pytest.mark.parametrize("language", ["c++", "rust", "bash"])
def test_the_program_is_a_node_and_faults_can_be_put_into_its_messages(tmp_path, language):
    if language in COMPILERS and not shutil.which(COMPILERS[language][0]):
        pytest.skip(f"no {COMPILERS[language][0]}")
    write_tug(tmp_path, language)
    with RealRun(tmp_path, "tug.toml") as tug:
        tug.sleep_until(1)
        assert heard(tug) == [5.0, 5.0]
        done = tug.tool("inject", "drop:tug/wheels", "--duration", "1", "--json")
        assert done.returncode == 0, done.stderr
        (disturbed,) = msgspec.json.decode(done.stdout)["injections"]
        assert disturbed["nodes"] == ["wheels"]
        assert disturbed["affected"] > 0


@pytest.mark.processes
@pytest.mark.parametrize("with_keys", [False, True])
def test_the_plain_zenoh_program_is_a_node(tmp_path, monkeypatch, with_keys):
    write_tug(tmp_path)
    (tmp_path / "wheels.py").write_text(LANGUAGES.block("python", "import json"))
    (tmp_path / "tug.toml").write_text(TUG.replace(
        '["./wheels"]', f'[{json.dumps(sys.executable)}, "wheels.py"]').replace(
        'topic = "tug/wheels"', 'key = "wheels/alive"'))
    monkeypatch.syspath_prepend(tmp_path)  # for its driver, when keys are made for it
    more = ("--keys", str(make_keys(tmp_path / "keys", layout_of(str(tmp_path / "tug.toml"))))
            ) if with_keys else ()
    with RealRun(tmp_path, "tug.toml", *more) as tug:
        tug.sleep_until(3)
        assert heard(tug) == [5.0, 5.0]
        assert [n["state"] for n in nodes(tug) if n["name"] == "wheels"] == ["running"]


def heard(tug: RealRun) -> list[float]:
    """Return what a stranger hears of the wheels."""
    done = tug.tool("topic", "echo", "tug/wheels", "-n", "1", "--duration", "10", "--json")
    said = msgspec.json.decode(done.stdout.splitlines()[-1])
    return list(said["message"].values())


def nodes(tug: RealRun) -> list[dict]:
    return msgspec.json.decode(printed(tug, "node", "list", "--json"))
