"""A robot of one's own: what `launch.py` says of its modules, and of what it has not."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from rampart.testing import free_base_port
from tests import ROOT

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


def application_of(text: str) -> str:
    """Return the table `[application]` of a spec."""
    return text[text.index("[application]"):text.index("\n\n", text.index("[application]"))]


TANK = (ROOT / "docs/reference/specification.md").read_text(
    encoding="utf-8").split("```toml\n")[1].split("```")[0]
PORTER = changed(PAPER, (application_of(PAPER), ""), (WORLD, ""))


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
    assert any("no ground truth ever came" in reason for reason in result["reasons"])
    assert json.loads(Path(result["record"]).read_text())["safety"] == "not known"
    page = Path(result["report"]).read_text()
    assert '<div class="verdict unknown">Safety<b>not known</b></div>' in page
    assert "stayed safe" not in page
    assert "4 safety not known" in launched(tmp_path, "--help").stdout


def test_a_robot_without_airport_and_mission_runs_until_its_time_is_over(tmp_path):
    (tmp_path / "porter.toml").write_text(PORTER)
    done = launched(tmp_path, "--system", "porter.toml", "--duration", "6", "--rate", "4",
                    "--no-hmi", "--json", "--port", str(free_base_port()), "--report",
                    str(tmp_path / "report"))
    assert done.returncode == 1, done.stderr  # nodes that need an airport never come up
    result = json.loads(done.stdout.splitlines()[-1])
    assert (result["mission"], result["safety"]) == (None, None)
    assert result["duration_s"] >= 6


BROKEN = {
    "syntax": ("class Level(:\n", "SyntaxError: invalid syntax (own.py, line 1)"),
    "raises": ("import os\n\nraise RuntimeError('no hardware')\n",
               "RuntimeError: no hardware (HERE/own.py, line 3)"),
    "absent": ("import no_such_thing\n", "No module named 'no_such_thing'"),
}


@pytest.mark.parametrize("how", ["--virtual", *(
    pytest.param(how, marks=pytest.mark.slow)
    for how in ("--rate=4", "--fault=drop:localization/pose"))])
@pytest.mark.parametrize("what", BROKEN)
def test_a_module_of_one_s_own_that_cannot_be_imported_is_one_line_with_file_path_and_cause(
        tmp_path, what, how):
    source, cause = BROKEN[what]
    (tmp_path / "own.py").write_text(source)
    (tmp_path / "own.toml").write_text(changed(
        PAPER, ("rampart.actors.osmosis.detection.bounds:Bounds", "own:Level")))
    done = launched(tmp_path, "--system", "own.toml", how, "--no-hmi", "--port",
                    str(free_base_port()), "--report", str(tmp_path / "report"))
    assert done.returncode == 2, done.stderr
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert f"{tmp_path}/own.toml: detection DM3: actor = 'own:Level': " in done.stderr
    assert cause.replace("HERE", str(tmp_path)) in done.stderr
    assert not (tmp_path / "report").exists()


PLAIN = """
from rampart.actors.detection.module import DetectionModule

class Level(DetectionModule):
"""
DECLARED = f"""{PLAIN}
    class Parameters(DetectionModule.Parameters, frozen=True):
        highest_m: float = 2.0
