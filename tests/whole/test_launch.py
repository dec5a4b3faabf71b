"""The product's main job on real parts: processes, Zenoh, MuJoCo, `launch.py`, also resumed."""

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from rampart.actors.runtime.checkpoint_file import files_of
from rampart.actors.supervision.process_title import RUN, find_processes, process_state
from rampart.testing import RealRun, wait_until
from tests import ROOT
from tests.real_tools import printed
from tests.stop.stopper import TIMEOUT_MS, compiled, running
from tests.whole.chaos import complaints
from tests.whole.missions import small_files, write_mission

pytestmark = [pytest.mark.processes, pytest.mark.alone, pytest.mark.timeout(240)]

def test_nodes_come_back_although_root_and_watching_process_are_stopped(tmp_path):
    with RealRun(tmp_path, "osmosis", "--mission", "A") as run:
        run.wait_for("goal 1/3")
        run.sleep_until(3)
        for node in ("safety_pilot", "osmosis_control", "RM1"):
            os.kill(run.kill("run", signal.SIGSTOP), 0)
            run.process.send_signal(signal.SIGSTOP)
            run.kill(node)
            run.wait_for(f"{node} respawned")
        assert run.process.poll() is None


def test_other_runs_and_ctrl_z_do_not_disturb_a_run_and_a_dead_mission_manager_leaves_it_safe(
        tmp_path):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
    with RealRun(tmp_path / "one", "paper", "--mission", "A", "--rate", "2") as run:
        run.wait_for("goal 1/3")
        second = subprocess.run(
            [sys.executable, str(ROOT / "launch.py"), "--no-hmi", "--port", str(run.port),
             "--report", str(tmp_path / "second")],
            check=False, capture_output=True, text=True, timeout=60)
        assert second.returncode == 2
        assert "in use" in second.stderr
        assert "Traceback" not in second.stderr
        with RealRun(tmp_path / "two", "paper", "--mission", "A") as other:  # side by side
            other.wait_for("goal 1/3")
            other.kill("DM1")
            other.wait_for("DM1 respawned")
            assert "DM1 respawned" not in run.story
            os.kill(other.process.pid, signal.SIGKILL)
            other.wait_until(lambda: find_processes(other.port) == [], 2, "processes were left")
        names = [name for process in find_processes(run.port) for name in process.names
                 if name not in {"pool", "run"}]
        assert len(names) == 24
        run.process.send_signal(signal.SIGTSTP)
        run.wait_for("ctrl-Z has no effect")
        assert printed(run, "status")
        run.process.send_signal(signal.SIGSTOP)
        assert printed(run, "status")
        assert process_state(run.process.pid) != "T"
        assert "crashed" not in run.story
        run.kill("mission_manager")  # the paper has no checkpoints
        code, result = run.result()
    assert (code, result["mission"], result["safety"]) == (1, "fail", "safe")
    assert any("mission lost" in reason for reason in result["reasons"])
    assert result["restarts"]["mission_manager"] == 1


def test_after_a_pause_of_everybody_only_what_died_or_hangs_is_restarted(tmp_path):
    """The launcher is stopped first, and all go on in a random order, but for the supervisor."""
    def running() -> set[tuple[tuple[str, ...], int]]:
        return {(p.names, p.incarnation) for p in find_processes(run.port) if p.names != ("pool",)}

    mission = write_mission(tmp_path, "NEAR")
    with RealRun(tmp_path, "osmosis", "--mission", str(mission), "--rate", "2") as run:
        run.sleep_until(4.0)
        before, supervisor = running(), run.pid("supervisor")
        died, hangs = run.pid("graph_planner"), run.pid("DM5")
        pids = [run.process.pid, *(p.pid for p in find_processes(run.port)
                                   if p.pid != run.process.pid)]
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)
        time.sleep(3.0)
        os.kill(died, signal.SIGKILL)
        random.Random(7).shuffle(pids)
        for pid in sorted(set(pids) - {hangs}, key=supervisor.__eq__):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
            time.sleep(0.002)
        run.wait_for("goal 3/3")
        assert running() - before == {(("graph_planner",), 2), (("DM5",), 2)}, run.story
        _, result = run.result()
        assert (result["mission"], result["safety"]) == ("success", "safe"), run.story
        assert "latched" not in run.story


NODE = '''
[[node]]
name = "velocity_link"
actor = "rampart.actors.foreign.velocity_link:VelocityLink"
kind = "non-control"
respawn = "{respawn}"

[node.parameters]
socket = "{socket}"
linear = "summit_xl/command:linear_mps"
angular = "summit_xl/command:angular_radps"
'''


def everything(run, number):
    """Signal all processes of a run, the root first."""
    for process in sorted(find_processes(run.port), key=lambda p: p.names != ("root",)):
        with contextlib.suppress(ProcessLookupError):  # it ends of itself: its parent is gone
            os.kill(process.pid, number)


