"""A stored result stands for a run only while all that went into the run is the same."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import msgspec
import pytest

from rampart.cli.main import main as rampart
from rampart.sim.campaign import content, job
from rampart.sim.campaign.content import content_of
from rampart.sim.campaign.job import Job
from rampart.systems import SHIPPED

TIMES = ("heartbeat", "command", "localization", "scan", "dead_man", "manager",
         "detection_silence")
SPEC = 'name = "tank"\ntitle = "A tank"\n[timing]\n' + "".join(
    f"{name}_timeout_s = 1.0\n" for name in TIMES) + """
[layers]
ftm = false
[end]
after_s = 3.0
[orders.safer]
[[event]]
name = "overflow"
[[node]]
name = "pump"
actor = "tank_parts.pump:Pump"
kind = "control"
parameters = { curve = "curve.csv" }
"""
PUMP = """
from rampart import Actor, Message, Qos, Topic, every
from .limits import MOST_M

class Level(Message):
    level_m: float

LEVEL = Topic("tank/level", Level, Qos.SENSOR, 10, "", "Level.")

class Pump(Actor):
    class Parameters(Actor.Parameters, frozen=True):
        curve: str = ""

    outputs = (LEVEL,)

    @every(0.1)
    def say(self) -> None:
        self.publish(LEVEL, Level(MOST_M))
"""
FILES = {"tank.toml": SPEC, "curve.csv": "1,2\n", "tank_parts/pump.py": PUMP,
         "tank_parts/limits.py": "import json\nMOST_M = 2.0\n", "tank_parts/__init__.py": "",
         "notes.txt": "nothing", "tank_parts/unused.py": "X = 1\n",
         "scene.xml": "<mujoco/>", "meshes/tank.stl": "solid", "tank_parts/tank.xml": "<mujoco/>",
         "tank_parts/tables/flow.bin": "1", "tank_parts/.cache/old.bin": "1",
         "reports/run/old.xml": "1", "mine/runs.sqlite": "", "mine/shrunk.xml": "1"}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    yield tmp_path
    for name in [name for name in sys.modules if name.startswith("tank_parts")]:
        del sys.modules[name]


def digest(folder: Path) -> str:
    for cached in (job.read_document_of, job._application, content._engine):
        cached.cache_clear()
    importlib.invalidate_caches()
    return content_of(Job(row="", system=str(folder / "tank.toml")))


@pytest.mark.parametrize(("name", "counts"), [
    ("tank.toml", True), ("curve.csv", True), ("notes.txt", False), ("tank_parts/limits.py", True),
    ("tank_parts/unused.py", True), ("meshes/tank.stl", True), ("tank_parts/tables/flow.bin", True),
    ("tank_parts/.cache/old.bin", False), ("reports/run/old.xml", False),
    ("mine/shrunk.xml", False)])
def test_what_goes_into_a_run_is_part_of_its_key(folder, name, counts):
    before = digest(folder)
    assert digest(folder) == before
    (folder / name).write_text(SPEC.replace("after_s = 3.0", "after_s = 4.0")
                               if name == "tank.toml" else FILES[name] + "\n# 3\n")
    assert (digest(folder) != before) is counts
    (folder / name).write_text(FILES[name])
    assert digest(folder) == before


def test_two_files_that_swap_their_names_change_the_key(folder):
    (folder / "meshes/other.stl").write_text("liquid")
    before = digest(folder)
    (folder / "meshes/other.stl").write_text(FILES["meshes/tank.stl"])
    (folder / "meshes/tank.stl").write_text("liquid")
    assert digest(folder) != before


def test_the_engine_is_part_of_it(folder, monkeypatch):
    before = digest(folder)
    monkeypatch.setattr(content, "version", lambda _name: "99.0")
    assert digest(folder) != before


def test_the_files_of_the_application_are_part_of_it(tmp_path):
    airport = tmp_path / "mine.toml"
    shipped = (SHIPPED / "airports" / "vallombre.toml").read_text()
    airport.write_text(shipped)
    one = Job(row="", system="paper", options={"airport": str(airport)})
    before = content_of(one)
    airport.write_text(shipped + "# more\n")
    assert content_of(one) != before
    assert content_of(msgspec.structs.replace(one, options={})) != before


def test_an_edited_file_makes_its_runs_anew(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)

    def made() -> str:
        digest(folder)  # another process begins without a cache
        assert rampart(["campaign", "--system", "tank.toml", "--fault", "kill:pump@1", "--jobs",
                        "1", "--out", "out"]) == 0
        return next(line for line in capsys.readouterr().out.splitlines() if "made now" in line)

    assert [made(), made()] == ["1 runs, 1 of them made now", "1 runs, 0 of them made now"]
    (folder / "tank.toml").write_text("# a comment\n" + SPEC)
    assert made() == "1 runs, 0 of them made now"
    (folder / "tank_parts/limits.py").write_text("MOST_M = 3.0\n")
    assert made() == "1 runs, 1 of them made now"
