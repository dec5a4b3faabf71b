"""What a run says and returns: whatever disk and reader do, and of robots of one's own."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import jinja2
import pytest
from msgspec.structs import replace

import rampart.sim.osmosis.trial.mission_trial
from rampart.actors.recording.recorder import VirtualRecording
from rampart.cli import run as launch
from rampart.manager.spec.specification import parse_specification
from rampart.manager.spec.tables import SpecificationError
from rampart.testing import HEEDS_SIGNALS, RealRun, free_base_port
from tests import CELL, ROOT, TANK
from tests.actors.recording.samples import pose
from tests.whole.missions import small_files, write_mission

UNSAFE = 3

UNSAFE_RUN = ("--virtual", "--system", "paper", "--no-ftm", "--fault", "command-out-of-bounds@5",
              "--fault", "kill:mission_manager@9", "--patience", "2")


def unsafe(tmp_path: Path, *more: str) -> list[str]:
    """Return the command of a run that ends unsafe."""
    return [sys.executable, str(ROOT / "launch.py"), *UNSAFE_RUN, "--mission",
            str(write_mission(tmp_path, "SHORT")), "--json", "--report", str(tmp_path / "report"),
            *more]


def result_of(text: str) -> dict:
    return json.loads(text.splitlines()[-1])


def redirected(tmp_path: Path, where: str, *command: str) -> tuple[int, str]:
    """Run a command whose streams go elsewhere; return its exit code, and what stderr has."""
    script = f'{{ "$@"; echo $? >{tmp_path}/code; }} {where}'
    done = subprocess.run(["/bin/sh", "-c", script, "sh", *command], cwd=ROOT, capture_output=True,
                          text=True, check=False, timeout=100)
    return int((tmp_path / "code").read_text()), done.stderr


@pytest.mark.parametrize(("where", "complaint"), [
    (">/dev/full", "launch.py: stdout: No space left on device: the result is lost"),
    (">&- 2>&- <&-", ""), ("1</dev/null", "Bad file descriptor: the result is lost"),
    ("| true", "")])
def test_an_unsafe_run_is_unsafe_though_nobody_can_be_told(tmp_path, where, complaint):
    code, told = redirected(tmp_path, where, *unsafe(tmp_path))
    assert code == UNSAFE, told
    assert "Traceback" not in told
    assert complaint in told
    page, = (tmp_path / "report").glob("*.html")
    assert "not safe" in page.read_text()


@pytest.mark.parametrize(("arguments", "where", "code", "complaint"), [
    (("verify", "paper", "--strict", "--strategy", "safety-first"), ">&- 2>&-", 1, ""),
    (("table", "--json"), "| true", 0, ""),
    (("table", "--json"), ">/dev/full", 2, "rampart: stdout: No space left on device\n")])
def test_the_toolbox_keeps_its_exit_code_too(tmp_path, arguments, where, code, complaint):
    assert redirected(tmp_path, where, sys.executable, "-m", "rampart.cli.main",
                      *arguments) == (code, complaint)


STUCK = """
import sys
from rampart.files import streams
streams.PATIENCE_S = 0.05
streams.secure()
for number in range(20_000):
    print("a line that is not read", number, file=sys.stderr)
