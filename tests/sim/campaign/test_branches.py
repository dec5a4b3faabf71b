"""Runs that share their beginning: the same as from the start, whatever happens to one of them."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time

import msgspec
import psutil
import pytest

from rampart.sim.campaign.branches import AT_MOST, Attempt, attempt, attempt_together, together
from rampart.sim.campaign.execute import JobError, execute
from rampart.sim.campaign.job import Job, RunResult
from rampart.sim.campaign.store import Store
from rampart.sim.faults.scenario import parse_fault
from tests import ROOT

TUG = str(ROOT / "examples" / "tug" / "tug.toml")

IN_CHILDREN = """
import os, signal, sys, threading, time
import msgspec
from rampart.sim.campaign import branches
from rampart.sim.campaign.job import Job
jobs = msgspec.json.decode(sys.argv[1], type=list[Job])
from_start, branches.attempt = branches.attempt, None  # none may be made in another way
{before}
made = branches.attempt_together(jobs, {campaign})
print(msgspec.json.encode([(a.key, a.result and msgspec.to_builtins(a.result), a.error)
                           for a in made]).decode())
"""
"""Made in a separate process, since that of the tests may have threads."""


def job(*faults: str, system: str = "paper", **changes) -> Job:
    values = {"row": "test", "patience_s": 4.0, **changes}
    return Job(system=system, faults=tuple(map(parse_fault, faults)), **values)


def in_children(jobs, before: str = "", campaign: str = "os.getpid()"):
    code = IN_CHILDREN.format(before=before, campaign=campaign)
    done = subprocess.run([sys.executable, "-c", code, msgspec.json.encode(jobs)], cwd=ROOT,
                          capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    return [Attempt(*each) for each in msgspec.convert(
        json.loads(done.stdout), list[tuple[str, RunResult | None, str]])]


def members(session: int) -> list[int]:
    """Return the processes of a session, without those that wait to be waited for."""
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.NoSuchProcess, ProcessLookupError):
            if os.getsid(process.pid) == session and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process.pid)
    return found


def has_forked(campaign: int) -> bool:
    """Tell whether a worker of a campaign has a child."""
    with contextlib.suppress(psutil.NoSuchProcess):
        return any(child.children() for child in psutil.Process(campaign).children())
    return False


def untimed(made: Attempt) -> Attempt:
    assert made.result is not None, made.error
    return made._replace(result=msgspec.structs.replace(made.result, wall_s=0.0))


# ---- the same runs ---------------------------------------------------------------------------


@pytest.mark.parametrize(("system", "faults"), [
    ("paper", [("kill:mission_manager@3",), ("gps-bias@1+2", "kill:localization@2.5"),
               ("wrong-graph@goal1:1",), ("obstacle-ahead:1@3.05",)]),
    pytest.param("paper", [("localization-not-updated@0",), ("kill:supervisor@2",),
                           ("stuck-wheel@2",), ("gps-noise@500",)], marks=pytest.mark.slow),
    ("osmosis", [("stop:DM2@3",), ("kill:ftm_manager@goal1",),
                 ("drop:control/command@3+1", "slow:hmi@1+2")]),
    (TUG, [("kill:controller@2",), ("drop:controller/motion@3+1",)])])
def test_a_run_that_departs_from_others_is_the_same_as_from_the_start(tmp_path, system, faults):
    options = {} if system == TUG else {
        "obstacles": 2, "mission": str(tmp_path / "ONE.miss")}
    (tmp_path / "ONE.miss").write_text("x=-28.5,y=4,taxi=1\n")  # some ten seconds
    jobs = [job(*each, system=system, options=options, seed=5) for each in faults]
    made = in_children(jobs)
    assert [untimed(each) for each in made] == [untimed(attempt(each)) for each in jobs]
    assert len({each.result.trace for each in made}) == len(jobs)


def test_where_there_are_threads_runs_are_made_from_the_start():
    jobs = [job("kill:mission_manager@3"), job("kill:mission_manager@2")]
    ended = threading.Event()
    thread = threading.Thread(target=ended.wait)
    thread.start()
    try:
        made = attempt_together(jobs, os.getpid())
    finally:
        ended.set()
        thread.join()
    assert list(map(untimed, made)) == list(map(untimed, in_children(jobs)))


# ---- when one of them ends otherwise ---------------------------------------------------------

THREE = [job("kill:mission_manager@2"), job("kill:mission_manager@3"),
         job("kill:mission_manager@2.5")]
BAD = """
def result_of(result, begun_s):
    if result.record.faults[0].fault == "kill:mission_manager@3":
        {what}
    return kept(result, begun_s)
