"""Robots of one's own: what a run says of their modules and of what they have not; a cell runs."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from rampart.manager.spec.specification import parse_specification
from rampart.manager.spec.tables import SpecificationError
from rampart.testing import RealRun, free_base_port
from tests import CELL as FILE
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


TEXT = FILE.read_text(encoding="utf-8")


WITHIN = 'against = { within_s = 0.45, hazard = "a hand is within the arm\'s reach" }'


@pytest.mark.parametrize(("old", "new", "message"), [
    ("heartbeat_timeout_s = 0.3\n", "heartbeat_timeout_s = 0.1\n", "would raise false alarms"),
    (WITHIN, "", "mechanism M_CURTAIN: against: the default 'drift' needs a [robot]"),
    (WITHIN, 'against = "runaway"', "mechanism M_CURTAIN: against = 'runaway': needs a [robot]"),
    ("within_s = 0.45", "within_s = 0.1", "M_CURTAIN needs 0.180 s (detection 0.030 + arbitration "
     "0.050 + actuation 0.100) of 0.100 s before a hand is within the arm's reach"),
    ("R_HOLD and R_OPEN_GRIPPER", "R_HOLD and R_RETRACT and R_OPEN_GRIPPER",
     "R_HOLD and R_RETRACT both claim arm; they cannot run together"),
])
def test_what_does_not_fit_a_system_without_a_robot_is_refused(old, new, message):
    assert old in TEXT
    with pytest.raises(SpecificationError, match=re.escape(message)):
        parse_specification(TEXT.replace(old, new, 1), "cell.toml")


@pytest.mark.processes
def test_it_runs_its_dead_nodes_come_back_and_what_is_triggered_is_recovered_from(tmp_path):
    with RealRun(tmp_path, str(FILE), "--duration", "120") as run:
        run.wait_for("ctrl-C ends it")
        run.sleep_until(1.0)
        run.kill("arm_controller")
        run.wait_for("(R_RESTART_MOTION): ")
        run.wait_for("arm_controller respawned")
        first = subprocess.Popen([sys.executable, "-m", "rampart.cli.main", "trigger",
                                  "D_ENCODER_B", "--for", "90", "--port", str(run.port)],
                                 cwd=ROOT, stdout=subprocess.DEVNULL)
        try:
            run.wait_for("(D_ENCODER_B): triggered by hand")
            time.sleep(0.3)
            assert "R_HOLD" not in run.story
            done = run.tool("trigger", "D_ENCODER_C", "--for", "0.5")
            assert done.returncode == 0, done.stderr
            assert "(R_HOLD): " in run.story
        finally:
            first.kill()
            first.wait()
        assert run.tool("trigger", "gripper").returncode == 2
        run.process.send_signal(signal.SIGINT)
        code, result = run.result(20)
    assert code == 0
    assert result["mission"] is None
    assert result["restarts"]["arm_controller"] == 1
    assert [d["recoveries"] for d in result["decisions"]][:1] == [["R_RESTART_MOTION"]]


