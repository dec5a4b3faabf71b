"""Short chaos: what every change has to survive. `make chaos` and `make chaos-pairs` are longer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from rampart.testing import RealRun
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
from tests.whole.chaos_runs import Log, load, pairs_in_a_mission, start
from tests.whole.checkpoint_runs import SHORT_LIGHTS, write_short_mission
from tests.whole.leak_counts import Counts, leaks

PAUSE_S = (0.3, 1.0)
ALL_FOUR = ("mission_manager", "router_a", "safety_pilot", "ftm_manager", "supervisor")


def write_row(directory: Path) -> Path:
    """Write mission A without its way home."""
    file = directory / "ROW.miss"
    file.write_text("x=-22,y=-18.5,taxi=1\nx=23.5,y=-18.5,taxi=0\n")
    return file


def test_every_process_is_hit_in_every_way_and_world_and_root_are_only_paused():
    of = targets(load())
    hits = [hit for strike in each_in_every_way(of, 1, PAUSE_S) for hit in strike.hits]
    assert {"hmi", "safety_pilot", "ftm_manager", "supervisor", "router_a", "router_b", "pool",
            "DM13", "RM8", "standby_control"} <= set(of.mortal)
    assert sorted((h.name, h.way) for h in hits) == sorted(
        [*[("simulator", PAUSE), (ROOT_PROCESS, PAUSE)] * len(WAYS),
         *((name, way) for name in of.mortal for way in WAYS)])


def test_every_two_processes_are_a_pair_and_those_of_the_supervisor_in_all_combinations_of_ways():
    of = targets(load())
    pairs = every_pair(of, 1)
    count = len({*of.mortal, *of.paused} - {"pool"})
    assert len({frozenset(pair.names) for pair in pairs}) == count * (count - 1) // 2
    assert sum(set(pair.names) == {"supervisor", "DM4"} for pair in pairs) == 9
    assert sum(set(pair.names) == {"DM4", "DM5"} for pair in pairs) == 1


COUNTS = Counts({"supervisor": 60, ROOT_PROCESS: 10}, {"supervisor": 90.0, ROOT_PROCESS: 50.0},
                34, 0, 99, frozenset({"a"}))


def test_the_same_or_less_is_no_leak_nor_are_spare_connections_and_a_little_memory():
    assert leaks(COUNTS, COUNTS) == []
    assert leaks(COUNTS, replace(
        COUNTS, processes=33, descriptors={"supervisor": 94, ROOT_PROCESS: 9},
        memory_mb={"supervisor": 100.0, ROOT_PROCESS: 50.0})) == []


@pytest.mark.parametrize("after", [
    {"descriptors": {"supervisor": 95, ROOT_PROCESS: 10}},
    {"descriptors": {"supervisor": 60, ROOT_PROCESS: 11}},
    {"memory_mb": {"supervisor": 110.0, ROOT_PROCESS: 50.0}},
    {"processes": 35}, {"zombies": 1}, {"files": 100},
    {"shared_memory": frozenset("ab")}], ids=" ".join)
def test_whatever_becomes_more_is_one_leak(after):
    assert len(leaks(COUNTS, replace(COUNTS, **after))) == 1


@pytest.mark.processes
@pytest.mark.alone
@pytest.mark.timeout(240)
@pytest.mark.parametrize(("rounds", "write", "lights"), [
    (1, write_short_mission, tuple(SHORT_LIGHTS)),
    pytest.param(len(WAYS), write_row, ("A",), marks=pytest.mark.slow)])
def test_a_mission_survives_whatever_is_done_to_its_processes(tmp_path, rounds, write, lights):
    strikes = each_in_every_way(Targets(ALL_FOUR, ("simulator", ROOT_PROCESS)), 5, PAUSE_S)
    strikes = strikes[:len(strikes) * rounds // len(WAYS)]
    with RealRun(tmp_path, "osmosis", "--mission", str(write(tmp_path)), "--rate", "2") as run:
        run.wait_for("goal 1/")
        chaos = Chaos(run)
        left = chaos.carry_out(strikes)
        code, result = run.result()
    done = "\n".join(map(str, chaos.struck))
    assert complaints(run, code, result, lights, chaos.struck) == [], f"{done}\n{run.story}"
    assert left == [], "the mission was over before every process was hit"


@pytest.mark.slow
@pytest.mark.processes
@pytest.mark.alone
@pytest.mark.timeout(300)
def test_a_mission_survives_a_dozen_pairs(tmp_path, capsys):
    among = {"supervisor", "router_a", ROOT_PROCESS, "ftm_manager", "osmosis_control",
             "safety_pilot", "mission_manager", "DM4", "RM3", "simulator"}
    plan = [pair for pair in every_pair(targets(load()), 1) if set(pair.names) <= among][:12]
    todo = dict(enumerate(plan))
    log = Log(tmp_path / "pairs.jsonl", 1)
    pairs_in_a_mission(start(tmp_path / "run", write_row(tmp_path), 1.0), todo, log, ("A",))
    printed = capsys.readouterr().out
    assert [p["missing"] for p in log.of("pair")] == [""] * len(log.of("pair")), printed
    assert log.of("mission")[0]["wrong"] == [], printed
    assert len(todo) <= 6, printed
