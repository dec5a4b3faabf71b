"""Campaigns: which runs are made, that each is made once whatever happens, and what is counted."""

from __future__ import annotations

import contextlib
import importlib
import json
import math
import os
import re
import signal
import sqlite3
import subprocess
import sys
from collections import Counter
from functools import partial
from pathlib import Path

import msgspec
import psutil
import pytest

from rampart.cli import systems
from rampart.cli.analyse import campaign_verb
from rampart.cli.main import main as rampart
from rampart.sim.campaign import content
from rampart.sim.campaign import job as campaign_job
from rampart.sim.campaign.content import content_of, with_content
from rampart.sim.campaign.job import Job, RunResult
from rampart.sim.campaign.plan import cross, fault_groups, sample
from rampart.sim.campaign.statistics import badness, rate, table, total, worst
from rampart.sim.campaign.store import JobError, Run, Store, StoreError, execute
from rampart.sim.faults.scenario import FaultOutcome, PlannedFault
from rampart.sim.osmosis.trial import paper_tables as paper
from rampart.sim.osmosis.trial.faults import OsmosisFaults
from rampart.systems import SHIPPED
from rampart.testing import wait_until
from tests import CELL, ROOT, TANK
from tests.porter_actors import write_porter_system

PAPER = systems.load("paper")
GROUPS = fault_groups(PAPER)
sample = partial(sample, faults=OsmosisFaults())
BASES = [Job(row="", system="paper", options={"mission": "A", "obstacles": n}) for n in (0, 2)]
SHORT = PlannedFault("kill:mission_manager", 3.0)
"""Over after seven simulated seconds of the paper's system, a fifth of a second of work."""


def result(**changes) -> RunResult:
    values = {
        "success": True, "safe": True, "reasons": (), "duration_s": 10.0,
        "margins": {"obstacle_m": 0.8, "prohibited_m": 0.9}, "severity": 0.0, "unsafe_s": None,
        "injected_s": 5.0, "detected_after_s": 0.1, "recovered_after_s": 0.3, "false_alarms": 0,
        "decisions": (), "outcomes": (FaultOutcome("x@5", 5.0, 3),), "failures": (),
        "trace": "00", "wall_s": 0.1}
    return RunResult(**{**values, **changes})


def runs_of(*results: RunResult, **job) -> list[Run]:
    return [Run(Job(**{"row": "x", "seed": i, **job}), r) for i, r in enumerate(results, 1)]


# ---- which runs ------------------------------------------------------------------------------


def test_a_longer_sample_begins_with_the_shorter_one_and_another_seed_is_another_sample():
    assert sample(BASES, GROUPS, 30, seed=1)[:10] == sample(BASES, GROUPS, 10, seed=1)
    assert sample(BASES, GROUPS, 10, seed=1) != sample(BASES, GROUPS, 10, seed=2)


def test_a_sample_draws_each_kind_by_the_square_root_of_how_many_faults_it_has():
    jobs = sample(BASES, GROUPS, 3000, seed=1)
    kind_of = {name: kind for kind, names in GROUPS.items() for name in names}
    kinds = Counter(kind_of[job.faults[0].fault] for job in jobs)
    roots = {kind: math.sqrt(len(names)) for kind, names in GROUPS.items()}
    for kind, root in roots.items():
        assert kinds[kind] / 3000 == pytest.approx(root / sum(roots.values()), rel=0.3), kind
    assert 0.4 < sum(job.options["obstacles"] == 2 for job in jobs) / 3000 < 0.6
    messages = [j.faults[0] for j in jobs
                if kind_of[j.faults[0].fault] in {"paper", "sensor", "topic", "reading"}]
    permanent = sum(f.duration_s == math.inf and not f.on_s for f in messages)
    intermittent = sum(f.on_s > 0 for f in messages)
    assert permanent / len(messages) == pytest.approx(1 / 3, abs=0.05)
    assert intermittent / len(messages) == pytest.approx(1 / 3, abs=0.05)
    assert len({job.seed for job in jobs}) > 2990


# ---- each run once ---------------------------------------------------------------------------


def test_a_store_keeps_a_run_as_it_was_infinity_included(tmp_path):
    store = Store(tmp_path)
    job = Job(row="x", faults=(PlannedFault("gps-bias", 3.0, duration_s=math.inf),))
    store.add(job, result())
    store.add(job, result(safe=False))  # the first one stays
    store.close()
    again = Store(tmp_path)
    assert list(again.runs()) == [Run(job, result())]
    assert again.keys() == {job.key}
    assert again.find(job.key[:4]) == Run(job, result())
    assert again.find("zz") is None
    again.close()