"""
SAID = {
    "none declared": (f"{PLAIN}    pass\n", "highest_m = 1", "parameters.highest_m = 1: unknown "
                      "field; known: none"),
    "wrong type": (DECLARED, 'highest_m = "x"', "parameters.highest_m = 'x': expected a number"),
    "no struct": (f"{PLAIN}    class Parameters:\n        highest_m = 2.0\n", "highest_m = 1",
                  "actor = 'own:Level': Parameters: "),
    "no such type": (f"{PLAIN}    class Parameters(DetectionModule.Parameters, frozen=True):\n"
                     "        highest_m: 'Metres' = 2.0\n", "highest_m = 1",
                     "actor = 'own:Level': Parameters: name 'Metres' is not defined"),
}


@pytest.mark.parametrize("how", ["--rate=4", "--virtual", "--fault=drop:localization/pose"])
@pytest.mark.parametrize("what", SAID)
def test_a_parameter_that_an_actor_of_one_s_own_does_not_take_is_one_line_before_anything_starts(
        tmp_path, what, how):
    source, said, words = SAID[what]
    (tmp_path / "own.py").write_text(source)
    bounds = 'actor = "rampart.actors.osmosis.detection.bounds:Bounds"\n'
    (tmp_path / "own.toml").write_text(changed(
        PAPER, (bounds, f'actor = "own:Level"\nparameters = {{ {said} }}\n')))
    done = launched(tmp_path, "--system", "own.toml", how, "--no-hmi", "--port",
                    str(free_base_port()), "--report", str(tmp_path / "report"))
    assert done.returncode == 2, done.stderr
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert f"{tmp_path}/own.toml: detection DM3: {words}" in done.stderr
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
    assert f"launch.py: tracebacks of what failed: {report / 'errors.log'}" in done.stderr
    assert "own failed: KeyError: 'speed_mps'" in done.stderr
    assert f'File "{tmp_path}/own.py", line 8, in fail' in (report / "errors.log").read_text()


def test_actors_beside_the_caller_are_found_by_the_toolbox(tmp_path):
    (tmp_path / "own.py").write_text(OWN_ACTOR)
    (tmp_path / "own.toml").write_text(
        changed(TANK, ("rampart.actors.runtime.stub_node:StubNode", "own:Own")))
    done = subprocess.run(
        [str(Path(sys.executable).with_name("rampart")), "topic", "list", "--system",
         "own.toml"], cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr


@pytest.mark.processes
def test_a_run_without_a_mission_tells_where_its_tracebacks_are(tmp_path):
    (tmp_path / "own.py").write_text(OWN_ACTOR)
    (tmp_path / "own.toml").write_text(
        changed(TANK, ("rampart.actors.runtime.stub_node:StubNode", "own:Own")))
    report = tmp_path / "report"
    done = launched(tmp_path, "--system", "own.toml", "--duration", "1", "--port",
                    str(free_base_port()), "--report", str(report))
    assert f"launch.py: tracebacks of what failed: {report / 'errors.log'}" in done.stderr
    assert f'File "{tmp_path}/own.py", line 8, in fail' in (report / "errors.log").read_text()


NO_OPTION = ("{}: no option of the launcher or of tank; --system tank.toml --help shows those "
             "there are")
REFUSED = [
    (["--virtual"],
     "--virtual: in virtual time a run has to end: give --duration S, or tank an [end] with "
     "after_s"),
    (["--fault", "kill:nobody"],
     "fault 'kill:nobody': no node 'nobody'; there are: supervisor, pump_controller, "
     "tank_manager, D_LEVEL, D_CRASH, R_SHUT, R_RESTART"),
    (["--patience", "7"],
     "--patience 7: tank has no mission: its runs end after --duration S"),
    (["--obstacles", "1"], NO_OPTION.format("--obstacles")),
    (["--wait"], "--wait: no node of tank serves an operator's page"),
    (["--hmi-port", "9000"], "--hmi-port 9000: no node of tank serves an operator's page"),
    (["--hmi-host", "0.0.0.0"], "--hmi-host 0.0.0.0: no node of tank serves an operator's page"),
    (["--joystick"], NO_OPTION.format("--joystick")),
]


@pytest.mark.parametrize(("arguments", "line"), REFUSED, ids=[a[0] for a, _ in REFUSED])
def test_an_option_that_would_have_no_effect_is_refused(tmp_path, arguments, line):
    (tmp_path / "tank.toml").write_text(TANK)
    done = launched(tmp_path, "--system", "tank.toml", *arguments)
    assert (done.returncode, done.stderr) == (2, f"launch.py: {line}\n")


OSMOSIS = '[application]\nclass = "rampart.actors.osmosis.application:Osmosis"\n'
HALF = [
    ("", [], "--virtual: in virtual time a run has to end: give --duration S, or paper an [end] "
     "with after_s"),
    (OSMOSIS, ["--mission", "A"], "{file}: $.application: Object missing required field `airport`"),
    (OSMOSIS, ["--airport", "vallombre"],
     "{file}: $.application: Object missing required field `mission`"),
]


@pytest.mark.parametrize(("application", "arguments", "line"), HALF)
def test_half_a_mission_is_none(tmp_path, application, arguments, line):
    (tmp_path / "porter.toml").write_text(PORTER + application)
    line = line.format(file=tmp_path / "porter.toml")
    done = launched(tmp_path, "--system", "porter.toml", "--virtual", *arguments)
    assert (done.returncode, done.stderr) == (2, f"launch.py: {line}\n")
