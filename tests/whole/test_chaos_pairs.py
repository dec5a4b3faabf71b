"""The short relative of `make chaos-pairs`, and its plan."""

from __future__ import annotations

from collections import Counter
from itertools import combinations, product

import pytest

from tests.whole.chaos import Targets, targets
from tests.whole.chaos_pair_runs import Log, load, main, one_mission, summary
from tests.whole.chaos_pairs import GAP_S, GUARDS, LAUNCHER, PAUSE, WAYS, Outcome, plan_pairs
from tests.whole.test_chaos import write_row

EVERYBODY = targets(load())


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_every_pair_is_hit_once_and_those_with_a_guard_in_all_combinations(seed):
    plan = plan_pairs(EVERYBODY, seed)
    assert plan == plan_pairs(EVERYBODY, seed)
    assert [pair.index for pair in plan] == list(range(len(plan)))
    assert all(0 <= pair.gap_s <= GAP_S for pair in plan)
    names = {*EVERYBODY.mortal, *EVERYBODY.world, LAUNCHER}
    names -= {"pool"}
    assert len(names) == 36
    found: dict[frozenset[str], list[tuple[str, ...]]] = {}
    for pair in plan:
        ordered = dict(sorted(zip(pair.names, pair.ways, strict=True)))
        found.setdefault(frozenset(pair.names), []).append(tuple(ordered.values()))
    assert set(found) == {frozenset(pair) for pair in combinations(names, 2)}
    assert len(found) == 630
    paused = {*EVERYBODY.world, LAUNCHER}
    for pair, ways in found.items():
        possible = set(product(*((PAUSE,) if n in paused else WAYS for n in sorted(pair))))
        if pair & set(GUARDS):
            assert sorted(ways) == sorted(possible)
        else:
            assert len(ways) == 1
            assert set(ways) <= possible
    drawn = Counter(way for pair in plan if not set(pair.names) & {*GUARDS, *paused}
                    for way in pair.ways)
    assert set(drawn) == set(WAYS)
    assert min(drawn.values()) > 200


def test_what_is_in_the_file_is_not_done_again_and_another_seed_is_refused(tmp_path):
    file = tmp_path / "pairs.jsonl"
    plan = plan_pairs(Targets(("a", "b"), ()), 1)
    log = Log(file, 1)
    log.add(Outcome(plan[0], 0.1, 0.5, ("c",)).record)
    log.add(Outcome(plan[1], 0.1, None, (), "a crashed", "the story").record)
    log.add({"mission": "fail", "safety": "safe", "pairs": 2, "resets": 1, "wrong": ["late"]})
    again = Log(file, 1)
    assert [again.pairs[i]["missing"] for i in (0, 1)] == ["", "a crashed"]
    assert again.missions == log.missions
    lines = summary(again.pairs.values(), again.missions)
    assert lines[0] == ("2 pairs of 2 different, 1 missions: 1 safe, 0 successful, 1 resets of the "
                        "emergency stop")
    assert lines[-2:] == [
        f"WRONG pair #1 {' '.join(plan[1].ways)} {' '.join(plan[1].names)}: a crashed\nthe story",
        "WRONG mission 1: late"]
    with pytest.raises(SystemExit, match="of seed 1, not 2; choose another --file"):
        Log(file, 2)


def test_the_plan_can_be_read_without_doing_anything(capsys):
    assert main(["--list"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == len(plan_pairs(EVERYBODY, 1))


@pytest.mark.slow
@pytest.mark.processes
@pytest.mark.alone
@pytest.mark.timeout(300)
def test_a_mission_survives_a_dozen_pairs(tmp_path, capsys):
    among = ("supervisor", "router_a", LAUNCHER, "ftm_manager", "osmosis_control",
             "safety_pilot", "mission_manager", "DM4", "RM3", "simulator")
    plan = [pair for pair in plan_pairs(EVERYBODY, 1) if set(pair.names) <= set(among)][:12]
    log = Log(tmp_path / "pairs.jsonl", 1)
    left = one_mission(tmp_path / "run", plan, log, 1.0, len(plan),
                       mission=str(write_row(tmp_path)), rows="A")
    told = capsys.readouterr().out
    assert [p["missing"] for p in log.pairs.values()] == [""] * len(log.pairs), told
    assert log.missions[0]["wrong"] == [], told
    assert len(left) <= 6, told
