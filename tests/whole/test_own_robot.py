"""A robot of one's own: what `launch.py` says of its modules, and of what it has not."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from rampart.testing import free_base_port
from tests import ROOT, TANK

PAPER = (ROOT / "systems" / "paper.toml").read_text(encoding="utf-8")
WORLD = ('[[node]]\nname = "simulator"\nactor = "rampart.sim.osmosis.simulator:Simulator"\n'
         'kind = "world"\n'
         'respawn = "supervisor"\n')


def changed(text: str, *changes: tuple[str, str]) -> str:
    """Return a spec with some text replaced, each of which has to be there once."""
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    return text


def launched(directory: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run `launch.py` in a directory, and find nothing there but what it brings."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    return subprocess.run(
        [sys.executable, str(ROOT / "launch.py"), *arguments], cwd=directory, env=environment,
        capture_output=True, text=True, check=False, timeout=120)


def test_without_ground_truth_safety_is_not_known_in_console_json_page_and_exit_code(tmp_path):
    (tmp_path / "blind.toml").write_text(changed(PAPER, (WORLD, "")))
    done = launched(tmp_path, "--system", "blind.toml", "--virtual", "--patience", "3", "--json",
                    "--report", str(tmp_path / "report"))
    assert done.returncode == 4, done.stderr
    assert "fail, not known" in done.stderr
    assert "safe by" not in done.stderr
    result = json.loads(done.stdout.splitlines()[-1])
    assert (result["mission"], result["safety"]) == ("fail", "not known")
    assert any("no ground truth was received" in reason for reason in result["reasons"])
    assert json.loads(Path(result["record"]).read_text())["safety"] == "not known"
    page = Path(result["report"]).read_text()
    assert '<div class="verdict unknown">Safety<b>not known</b></div>' in page
    assert "stayed safe" not in page
    assert "4 safety not known" in launched(tmp_path, "--help").stdout


PLAIN = """
from rampart.actors.detection.module import DetectionModule

class Level(DetectionModule):
"""
DECLARED = f"""{PLAIN}
    class Parameters(DetectionModule.Parameters, frozen=True):
        highest_m: float = 2.0
"""
BROKEN = {
    "raises": ("import os\n\nraise RuntimeError('no hardware')\n", "",
               "RuntimeError: no hardware (HERE/own.py, line 3)"),
    "wrong type": (DECLARED, 'highest_m = "x"', "parameters.highest_m = 'x': expected a number"),
    "no struct": (f"{PLAIN}    class Parameters:\n        highest_m = 2.0\n", "highest_m = 1",
                  "actor = 'own:Level': Parameters: "),
    "no such type": (f"{PLAIN}    class Parameters(DetectionModule.Parameters, frozen=True):\n"
                     "        highest_m: 'Metres' = 2.0\n", "highest_m = 1",
                     "actor = 'own:Level': Parameters: name 'Metres' is not defined"),
}


@pytest.mark.parametrize("what", BROKEN)
def test_an_actor_of_one_s_own_that_is_broken_is_one_line_before_anything_starts(
        tmp_path, monkeypatch, refused, what):
    source, parameters, words = BROKEN[what]
    (tmp_path / "own.py").write_text(source)
    bounds = 'actor = "rampart.actors.osmosis.detection.bounds:Bounds"\n'
    (tmp_path / "own.toml").write_text(changed(
        PAPER, (bounds, f'actor = "own:Level"\nparameters = {{ {parameters} }}\n')))
    monkeypatch.chdir(tmp_path)
    how = "--virtual" if what == "raises" else "--fault=drop:localization/pose"
    told = refused("run", "--system", "own.toml", how, "--no-hmi", "--report", "report")
    assert "own.toml: detection DM3: " in told
    assert words.replace("HERE", str(tmp_path)) in told
    assert not (tmp_path / "report").exists()


OWN_ACTOR = '''
from rampart.actors.runtime.actor import every
from rampart.actors.runtime.stub_node import StubNode

class Own(StubNode):
    @every(0.5)
    def fail(self):
        {}["speed_mps"]
'''


def test_actors_beside_the_caller_are_found_in_virtual_time_and_tell_where_they_failed(tmp_path):
    (tmp_path / "own.py").write_text(OWN_ACTOR)
    (tmp_path / "own.toml").write_text(changed(
        PAPER, (WORLD, '[[node]]\nname = "own"\nactor = "own:Own"\nkind = "non-control"\n')))
    report = tmp_path / "report"
    done = launched(tmp_path, "--system", "own.toml", "--virtual", "--patience", "2", "--report",
                    str(report))
    assert done.returncode == 4, done.stderr
    assert f"launch.py: tracebacks of failed processes: {report / 'errors.log'}" in done.stderr
    assert "own failed: KeyError: 'speed_mps'" in done.stderr
    assert f'File "{tmp_path}/own.py", line 8, in fail' in (report / "errors.log").read_text()


@pytest.mark.processes
def test_actors_beside_the_caller_are_found_by_toolbox_and_run_which_tells_of_tracebacks(tmp_path):
    (tmp_path / "own.py").write_text(OWN_ACTOR)
    (tmp_path / "own.toml").write_text(
        changed(TANK, ("rampart.actors.runtime.stub_node:StubNode", "own:Own")))
    done = subprocess.run(
        [str(Path(sys.executable).with_name("rampart")), "topic", "list", "--system",
         "own.toml"], cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    report = tmp_path / "report"
    done = launched(tmp_path, "--system", "own.toml", "--duration", "1", "--port",
                    str(free_base_port()), "--report", str(report))
    assert f"launch.py: tracebacks of failed processes: {report / 'errors.log'}" in done.stderr
    assert f'File "{tmp_path}/own.py", line 8, in fail' in (report / "errors.log").read_text()
