"""Short chaos, which every change has to survive; `make chaos` and `make soak` are longer."""

import random
import subprocess
import sys
from itertools import pairwise

import pytest

from rampart.testing import RealRun
from tests import ROOT
from tests.whole import chaos
from tests.whole.missions import write_mission

FULL = chaos.targets(chaos.load())
FEW = chaos.Targets(("mission_manager", "router_a", "safety_pilot", "ftm_manager", "supervisor"),
                    ("simulator", chaos.ROOT_PROCESS))
IN_PAIRS = {*FEW.mortal, *FEW.paused, "osmosis_control", "DM4", "RM3"}


def test_plans_have_every_process_in_every_way_every_pair_and_a_fault_every_five_seconds():
    of = FULL
    hits = [hit for strike in chaos.each_in_every_way(of, 1) for hit in strike.hits]
    assert {"hmi", "safety_pilot", "ftm_manager", "supervisor", "router_a", "router_b", "pool",
            "DM13", "RM8", "standby_control"} <= set(of.mortal)
    assert sorted((h.name, h.way) for h in hits) == sorted(
        [*[("simulator", chaos.PAUSE), (chaos.ROOT_PROCESS, chaos.PAUSE)] * len(chaos.WAYS),
         *((name, way) for name in of.mortal for way in chaos.WAYS)])
    pairs = chaos.every_pair(of, 1)
    count = len({*of.mortal, *of.paused} - {"pool"})
    assert len({frozenset(pair.names) for pair in pairs}) == count * (count - 1) // 2
    assert sum(set(pair.names) == {"supervisor", "DM4"} for pair in pairs) == 9
    assert sum(set(pair.names) == {"DM4", "DM5"} for pair in pairs) == 1
    soak, faults = chaos.of_a_soak(chaos.load(), 1, 0)
    assert {strike.names[0] for strike in soak[:len(of.mortal)]} == set(of.mortal)
    times = sorted(one.at_s for one in (*soak, *faults))
    assert {round(b - a, 6) for a, b in pairwise(times)} == {chaos.EVERY_S}


@pytest.mark.parametrize(("an_hour", "found"), [
    (0.0, []), (-30.0, []), (3.0, []), (30.0, ["routers: MB grow"])])
def test_growth_of_routers_that_change_over_is_found_whatever_the_level_of_each_mission(
        tmp_path, an_hour, found):
    log, dice = chaos.Log(tmp_path / "log.jsonl", 1), random.Random(1)
    for mission in range(3):
        for s in range(0, 1200, 10):
            warming = 20.0 - max(0.0, 300 - s) / 15
            mb = 500 - 40 * mission + an_hour * s / 3600 + warming + dice.gauss(0, 0.3)
            one, other = (12.0, 8.0) if s < 700 else (8.0, 12.0)
            log.add("sample", mission=mission, into_s=float(s), at_s=1200.0 * mission + s, used={
                "router_a": [mb + one, 30, 9], "router_b": [other, 30, 9], "DM1": [9.0, 20, 5]})
    with (tmp_path / "log.jsonl").open("a") as file:
        file.write('{"kind": "sam')
    again = chaos.Log(tmp_path / "log.jsonl", 1)
    assert again.records == log.records, "after a line that was cut off"
    assert [line.partition(" by ")[0] for line in again.wrong()] == found
    again.add("hit", mission=0, at_s=2.0, strike="STOP hmi", back_s=None, missing="hmi")
    again.add("mission", mission=0, at_s=9.0, verdict="fail, unsafe", wrong=["hit a wall"])
    assert len(chaos.Log(tmp_path / "log.jsonl", 1).wrong()) == len(found) + 2
    with pytest.raises(SystemExit, match="of another seed than 2"):
        chaos.Log(tmp_path / "log.jsonl", 2)


@pytest.mark.processes
@pytest.mark.alone
@pytest.mark.timeout(300)
@pytest.mark.parametrize(("strikes", "mission", "lights", "most_left"), [
    (chaos.each_in_every_way(FEW, 5, 1.3)[:7], "SHORT", ("A01", "A02", "A03"), 0),
    pytest.param(chaos.each_in_every_way(FEW, 5, 1.3), "ROW", ("A",), 0, marks=pytest.mark.slow),
    pytest.param([pair for pair in chaos.every_pair(FULL, 1) if set(pair.names) <= IN_PAIRS][:12],
                 "ROW", ("A",), 6, marks=pytest.mark.slow)], ids=["some", "all", "pairs"])
def test_a_mission_survives_whatever_is_done_to_its_processes(
        tmp_path, strikes, mission, lights, most_left):
    is_of_pairs = len(strikes[0].hits) == 2
    with RealRun(tmp_path, "osmosis", "--mission", str(write_mission(tmp_path, mission)),
                 "--rate", "1" if is_of_pairs else "2") as run:
        run.wait_for("goal 1/")
        session = chaos.Chaos(run, everything=is_of_pairs)
        left = session.carry_out(strikes)
        code, result = run.result()
    assert [str(one) for one in session.struck if one.back_s is None] == []
    assert chaos.complaints(code, result, run.story, lights) == [], run.story
    assert is_of_pairs or session.resets == 0, run.story
    assert len(left) <= most_left, "the mission was over before every process was hit"


@pytest.mark.slow
@pytest.mark.processes
@pytest.mark.alone
@pytest.mark.timeout(300)
def test_a_short_soak_is_safe_and_goes_on_where_it_was(tmp_path):
    file = tmp_path / "log.jsonl"
    for hours, begun in (("0.012", 1), ("0.02", 2)):
        done = subprocess.run(
            [sys.executable, "-m", "tests.whole.chaos", "soak", "--hours", hours, "--laps", "0",
             "--file", str(file)], check=False, capture_output=True, text=True, cwd=ROOT)
        assert done.returncode == 0, done.stdout + done.stderr
        assert len(chaos.Log(file, 1).of("begin")) == begun
    log = chaos.Log(file, 1)
    assert [m["verdict"] for m in log.of("mission")] == ["cut, safe"] * 2
    assert len(log.of("hit")) > 3
    assert all(len(r["used"]) > 30 for r in log.of("sample") if r["into_s"] > 5)