def test_a_file_that_is_no_store_or_has_other_runs_is_refused_and_left_alone(tmp_path):
    store = Store(tmp_path)
    store.add(Job(row="x"), result())
    with sqlite3.connect(store.path) as database:
        database.execute("update runs set result = 'of another version'")
    database.close()
    with pytest.raises(StoreError, match=r"cannot be used: .*; choose another --out"):
        list(store.runs())
    store.close()
    store.path.write_text("my shopping list\n" * 100)
    with pytest.raises(StoreError, match="not a store of campaign results"):
        Store(tmp_path)
    assert "shopping" in store.path.read_text()


def test_what_is_done_is_not_done_again_and_a_job_that_makes_no_sense_costs_no_other(tmp_path):
    store = Store(tmp_path)
    jobs = cross(BASES[:1], [(SHORT,)], range(1, 4))
    bad = cross(BASES[:1], [(PlannedFault("gremlins"),), (PlannedFault("kill:nobody"),)], [1])
    made = []
    with pytest.raises(JobError, match=r"^run \w+ \((gremlins|kill:nobody).* \(and 1 more\)$"):
        execute([*bad, *jobs[:2]], store, workers=1, progress=lambda j, r: made.append(j.key))
    assert store.keys() == set(made) == {job.key for job in jobs[:2]}
    assert execute(jobs, store, workers=1) == 1
    assert execute(jobs, store, workers=1) == 0
    store.close()


def test_a_killed_worker_ends_the_campaign_in_one_line_and_keeps_what_was_finished(
        tmp_path):
    store = Store(tmp_path)
    jobs = cross(BASES[:1], [(SHORT,)], range(1, 9))

    def kill_the_workers(*_: object) -> None:
        for child in psutil.Process().children():
            if "popen_loky" in " ".join(child.cmdline()):
                child.kill()

    with pytest.raises(JobError, match=r"^a process that made runs was killed: ") as caught:
        execute(jobs, store, workers=2, progress=kill_the_workers)
    assert "\n" not in str(caught.value)
    assert len(store.keys()) >= 1
    store.close()


def processes_of(session: int) -> list[int]:
    """Return the processes of a session, without those that wait to be waited for."""
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.NoSuchProcess, ProcessLookupError):
            if os.getsid(process.pid) == session and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process.pid)
    return found


COMMAND = [sys.executable, "-m", "rampart.cli.main", "campaign", "--system", "paper", "--fault",
           "kill:mission_manager@3", "--seeds", "12", "--obstacles", "0", "--json", "--out"]


def test_a_campaign_that_is_interrupted_or_killed_leaves_no_process_and_goes_on_where_it_was(
        tmp_path):
    def stored() -> int:
        with contextlib.closing(sqlite3.connect(tmp_path / "runs.sqlite", timeout=10)) as database:
            with contextlib.suppress(sqlite3.OperationalError):  # the table is not there yet
                return database.execute("select count(*) from runs").fetchone()[0]
        return 0

    kept = 0
    for number in (signal.SIGINT, signal.SIGKILL):
        campaign = subprocess.Popen(
            [*COMMAND, str(tmp_path), "--jobs", "2"], cwd=ROOT, stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL, start_new_session=True)
        try:
            wait_until(lambda kept=kept: stored() > kept, 60)
            os.killpg(campaign.pid, number)
            assert campaign.wait(60) != 0
            wait_until(lambda pid=campaign.pid: not processes_of(pid), 60)
        finally:
            for pid in processes_of(campaign.pid):
                os.kill(pid, signal.SIGKILL)
        kept = stored()
        assert kept < 12, "it was not ended in the middle"
    done = subprocess.run([*COMMAND, str(tmp_path)], cwd=ROOT, capture_output=True, text=True,
                          check=True)
    row, = json.loads(done.stdout)
    assert (row["fault"], row["runs"], row["safe"], row["success"], row["ineffective"]) == (
        "kill:mission_manager", 12, 12, 0, 0)
    assert stored() == 12
    assert (tmp_path / "report.html").read_text().startswith("<!")


