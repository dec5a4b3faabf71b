"""Short chaos, which every change has to survive; `make chaos` and `make soak` are longer."""

from __future__ import annotations

import json
import random
import subprocess
import sys
from itertools import pairwise

import pytest

from rampart.testing import RealRun
from tests import ROOT
from tests.whole.chaos import (
    PAUSE,
    ROOT_PROCESS,
    WAYS,
    Chaos,
    Targets,
    complaints,
    each_in_every_way,
    every_pair,
    targets,
)
from tests.whole.chaos_runs import (
    EVERY_S,
    Log,
    load,
    pairs_in_a_mission,
    plan,
    start,
    wrong_in,
)
from tests.whole.leak_counts import leaks
from tests.whole.missions import write_row_mission, write_short_mission

PAUSE_S = (0.3, 1.0)
ALL_FOUR = ("mission_manager", "router_a", "safety_pilot", "ftm_manager", "supervisor")


def test_plans_have_every_process_in_every_way_every_pair_and_a_fault_every_five_seconds():
    of = targets(load())
    hits = [hit for strike in each_in_every_way(of, 1, PAUSE_S) for hit in strike.hits]
    assert {"hmi", "safety_pilot", "ftm_manager", "supervisor", "router_a", "router_b", "pool",
            "DM13", "RM8", "standby_control"} <= set(of.mortal)
    assert sorted((h.name, h.way) for h in hits) == sorted(
        [*[("simulator", PAUSE), (ROOT_PROCESS, PAUSE)] * len(WAYS),
         *((name, way) for name in of.mortal for way in WAYS)])
    pairs = every_pair(of, 1)
    count = len({*of.mortal, *of.paused} - {"pool"})
    assert len({frozenset(pair.names) for pair in pairs}) == count * (count - 1) // 2
    assert sum(set(pair.names) == {"supervisor", "DM4"} for pair in pairs) == 9
    assert sum(set(pair.names) == {"DM4", "DM5"} for pair in pairs) == 1
    soak, faults = plan(load(), 1, 0)
    assert {hit.name for _, hit in soak[:len(of.mortal)]} == set(of.mortal)
    times = sorted([at_s for at_s, _ in soak] + [fault.at_s for fault in faults])
    assert {round(b - a, 6) for a, b in pairwise(times)} == {EVERY_S}


def test_what_becomes_more_is_a_leak_but_spare_connections_and_a_little_memory_are_none():
    before = {"processes": 34.0, "descriptors of run": 60.0, "descriptors of root": 10.0,
              "MB of run": 90.0}
    assert leaks(before, before) == leaks(before, {
        **before, "descriptors of run": 94.0, "MB of run": 104.0, "processes": 33.0}) == []
    for more in ({"processes": 35.0}, {"descriptors of run": 95.0}, {"MB of run": 106.0},
                 {"descriptors of root": 11.0}):
        assert len(leaks(before, {**before, **more})) == 1


@pytest.mark.parametrize(("an_hour", "found"), [
    (0.0, []), (-30.0, []), (3.0, []), (30.0, ["routers: MB of its own grow"])])
def test_growth_of_routers_that_change_over_is_found_whatever_the_level_of_each_mission(
        tmp_path, an_hour, found):
    log, dice = Log(tmp_path / "log.jsonl", 1), random.Random(1)
    for mission in range(3):
        for s in range(0, 1200, 10):
            warming = 20.0 - max(0.0, 300 - s) / 15
            mb = 500 - 40 * mission + an_hour * s / 3600 + warming + dice.gauss(0, 0.3)
            one, other = (12.0, 8.0) if s < 700 else (8.0, 12.0)
            log.add("sample", mission=mission, into_s=float(s), at_s=1200.0 * mission + s, used={
                "router_a": [mb + one, 30, 9], "router_b": [other, 30, 9], "DM1": [9.0, 20, 5]})
    with (tmp_path / "log.jsonl").open("a") as file:
        file.write('{"kind": "sam')
    again = Log(tmp_path / "log.jsonl", 1)
    assert again.records == log.records, "after a line that was cut off"
    assert [line.partition(" by ")[0] for line in wrong_in(again.records)] == found
    again.add("hit", mission=0, at_s=2.0, name="hmi", way="STOP", back_s=None)
    again.add("mission", mission=0, safety="unsafe", reasons=["hit a wall"])
    assert len(wrong_in(Log(tmp_path / "log.jsonl", 1).records)) == len(found) + 2
    with pytest.raises(SystemExit, match="of another seed than 2"):
        Log(tmp_path / "log.jsonl", 2)