kept, branches.result_of = branches.result_of, result_of
"""


@pytest.mark.parametrize(("what", "error"), [
    ("os.kill(os.getpid(), signal.SIGSEGV)", "its process was killed by SIGSEGV"),
    ("sys.exit(3)", "its process ended with code 1"),
    ("os._exit(3)", "its process ended with code 3"),
    ("raise MemoryError", "MemoryError: "),
    ("branches.LONGEST_S, _ = None, time.sleep(60)", "its process was killed by SIGKILL")])
def test_a_child_that_fails_or_does_not_end_is_one_run_that_failed(what, error):
    before = BAD.format(what=what)
    made = in_children(THREE, before + ("branches.LONGEST_S = 8.0\n" if "sleep" in what else ""))
    assert made[1] == Attempt(
        THREE[1].key, None, f"run {THREE[1].key} (kill:mission_manager@3): {error}")
    assert all(each.result for each in (made[0], made[2]))


def test_a_plan_that_makes_no_sense_costs_no_other_run(tmp_path):
    store = Store(tmp_path)
    bad = [job("gremlins@1"), job("kill:nobody@2.2")]
    with pytest.raises(JobError, match=r"^run \w+ \((gremlins|kill:nobody).* \(and 1 more\)$"):
        execute([*THREE, *bad], store, workers=1)
    assert store.keys() == {each.key for each in THREE}
    store.close()


def test_without_its_campaign_a_worker_goes_on_with_nothing():
    code = IN_CHILDREN.format(before="", campaign="1 << 30")
    done = subprocess.run([sys.executable, "-c", code, msgspec.json.encode(THREE)], cwd=ROOT,
                          capture_output=True, text=True, check=False, timeout=300)
    assert (done.returncode, done.stdout) == (1, "")


def test_ctrl_c_ends_a_campaign_with_all_its_workers_and_their_children(tmp_path):
    command = [sys.executable, "-m", "rampart.cli.main", "campaign", "--system", "paper", "--runs",
               "60", "--seeds", "2", "--jobs", "2", "--out", str(tmp_path)]
    campaign = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL,
                                stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        deadline_s = time.monotonic() + 60
        while not has_forked(campaign.pid) and time.monotonic() < deadline_s:
            time.sleep(0.02)
        os.killpg(campaign.pid, signal.SIGINT)
        assert campaign.wait(60) != 0
        while members(campaign.pid) and time.monotonic() < deadline_s + 60:
            time.sleep(0.05)
        assert not members(campaign.pid)
    finally:
        for pid in members(campaign.pid):
            os.kill(pid, signal.SIGKILL)
        campaign.wait()


# ---- which of them are made together ---------------------------------------------------------


def test_runs_are_together_whose_beginnings_are_the_same_the_early_faults_first():
    here = [job(f"gps-bias@{at_s}") for at_s in (9, 3, 5)]
    elsewhere = [job("gps-bias@4", seed=2), job("gps-bias@4", options={"obstacles": 2}),
                 job("gps-bias@4", ftm=False), job("gps-bias@4", system="osmosis")]
    none = [job(), job(seed=2)]
    groups = together([*none, *here, *elsewhere] + [job("hmi-bias@1", seed=9 + i)
                                                    for i in range(20)], workers=1)
    assert [here[1], here[2], here[0]] in groups
    assert [len(group) for group in groups].count(1) == len(none) + len(elsewhere) + 20


@pytest.mark.parametrize(("runs", "workers", "largest"), [
    (1000, 2, AT_MOST), (80, 2, 10), (1000, 64, 3), (3, 2, 1)])
def test_groups_are_so_small_that_no_worker_is_idle_for_long(runs, workers, largest):
    jobs = [job(f"gps-bias@{1 + i / 100:g}") for i in range(runs)]
    groups = together(jobs, workers)
    assert max(map(len, groups)) == largest
    assert sorted(each.key for group in groups for each in group) == sorted(
        each.key for each in jobs)