def test_a_campaign_whose_disk_fills_up_says_so_in_one_line_and_keeps_what_was_finished(tmp_path):
    code = ("import resource, sys; from rampart.sim.campaign.store import Store; kept = Store.add\n"
            "def add(self, *run):\n"
            "    kept(self, *run)\n"
            "    if len(self.keys()) == 2: resource.setrlimit(resource.RLIMIT_FSIZE, (1000, -1))\n"
            "Store.add = add\n"
            "from rampart.cli.main import main; sys.exit(main(sys.argv[1:]))")
    full = subprocess.run(
        [sys.executable, "-c", code, *COMMAND[3:], str(tmp_path), "--jobs", "1"], cwd=ROOT,
        capture_output=True, text=True, check=False)
    assert (full.returncode, full.stdout) == (2, "")
    told = [line for line in full.stderr.splitlines() if line.startswith("rampart: ")]
    assert len(told) == 1
    assert told[0].startswith(f"rampart: {tmp_path / 'runs.sqlite'}: ")
    assert told[0].endswith("and the same command continues there")
    assert "Traceback" not in full.stderr
    store = Store(tmp_path)
    assert len(store.keys()) == 2
    store.close()


def test_a_campaign_keeps_its_verdict_though_its_report_cannot_be_written(
        tmp_path, made_up, monkeypatch, capsys):
    def broken(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(campaign_verb, "write_campaign_report", broken)
    lost = with_content(paper.full_jobs())[0]
    made_up[lost.key] = result(safe=False)
    assert rampart(["campaign", "--paper", "--full", "--json", "--out", str(tmp_path)]) == 1
    told = capsys.readouterr()
    assert len(json.loads(told.out)) == 12
    assert told.err.splitlines()[-1].startswith(f"rampart: report: {tmp_path}: ")


# ---- what is counted -------------------------------------------------------------------------


def test_the_interval_is_wilsons():
    # Brown, Cai, DasGupta (2001), table of examples; 0 of 10 and 5 of 10.
    assert rate(0, 10).high == pytest.approx(0.2775, abs=1e-4)
    assert (rate(5, 10).low, rate(5, 10).high) == pytest.approx((0.2366, 0.7634), abs=1e-4)
    assert (rate(0, 0).low, rate(0, 0).high) == (0.0, 1.0)


@pytest.mark.parametrize(("ended", "ineffective", "success", "safe", "words"), [
    ({"safe": False, "severity": 1.0}, 0, (2, 2), (1, 2), "success, unsafe"),
    ({"success": False}, 0, (1, 2), (2, 2), "fail, safe"),
    ({}, 1, (1, 1), (1, 1), "success, safe")])
def test_a_run_whose_fault_changed_nothing_has_not_survived_but_counts_if_it_ends_badly(
        ended, ineffective, success, safe, words):
    nothing = (FaultOutcome("x@5", 5.0, 0, "it changed nothing"),)
    row, = table(runs_of(result(), result(outcomes=nothing, detected_after_s=None, **ended)))
    assert (row.runs, row.ineffective, row.worst) == (2, ineffective, words)
    assert (row.success.count, row.success.of) == success
    assert (row.safe.count, row.safe.of) == safe
    assert row.undetected == 0, "nothing to detect"
    row, = table(runs_of(result(outcomes=nothing)))
    assert (row.worst, row.safe.of, row.ineffective) == ("no effect", 0, 1)
    row, = table(runs_of(result(success=False, detected_after_s=None)))
    assert (row.undetected, row.stopped_for_good) == (1, 1)


def test_a_row_names_who_detected_first_and_which_expected_module_stayed_idle():
    jump = (PlannedFault("localization-jump", 5.0),)  # the specification expects D_JUMP
    row, = table(runs_of(result(detected_by=("D_LOST", "D_JUMP")), result(detected_by=("D_LOST",)),
                         result(detected_by=("D_JUMP",)), result(detected_after_s=None),
                         system=str(ROOT / "examples/nav2/warehouse.toml"), faults=jump))
    assert (row.first_by, row.idle) == ({"D_LOST": 2, "D_JUMP": 1}, {"D_JUMP": 2})


def test_the_worst_run_is_unsafe_before_failed_before_close():
    runs = runs_of(result(), result(margins={"obstacle_m": 0.1}), result(success=False),
                   result(safe=False))
    assert sorted(runs, key=badness) == runs
    assert worst(runs) is runs[-1]


def test_conditions_are_rows_of_their_own():
    runs = [run for condition in (
        {}, {"options": {"obstacles": 2}}, {"ftm": False}, {"strategy": "mission-first"},
        {"retuned": paper.AS_THE_PAPER})
        for run in runs_of(result(), **condition)]
    assert [(r.options, r.ftm, r.strategy, r.retuned) for r in table([*runs, *runs])] == [
        ({}, True, "", {}), ({"obstacles": 2}, True, "", {}), ({}, False, "", {}),
        ({}, True, "mission-first", {}), ({}, True, "", paper.AS_THE_PAPER)]
    assert total(runs, "all").runs == 5


# ---- the paper -------------------------------------------------------------------------------


def test_table_iii_is_the_papers():
    assert [row.agrees for row in paper.table_iii(PAPER)] == [True] * 4


def test_every_row_of_the_papers_tables_is_run_under_every_condition():
    jobs = paper.paper_jobs()
    assert len(jobs) == len({job.key for job in jobs})
    assert {job.system for job in jobs} == {"paper"}
    assert {(j.row, j.options["obstacles"]) for j in jobs} == {
        (fault, n) for fault in paper.FAULTS for n in (0, 2)}
    found = paper.cells([Run(job, result()) for job in jobs])
    assert len(found) == len(paper.CONDITIONS) * len(paper.FAULTS) * 2
    assert {cell.ours for cell in found} == {"success, safe"}
    assert [c.agrees for c in found if c.fault == "none"] == [True] * 6
    assert not any(c.agrees for c in found if c.fault == "command not updated")


def test_the_full_system_is_given_the_runs_of_table_v_and_keeps_its_own_strategy():
    def what_goes_wrong(job: Job) -> tuple[object, ...]:
        return job.row, job.faults, job.options, job.seed, job.network

    jobs = paper.full_jobs("B", seed=5)
    assert {(j.system, j.strategy, j.ftm) for j in jobs} == {("osmosis", "", True)}
    assert {paper.condition_of(j) for j in jobs} == {paper.FULL}
    assert not any(j.retuned for j in jobs)
    for condition in paper.CONDITIONS[1:]:
        assert [what_goes_wrong(j) for j in jobs] == [
            what_goes_wrong(j) for j in paper.paper_jobs("B", seed=5)
            if paper.condition_of(j) == condition]
    assert {j.system for j in paper.full_jobs(system="other.toml")} == {"other.toml"}


# ---- the verb --------------------------------------------------------------------------------


@pytest.mark.parametrize(("arguments", "words"), [
    ((), "expected one of --paper, --runs N"),
    (("--paper", "--runs", "3"), "expected one of"),
    (("--full",), "--full: only with --paper"),
    (("--runs", "0"), "--runs 0: must be 1 or more"),
    (("--fault", "gremlins"), "unknown fault 'gremlins'"),
    (("--runs", "3", "--obstacles", "many"), "--obstacles many: Expected `int`"),
    (("--runs", "3", "--obstacles", "99"), "obstacles = 99: expected at most 5 on Vallombre"),
    (("--runs", "3", "--strategy", "hope"), "unknown strategy 'hope'"),
    (("--runs", "3", "--network", "wet"), "unknown network 'wet'"),
    (("--runs", "3", "--patience", "0"), "--patience 0"),
    (("--runs", "3", "--seeds", "2"), "--seeds 2: only with --fault"),
    (("--replay", "ab"), "expected --out DIR"),
    (("--paper", "--out", "/dev/null/out"), r"no directory that can be written \(Not a directory"),
    (("--replay", "ab", "--out", "/nowhere"), "no such directory"),
    (("--system", str(CELL), "--paper"), "--system .*cell.toml: expected a system with"),
])
def test_bad_usage_is_one_line_and_exit_code_2(capsys, arguments, words):
    assert rampart(["campaign", *arguments]) == 2
    text = capsys.readouterr().err
    assert text.count("\n") == 1
    assert re.search(words, text), text


def test_a_run_is_replayed_by_its_key_and_recognised(tmp_path, capsys):
    arguments = ["campaign", "--system", "paper", "--fault", "kill:mission_manager@3",
                 "--obstacles", "0", "--out", str(tmp_path), "--jobs", "1"]
    assert rampart([*arguments, "--json"]) == 0
    key = json.loads(capsys.readouterr().out)[0]["worst_key"]
    assert rampart(["campaign", "--replay", key[:6], "--out", str(tmp_path), "--json"]) == 0
    replayed = json.loads(capsys.readouterr().out)
    assert (replayed["run"], replayed["same_trace"]) == (key, True)
    assert rampart(["campaign", "--replay", "0000", "--out", str(tmp_path)]) == 2
    assert "none or several match" in capsys.readouterr().err


def test_a_robot_s_own_topics_can_fail_like_all_others(tmp_path, capsys):
    system = str(write_porter_system(tmp_path))
    own = ["campaign", "--system", system]
    listed = fault_groups(systems.load(system))["topic"]
    assert {"drop:porter/load", "stuck:porter/axle/rear"} <= set(listed)
    (tmp_path / "NEAR.miss").write_text("x=-28.5,y=4,taxi=1\n")
    assert rampart([*own, "--fault", "drop:porter/load@2+1", "--obstacles", "0", "--jobs", "1",
                    "--mission", str(tmp_path / "NEAR.miss"), "--out", str(tmp_path / "out"),
                    "--json"]) == 0
    row, = json.loads(capsys.readouterr().out)
    assert (row["fault"], row["ineffective"]) == ("drop:porter/load", 0)


@pytest.fixture
def made_up(monkeypatch):
    """Make results up instead of running jobs; all are good but those of the key given here."""
    bad: dict[str, RunResult] = {}

    def fake(jobs, store, **_):
        for job in jobs:
            store.add(job, bad.get(job.key, result()))
        return len(jobs)

    monkeypatch.setattr(campaign_verb, "execute", fake)
    return bad


def test_named_faults_together_are_every_pair_that_can_be_injected_at_once(tmp_path, made_up):
    assert rampart(["campaign", "--fault", "gps-b*@30+inf", "--fault", "imu-[bd]*@30+inf",
                    "--fault", "stuck:summit_xl/gps@30+inf", "--together", "2",
                    "--obstacles", "0,2", "--out", str(tmp_path)]) == 0
    made = Counter(frozenset(fault.fault for fault in job.faults) for job in jobs_in(tmp_path))
    assert set(made) == {
        frozenset((one, f"imu-{kind}")) for one in ("gps-bias", "stuck:summit_xl/gps")
        for kind in ("bias", "drift", "dropout")}
    assert set(made.values()) == {2}


def jobs_in(directory) -> list[Job]:
    store = Store(directory)
    found = [msgspec.structs.replace(run.job, content="") for run in store.runs()]
    store.close()
    return found


@pytest.mark.parametrize(("chosen", "jobs"), [
    ((), paper.paper_jobs()), (("--system", "osmosis"), paper.paper_jobs(system="osmosis")),
    (("--full",), paper.full_jobs()),
    (("--full", "--system", "paper"), paper.full_jobs(system="paper"))])
def test_the_papers_tables_are_of_its_system_and_full_of_the_full_one_unless_one_is_named(
        tmp_path, made_up, capsys, chosen, jobs):
    assert rampart(["campaign", "--paper", *chosen, "--out", str(tmp_path)]) == 0
    assert jobs_in(tmp_path) == jobs
    assert ("Table III" in capsys.readouterr().out) == ("--full" not in chosen)


def test_a_row_of_the_full_system_that_is_not_as_expected_is_told_and_is_exit_code_1(
        tmp_path, made_up, capsys):
    arguments = ["campaign", "--paper", "--full", "--json", "--out"]
    assert rampart([*arguments, str(tmp_path / "good")]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert len(rows) == 12
    assert {(r["expected"], r["ours"]) for r in rows} == {("success, safe",) * 2}
    assert {r["fault"]: r["paper"] for r in rows} == {f: v[0] for f, v in paper.WITH_FTM.items()}

    lost = next(job for job in with_content(paper.full_jobs())
                if job.row == "command not updated" and job.options["obstacles"])
    made_up[lost.key] = result(success=False, reasons=("goal 2 of 9 not reached",))
    assert rampart([*arguments, str(tmp_path / "bad")]) == 1
    rows = {(r["fault"], r["obstacles"]): r for r in json.loads(capsys.readouterr().out)}
    assert {where for where, r in rows.items() if r["ours"] != r["expected"]} == {
        ("command not updated", 2)}
    assert rows["command not updated", 2]["success"] == 3

    assert rampart(["campaign", "--paper", "--full", "--out", str(tmp_path / "bad")]) == 1
    text = capsys.readouterr().out
    assert text.count("  as expected") == 11
    assert f"NOT as expected: run {lost.key}" in text
    assert "goal 2 of 9 not reached" in text
    page = (tmp_path / "bad" / "report.html").read_text()
    assert "<h1>The paper&#39;s rows on the full system</h1>" in page


# -- A stored result stands for a run only while all that went into the run is the same --


SPEC = TANK + """
[end]
after_s = 3.0
[[node]]
name = "pump"
actor = "tank_parts.pump:Pump"
kind = "control"
parameters = { curve = "curve.csv" }
"""
PUMP = """
from rampart import Actor
from .limits import MOST_M

class Pump(Actor):
    class Parameters(Actor.Parameters, frozen=True):
        curve: str = ""
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
    for cached in (campaign_job.read_document_of, campaign_job._application, content._engine):
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
