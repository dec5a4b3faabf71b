"""The soak: its plan, its statistics, and in the slow part the tool itself."""

from __future__ import annotations

import json
import random
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise

import pytest

from tests import ROOT
from tests.whole.chaos import ROOT_PROCESS
from tests.whole.chaos_runs import Log, load
from tests.whole.soak_runs import EVERY_S, lasted_s, main, plan
from tests.whole.soak_summary import Sample, growth, summary, wrong


def samples(slope: float, *, missions: int = 3, minutes: int = 20, noise: float = 1.0,
            seed: int = 1) -> list[Sample]:
    """A figure that grows by `slope` an hour in each mission, each of which has its own level."""
    dice = random.Random(seed)
    return [Sample(60.0 * minutes * mission + s, mission, s,
                   500 - 40 * mission + slope * s / 3600 + dice.gauss(0, noise))
            for mission in range(missions) for s in range(0, 60 * minutes, 10)]


@pytest.mark.parametrize(("slope", "verdict"), [
    (0.0, "within noise"), (30.0, "GROWS"), (-30.0, "within noise"),
    (5.0, "grows, less than counts")])
def test_a_slope_is_found_whatever_the_level_of_each_mission(slope, verdict):
    found = growth("memory", "MB", samples(slope, noise=0.3), counts=10.0)
    assert found.verdict == verdict
    assert found.slope == pytest.approx(slope, abs=1.0)


def test_what_becomes_a_process_s_own_in_its_first_minutes_is_no_growth():
    loading = [replace(s, value=s.value - max(0.0, 300 - s.into_s)) for s in samples(0.0)]
    assert growth("memory", "MB", loading, 1.0).verdict == "within noise"


def test_each_process_is_killed_first_and_then_something_fails_every_five_seconds():
    planned = plan(load(), 1, 0)
    assert planned == plan(load(), 1, 0) != plan(load(), 1, 1)
    first = planned.hits[:len({hit.name for _, hit in planned.hits} - {"simulator", ROOT_PROCESS})]
    assert len({hit.name for _, hit in first}) == len(first)
    times = sorted([at_s for at_s, _ in planned.hits] + [fault.at_s for fault in planned.faults])
    assert {round(b - a, 6) for a, b in pairwise(times)} == {EVERY_S}


@pytest.fixture
def file(tmp_path):
    """A soak of twenty minutes, as it would be kept."""
    log = Log(tmp_path / "log.jsonl", 1)
    log.add("begin", at_s=0.0, mission=0)
    for s in range(0, 1200, 10):
        log.add("sample", at_s=float(s), mission=0, into_s=float(s), used={
            ROOT_PROCESS: [90_000 + s % 70, 110_000, 40, 9],
            "localization": [9_000, 20_000, 20, 5]})
    log.add("hit", at_s=10.0, mission=0, into_s=10.0, name="localization", way="KILL",
            back_s=0.05)
    log.add("latency", mission=0, into_s=10.0, fault="KILL localization", detected_s=0.01,
             over_s=0.04)
    log.add("latency", mission=0, into_s=15.0, fault="drop:plan/route", affected=12,
             detected_s=0.6, over_s=4.0)
    log.add("mission", at_s=1200.0, mission=0, verdict="success", cut=False, safety="safe", code=0,
             reasons=[], duration_s=1199.0, resets=1, left=[], kept="")
    return tmp_path / "log.jsonl"


def test_a_soak_is_read_again_and_goes_on_after_a_line_that_was_cut_off(file):
    with file.open("a") as out:
        out.write('{"kind": "sam')
    log = Log(file, 1)
    assert (len(log.of("begin")), lasted_s(log)) == (1, 1200.0)
    log.add("begin", at_s=1200.0, mission=1)
    assert len(Log(file, 1).of("begin")) == 2
    with pytest.raises(SystemExit, match="of another seed than 2"):
        Log(file, 2)


def test_the_summary_says_what_was_and_what_is_wrong(file):
    log = Log(file, 1)
    lines = summary(log.records)
    assert lines[0] == ("0.33 hours, 1 missions: 1 of 1 safe, 1 successful, 0 cut, 1 resets of the "
                        "emergency stop")
    assert lines[1].startswith("2 faults: 1 of processes, 1 of messages")
    assert any(f"memory of its own, {ROOT_PROCESS}" in line and "within noise" in line
               for line in lines)
    assert wrong(log.records) == []
    log.add("hit", at_s=20.0, mission=0, into_s=20.0, name="hmi", way="STOP", back_s=None)
    log.add("mission", at_s=1300.0, mission=1, verdict="fail", cut=False, safety="unsafe", code=3,
             reasons=["hit a wall"], duration_s=90.0, resets=0, left=["hmi"],
             kept="here")
    found = wrong(log.records)
    assert [line.split(":")[0] for line in found] == [
        "WRONG mission 1", "WRONG mission 1", "WRONG mission 0, 20 s"]
    assert "unsafe: hit a wall; kept in here" in found[0]


@pytest.mark.parametrize(("leak_kb_a_second", "found"), [(0, []), (10, ["routers"])])
def test_routers_that_change_over_do_not_grow_and_a_leak_of_theirs_is_found(file, leak_kb_a_second,
                                                                            found):
    log = Log(file, 1)
    for record in log.of("sample"):
        leak = int(record["at_s"] * leak_kb_a_second)
        a, b = (12_000, 8_000) if record["at_s"] < 700 else (8_000, 12_000)
        record["used"] |= {"router_a": [a, a, 30, 9], "router_b": [b + leak, b, 30, 9]}
    assert [line.split(",")[1].split()[0] for line in wrong(log.records)
            if "its own" in line] == found


def test_the_summary_alone_needs_no_run(file, capsys):
    assert main(["--summary", "--file", str(file)]) == 0
    assert "1 of 1 safe" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.processes
@pytest.mark.alone
@pytest.mark.timeout(300)
def test_a_short_soak_is_safe_and_goes_on_where_it_was(tmp_path):
    file = tmp_path / "log.jsonl"
    for hours, begun in ((0.012, 1), (0.02, 2)):
        done = subprocess.run(
            [sys.executable, "-m", "tests.whole.soak_runs", "--hours", str(hours), "--laps", "0",
             "--file", str(file)], check=False, capture_output=True, text=True, cwd=ROOT)
        records = [json.loads(line) for line in file.read_text().splitlines()]
        assert done.returncode == 0, done.stdout + done.stderr
        assert sum(r["kind"] == "begin" for r in records) == begun
    missions = [r for r in records if r["kind"] == "mission"]
    assert [(m["safety"], m["cut"], m["left"]) for m in missions] == [("safe", True, [])] * 2
    assert sum(r["kind"] in ("hit", "latency") for r in records) > 3
    assert all(ROOT_PROCESS in r["used"] and len(r["used"]) > 30
               for r in records if r["kind"] == "sample" and r["into_s"] > 5)
