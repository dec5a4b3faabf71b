"""A run whose launcher is killed goes on where it was: on real processes."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path

import pytest

from rampart.actors.supervision.process_title import RUN, find_processes
from rampart.cli import run as launch
from rampart.testing import wait_until
from tests.whole.checkpoint_runs import write_near_mission
from tests.whole.hunger import small_files
from tests.whole.resumption_runs import (
    cut_last_write,
    first_part,
    one,
    resumed,
    started,
    wrongs,
)

pytestmark = [pytest.mark.processes, pytest.mark.alone, pytest.mark.timeout(300)]

PORT = 20140


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(60))
def test_a_run_that_is_cut_off_at_any_moment_ends_in_success_with_each_light_measured_once(
        tmp_path, seed):
    wrong, _ = one(tmp_path, seed, PORT)
    assert wrong == []


def test_a_run_that_is_cut_off_twice_in_a_write_measures_each_light_once(tmp_path):
    run = first_part(tmp_path, PORT)
    report = tmp_path / "report"
    for torn in ("osmosis_control", "mission_manager"):
        time.sleep(13)
        run.send_signal(signal.SIGKILL)
        run.communicate()
        assert cut_last_write(report, torn)
        run = started(tmp_path, PORT, "--resume", str(report))
    out, told = run.communicate(timeout=200)
    assert wrongs(report, run.returncode, json.loads(out.splitlines()[-1]), told) == []
    assert "part 3" in told


def test_a_run_without_its_watching_process_is_resumed_and_no_other_in_its_place(
        tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    mission, report = str(write_near_mission(tmp_path)), str(tmp_path / "report")

    def refused(*options: str) -> str:
        assert launch.main(["--no-hmi", "--port", str(PORT + 1), *options]) == 2
        told = capsys.readouterr().err
        assert told.count("\n") == 1, told
        return told

    run = started(tmp_path, PORT, "--mission", mission, "--rate", "2", "--report", report)
    wait_until(lambda: any(Path(report).glob("record-*")), 60, lambda: "no run")
    wait_until(lambda: any(Path(report).glob("checkpoints/*")), 60, lambda: "no checkpoint")
    assert "still lives" in refused("--resume", report)
    assert f"--report {report}" in refused("--mission", mission, "--report", report)
    [watching] = [p.pid for p in find_processes(PORT) if p.names == (RUN,)]
    os.kill(watching, signal.SIGKILL)
    told = run.communicate(timeout=60)[1]
    assert run.returncode == 4, told
    for options, why in ((("--seed", "7"), "seed"), (("--mission", "A"), "mission"),
                         (("--system", "paper"), "paper"), (("--virtual",), "virtual"),
                         (("--obstacles", "1"), "obstacles"), (("--no-ftm",), "")):
        assert why in refused("--resume", report, *options)
    for options in (("--resume", report), ("--mission", mission, "--report", report)):
        again = started(tmp_path, PORT, *options, preexec_fn=small_files(0))
        told = again.communicate(timeout=60)[1]
        assert again.returncode == 2
        assert "run.json: cannot be written: File too large" in told
    code, result, told = resumed(tmp_path, PORT, report)
    assert (code, result["mission"], result["safety"]) == (0, "success", "safe"), told
    assert "has ended (success, safe)" in refused("--resume", report)
