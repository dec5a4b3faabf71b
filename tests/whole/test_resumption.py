"""A run whose launcher is killed goes on where it was: on real processes."""

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
from rampart.actors.supervision.process_title import RUN, find_processes
from rampart.testing import wait_until
from tests import ROOT
from tests.whole.chaos import complaints
from tests.whole.missions import small_files, write_mission

pytestmark = [pytest.mark.processes, pytest.mark.alone, pytest.mark.timeout(300)]

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