print("the end", flush=True)
sys.exit(5)
"""


def test_who_does_not_read_stderr_stops_nobody():
    with subprocess.Popen([sys.executable, "-c", STUCK], cwd=ROOT, stdout=subprocess.PIPE,
                          stderr=subprocess.PIPE, text=True) as run:
        assert run.stdout is not None
        assert run.stderr is not None
        assert run.stdout.readline() == "the end\n"
        assert run.wait(10) == 5
        assert run.stderr.read().startswith("a line that is not read 0\n")


CLOSED = """
import os, sys
from rampart.files import streams
streams.secure()
opened = os.open("/dev/null", os.O_RDONLY)
print("to nobody", file=sys.stderr)
print("to nobody")
os._exit(opened)
"""


def test_no_file_gets_the_number_of_a_closed_stream():
    done = subprocess.run(
        ["/bin/sh", "-c", '"$@" >&- 2>&- <&-', "sh", sys.executable, "-c", CLOSED], cwd=ROOT,
        check=False, timeout=20)
    assert done.returncode > 2


# -- the report ----------------------------------------------------------------------------------


def test_an_unsafe_run_is_unsafe_though_its_report_or_recording_does_not_fit(tmp_path):
    def limited(size: int, *more: str) -> tuple[dict, str]:
        done = subprocess.run(unsafe(tmp_path, *more), capture_output=True, text=True, check=False,
                              timeout=100, preexec_fn=small_files(size))
        assert done.returncode == UNSAFE, done.stderr
        return result_of(done.stdout), done.stderr

    result, told = limited(5000)
    assert (result["safety"], result["report"], result["record"]) == ("unsafe", None, None)
    assert "File too large" in result["report_error"]
    assert [line for line in told.splitlines() if "cannot be written" in line] == [
        f"launch.py: report: {result['report_error']}"]
    assert not (tmp_path / "report").exists(), "an empty folder, or half a report"
    result, told = limited(200_000, "--record", str(tmp_path / "run.mcap"))
    assert result["safety"] == "unsafe"
    assert "run.mcap: File too large: the recording ends after" in told


def in_the_way(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)
    folder.write_text("something else")


@pytest.mark.parametrize("error", [jinja2.TemplateError("the page\nis broken"), MemoryError()])
def test_a_page_that_cannot_be_made_costs_neither_record_nor_verdict(
        tmp_path, monkeypatch, capsys, error):
    def broken(_run):
        raise error

    monkeypatch.setattr(rampart.sim.osmosis.trial.mission_trial, "render", broken)
    assert launch.main(unsafe(tmp_path)[2:]) == UNSAFE
    told = capsys.readouterr()
    result = result_of(told.out)
    assert result["report"] is None
    assert type(error).__name__ in result["report_error"]
    assert json.loads(Path(result["record"]).read_text())["safety"] == "unsafe"
    assert f"launch.py: report: {result['report_error']}\n" in told.err


def test_tracebacks_that_cannot_be_kept_cost_no_verdict(tmp_path, monkeypatch, capsys):
    class Failing(launch.VirtualRun):
        def run(self):
            in_the_way(tmp_path / "report")
            return replace(super().run(), tracebacks="a traceback")

    monkeypatch.setattr(launch, "VirtualRun", Failing)
    assert launch.main(unsafe(tmp_path)[2:]) == UNSAFE
    told = capsys.readouterr()
    assert result_of(told.out)["safety"] == "unsafe"
    assert "errors.log: cannot write tracebacks: Not a directory" in told.err


def test_a_recording_that_is_taken_away_is_not_said_to_be_there(tmp_path):
    path = tmp_path / "run.mcap"
    recording = VirtualRecording(path, {}, "title", nodes=(), lead_s=1.0, overwrite=False)
    recording.take(*pose(1, 0.5))
    path.unlink()
    assert recording.close() == f"{path}: was removed while it was written: nothing is recorded"


# -- real processes ------------------------------------------------------------------------------


@pytest.mark.processes
@pytest.mark.alone
def test_a_real_unsafe_run_is_unsafe_though_its_folder_is_gone_and_nobody_listens(tmp_path):
    with RealRun(tmp_path, "paper", "--mission", "A", "--rate", "3", "--patience", "35",
                 "--no-ftm") as run:
        run.wait_for("goal 1/3")
        run.sleep_until(9)
        injected = run.tool("inject", "command-out-of-bounds", "--duration", "inf")
        assert injected.returncode == 0, injected.stderr
        in_the_way(tmp_path / "report")
        run.wait_until(lambda: "UNSAFE" in run.story or run.process.poll() is not None, 100,
                       "the run did not end")
        run.process.terminate()
        code, result = run.result()
    assert (code, result["safety"], result["report"]) == (UNSAFE, "unsafe", None), run.story
    assert result["report_error"] in run.story
    assert "Traceback" not in run.story


@pytest.mark.processes
@pytest.mark.alone
def test_a_terminal_that_goes_away_ends_a_run_with_its_verdict(tmp_path):
    """All its processes get the SIGHUP, the first one twice, and stderr takes nothing any more."""
    with (tmp_path / "out").open("w") as out:
        run = subprocess.Popen(
            [*HEEDS_SIGNALS, sys.executable, str(ROOT / "launch.py"), "--mission", "A", "--no-hmi",
             "--system", "paper", "--json", "--report", str(tmp_path / "report"), "--port",
             str(free_base_port())], stdout=out, stderr=subprocess.PIPE, text=True,
            start_new_session=True)
    assert run.stderr is not None
    while "goal 1/3" not in (line := run.stderr.readline()):
        assert line, "it ended"
    run.stderr.close()
    run.send_signal(signal.SIGHUP)
    time.sleep(0.02)  # as timeout(1) does; two signals end a run without a verdict
    os.killpg(run.pid, signal.SIGHUP)
    assert run.wait(30) == 1
    result = result_of((tmp_path / "out").read_text())
    assert (result["mission"], result["safety"]) == ("fail", "safe")
    assert "ended: interrupted by SIGHUP" in result["reasons"]
    assert Path(result["report"]).is_file()


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


TEXT = CELL.read_text(encoding="utf-8")


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
    with RealRun(tmp_path, str(CELL), "--duration", "120") as run:
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
