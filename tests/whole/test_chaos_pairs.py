"""The short relative of `make chaos-pairs`, and its plan."""

from __future__ import annotations

import pytest

from tests.whole.chaos import targets
from tests.whole.chaos_pair_runs import Log, load, one_mission
from tests.whole.chaos_pairs import LAUNCHER, plan_pairs
from tests.whole.test_chaos import write_row

EVERYBODY = targets(load())


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