@pytest.mark.processes
@pytest.mark.alone
@pytest.mark.timeout(240)
@pytest.mark.parametrize(("rounds", "write", "lights"), [
    (1, write_short_mission, ("A01", "A02", "A03")),
    pytest.param(len(WAYS), write_row_mission, ("A",), marks=pytest.mark.slow)])
def test_a_mission_survives_whatever_is_done_to_its_processes(tmp_path, rounds, write, lights):
    strikes = each_in_every_way(Targets(ALL_FOUR, ("simulator", ROOT_PROCESS)), 5, PAUSE_S)
    strikes = strikes[:len(strikes) * rounds // len(WAYS)]
    with RealRun(tmp_path, "osmosis", "--mission", str(write(tmp_path)), "--rate", "2") as run:
        run.wait_for("goal 1/")
        chaos = Chaos(run)
        left = chaos.carry_out(strikes)
        code, result = run.result()
    assert [str(one) for one in chaos.struck if one.back_s is None] == []
    assert complaints(code, result, run.story, lights) == [], run.story
    assert left == [], "the mission was over before every process was hit"


@pytest.mark.slow
@pytest.mark.processes
@pytest.mark.alone
@pytest.mark.timeout(300)
def test_a_mission_survives_a_dozen_pairs(tmp_path, capsys):
    among = {"supervisor", "router_a", ROOT_PROCESS, "ftm_manager", "osmosis_control",
             "safety_pilot", "mission_manager", "DM4", "RM3", "simulator"}
    chosen = [pair for pair in every_pair(targets(load()), 1) if set(pair.names) <= among][:12]
    todo = dict(enumerate(chosen))
    log = Log(tmp_path / "pairs.jsonl", 1)
    pairs_in_a_mission(start(tmp_path / "run", write_row_mission(tmp_path), 1.0), todo, log, ("A",))
    printed = capsys.readouterr().out
    assert [p["missing"] for p in log.of("pair")] == [""] * len(log.of("pair")), printed
    assert log.of("mission")[0]["wrong"] == [], printed
    assert len(todo) <= 6, printed


@pytest.mark.slow
@pytest.mark.processes
@pytest.mark.alone
@pytest.mark.timeout(300)
def test_a_short_soak_is_safe_and_goes_on_where_it_was(tmp_path):
    file = tmp_path / "log.jsonl"
    for hours, begun in (("0.012", 1), ("0.02", 2)):
        done = subprocess.run(
            [sys.executable, "-m", "tests.whole.chaos_runs", "soak", "--hours", hours, "--laps",
             "0", "--file", str(file)], check=False, capture_output=True, text=True, cwd=ROOT)
        records = [json.loads(line) for line in file.read_text().splitlines()]
        assert done.returncode == 0, done.stdout + done.stderr
        assert sum(r["kind"] == "begin" for r in records) == begun
    missions = [r for r in records if r["kind"] == "mission"]
    assert [(m["safety"], m["cut"]) for m in missions] == [("safe", True)] * 2
    assert sum(r["kind"] == "hit" for r in records) > 3
    assert all(len(r["used"]) > 30 for r in records if r["kind"] == "sample" and r["into_s"] > 5)
