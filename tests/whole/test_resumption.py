"""A run whose launcher is killed goes on where it was: on real processes."""

from __future__ import annotations

import json
import os
import signal
import time
from functools import partial
from pathlib import Path

import pytest

from rampart.actors.supervision.process_title import RUN, find_processes
from tests.whole.checkpoint_runs import write_near_mission
from tests.whole.hunger import fill, small_disk
from tests.whole.resumption_runs import first_part, one, resumed, started, wrongs

pytestmark = [pytest.mark.processes, pytest.mark.alone, pytest.mark.timeout(300)]

PORT = 20140


@pytest.mark.parametrize("seed", [
    100, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(60))])
def test_a_run_that_is_cut_off_at_any_moment_ends_in_success_with_each_light_measured_once(
        tmp_path, seed):
    wrong, _ = one(tmp_path, seed, PORT)
    assert wrong == []


def test_what_is_not_that_run_or_lives_is_refused_and_nothing_is_lost(tmp_path):
    mission = str(write_near_mission(tmp_path))
    report = str(tmp_path / "report")
    run = started(tmp_path, PORT, "--mission", mission, "--rate", "2", "--report", report)
    try:
        deadline_s = time.monotonic() + 60
        while not (tmp_path / "report" / "checkpoints").is_dir():
            assert time.monotonic() < deadline_s
            time.sleep(0.1)
        code, _, told = resumed(tmp_path, PORT + 1, report)
        assert (code, told.count("\n")) == (2, 1)
        assert "still lives" in told
        again = started(tmp_path, PORT + 1, "--mission", mission, "--report", report)
        _, told = again.communicate(timeout=60)
        assert again.returncode == 2
        assert f"--report {report}" in told
    finally:
        run.send_signal(signal.SIGKILL)
        run.communicate()
    for options, why in ((("--seed", "7"), "seed"), (("--mission", "A"), "mission"),
                         (("--system", "paper"), "paper"), (("--virtual",), "virtual"),
                         (("--obstacles", "1"), "obstacles"), (("--no-ftm",), "")):
        other = started(tmp_path, PORT, "--resume", report, *options)
        _, told = other.communicate(timeout=60)
        assert (other.returncode, told.count("\n")) == (2, 1), told
        assert why in told
    code, result, told = resumed(tmp_path, PORT, report)
    assert (code, result["mission"], result["safety"]) == (0, "success", "safe"), told
    code, _, told = resumed(tmp_path, PORT, report)
    assert (code, told.count("\n")) == (2, 1)
    assert "has ended (success, safe)" in told


def test_a_run_whose_watching_process_was_killed_can_be_resumed(tmp_path):
    mission, report = str(write_near_mission(tmp_path)), str(tmp_path / "report")
    run = started(tmp_path, PORT, "--mission", mission, "--rate", "2", "--report", report)
    until_s = time.monotonic() + 60
    while not (watching := [p.pid for p in find_processes(PORT) if p.names == (RUN,)]) or not (
            list(Path(report).glob("record-*"))):
        assert time.monotonic() < until_s
        time.sleep(0.1)
    os.kill(watching[0], signal.SIGKILL)
    told = run.communicate(timeout=60)[1]
    assert run.returncode == 4, told
    code, result, told = resumed(tmp_path, PORT, report)
    assert (code, result["mission"], result["safety"]) == (0, "success", "safe"), told


def test_with_a_full_disk_a_run_is_refused_in_one_line_and_the_one_before_it_can_be_resumed(
        tmp_path):
    with small_disk(tmp_path / "disk", 16) as disk:
        run = first_part(tmp_path, PORT, disk / "report")
        time.sleep(8)
        run.send_signal(signal.SIGKILL)
        run.communicate()
        filler = fill(disk)
        for start in (partial(first_part, tmp_path, PORT, disk / "report"),
                      partial(started, tmp_path, PORT, "--resume", str(disk / "report"))):
            again = start()
            told = again.communicate(timeout=60)[1]
            assert again.returncode == 2
            assert "run.json: cannot be written: No space left on device" in told
        filler.unlink()
        code, result, told = resumed(tmp_path, PORT, str(disk / "report"))
        assert (code, result["mission"], result["safety"]) == (0, "success", "safe"), told


def test_a_resumed_run_can_be_cut_off_and_resumed_again(tmp_path):
    run = first_part(tmp_path, PORT)
    report = tmp_path / "report"
    for _ in range(2):
        time.sleep(9)
        run.send_signal(signal.SIGKILL)
        run.communicate()
        run = started(tmp_path, PORT, "--resume", str(report))
    out, told = run.communicate(timeout=200)
    assert wrongs(report, run.returncode, json.loads(out.splitlines()[-1]), told) == []
    assert "part 3" in told