def test_the_velocity_is_zero_after_the_timeout_though_all_are_killed_or_stopped(tmp_path, sockets):
    program = compiled(tmp_path)
    folder = Path(sockets)
    system = tmp_path / "linked.toml"
    text = (ROOT / "systems/osmosis.toml").read_text()
    system.write_text(text + NODE.format(socket=folder / "in", respawn="supervisor"))
    with running(program, folder) as stopper:
        for number in (signal.SIGSTOP, signal.SIGKILL):
            run_folder = tmp_path / number.name
            run_folder.mkdir()
            with RealRun(run_folder, system, "--mission", "A") as run:
                run.wait_for("goal 1")
                run.wait_until(lambda: stopper.speed > 0.3, 30, "it does not drive")
                everything(run, number)
                struck_ns = time.monotonic_ns()
                after = [stopper.next()]
                while after[-1].stamp_ns < struck_ns + 2 * TIMEOUT_MS * 1e6:
                    after.append(stopper.next())
                driving = [f.stamp_ns for f in after if any(f.velocity)]
                assert max(driving) - struck_ns <= TIMEOUT_MS * 1e6
                assert after[-1].velocity == (0.0, 0.0, 0.0)
                everything(run, signal.SIGKILL)


PORT = 20140
LIGHTS = ("A01", "A02", "A03")
STATES = ("mission_manager", "graph_planner", "osmosis_control", "simulator", "ftm_manager")
LASTS_S = 31.0
"""Real seconds that a run takes at most from its start to the end of its mission."""


def started(folder: Path, *options: str, **how: Any) -> subprocess.Popen[str]:
    """Start a run, or go on with one."""
    return subprocess.Popen(
        [sys.executable, str(ROOT / "launch.py"), "--no-hmi", "--json", "--port", str(PORT),
         *options], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **how)


def ended(run: subprocess.Popen[str]) -> tuple[int, dict[str, Any], str]:
    """Return exit code and result of a run, and what it told."""
    out, told = run.communicate(timeout=200)
    return run.returncode, json.loads(out.splitlines()[-1]) if out.strip() else {}, told


def cut_off(run: subprocess.Popen[str], report: Path, node: str) -> bool:
    """Kill the launcher and cut the newest state of a node, as a loss of power may.

    Returns whether there was one.
    """
    run.send_signal(signal.SIGKILL)
    run.communicate()
    files = files_of(report / "checkpoints", node)
    size = files[max(files)].stat().st_size if files else 0
    if size:
        os.truncate(files[max(files)], size - 7)
    return size > 0


@pytest.mark.timeout(300)
@pytest.mark.parametrize("seed", [
    None, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(60))])
def test_a_run_that_is_cut_off_in_a_write_measures_each_light_once(tmp_path, seed):
    """Twice in the moments of two lights; else once at any moment."""
    dice, report = random.Random(seed), tmp_path / "report"
    moments = ([(13.0, "osmosis_control"), (13.0, "mission_manager")] if seed is None
               else [(dice.uniform(3.0, LASTS_S), dice.choice(STATES))])
    run = started(tmp_path, "--mission", str(write_mission(tmp_path, "SHORT")), "--rate", "2",
                  "--report", str(report))
    for after_s, node in moments:
        time.sleep(after_s)
        if run.poll() is None:
            assert cut_off(run, report, node) or seed is not None
            run = started(tmp_path, "--resume", str(report))
    code, result, told = ended(run)
    assert complaints(code, result, told, LIGHTS) == []
    assert seed is not None or "part 3" in told


@pytest.mark.timeout(300)
def test_a_run_without_its_watching_process_is_resumed_and_no_other_in_its_place(
        tmp_path, monkeypatch, refused):
    monkeypatch.chdir(tmp_path)
    mission, report = str(write_mission(tmp_path, "NEAR")), str(tmp_path / "report")
    anew = ("--mission", mission, "--report", report)

    def why_not(*options: str) -> str:
        return refused("run", "--no-hmi", "--port", PORT + 1, *options)

    run = started(tmp_path, "--rate", "2", *anew)
    wait_until(lambda: any(Path(report).glob("record-*"))
               and any(Path(report).glob("checkpoints/*")), 60, lambda: "no run")
    assert "still lives" in why_not("--resume", report)
    assert f"--report {report}" in why_not(*anew)
    [watching] = [p.pid for p in find_processes(PORT) if p.names == (RUN,)]
    os.kill(watching, signal.SIGKILL)
    code, _, told = ended(run)
    assert code == 4, told
    for options, why in ((("--seed", "7"), "seed"), (("--mission", "A"), "mission"),
                         (("--system", "paper"), "paper"), (("--virtual",), "virtual"),
                         (("--obstacles", "1"), "obstacles"), (("--no-ftm",), "")):
        assert why in why_not("--resume", report, *options)
    for options in (("--resume", report), anew):
        code, _, told = ended(started(tmp_path, *options, preexec_fn=small_files(0)))
        assert code == 2
        assert "run.json: cannot be written: File too large" in told
    code, result, told = ended(started(tmp_path, "--resume", report))
    assert (code, result["mission"], result["safety"]) == (0, "success", "safe"), told
    assert "has ended (success, safe)" in why_not("--resume", report)
