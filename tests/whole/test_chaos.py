"""The short chaos test: what every change has to survive. `make chaos` runs the long one."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from rampart.manager.spec.specification import check_document, read_document
from rampart.testing import RealRun
from tests import ROOT
from tests.whole.chaos import WAYS, Chaos, Targets, complaints, each_in_every_way, targets
from tests.whole.leak_counts import Counts, leaks

SHIPPED = ROOT / "systems" / "osmosis.toml"
PAUSE_S = (0.3, 1.0)
ALL_FOUR = ("mission_manager", "router_a", "safety_pilot", "ftm_manager", "supervisor")


def write_row(directory: Path) -> Path:
    """Write mission A without its way home."""
    file = directory / "ROW.miss"
    file.write_text("x=-22,y=-18.5,taxi=1\nx=23.5,y=-18.5,taxi=0\n")
    return file


def test_everybody_is_hit_in_every_way_and_the_world_is_only_stopped():
    everybody = targets(check_document(
        read_document(SHIPPED.read_text(encoding="utf-8"), SHIPPED.name), SHIPPED.name))
    hits = each_in_every_way(everybody, 1, PAUSE_S)
    assert {"hmi", "safety_pilot", "ftm_manager", "supervisor", "router_a", "router_b", "pool",
            "DM13", "RM8", "standby_control"} <= set(everybody.mortal)
    assert sorted((h.name, h.way) for h in hits) == sorted(
        [*[("simulator", "STOP")] * 4, *((name, way) for name in everybody.mortal for way in WAYS)])


COUNTS = Counts({"supervisor": 60, "launch.py": 10}, {"supervisor": 90.0, "launch.py": 50.0},
                34, 0, 99, frozenset({"a"}))


def test_the_same_or_less_is_no_leak_nor_are_spare_connections_and_a_little_memory():
    assert leaks(COUNTS, COUNTS) == []
    assert leaks(COUNTS, replace(
        COUNTS, processes=33, descriptors={"supervisor": 94, "launch.py": 9},
        memory_mb={"supervisor": 100.0, "launch.py": 50.0})) == []


@pytest.mark.parametrize("after", [
    {"descriptors": {"supervisor": 95, "launch.py": 10}},
    {"descriptors": {"supervisor": 60, "launch.py": 11}},
    {"memory_mb": {"supervisor": 110.0, "launch.py": 50.0}},
    {"processes": 35}, {"zombies": 1}, {"files": 100},
    {"shared_memory": frozenset("ab")}], ids=" ".join)
def test_whatever_becomes_more_is_one_leak(after):
    assert len(leaks(COUNTS, replace(COUNTS, **after))) == 1


@pytest.mark.processes
@pytest.mark.alone
@pytest.mark.timeout(240)
@pytest.mark.parametrize("rounds", [1, pytest.param(len(WAYS), marks=pytest.mark.slow)])
def test_a_mission_survives_whatever_is_done_to_its_processes(tmp_path, rounds):
    hits = each_in_every_way(Targets(ALL_FOUR, ("simulator",)), 5, PAUSE_S)
    hits = hits[:len(hits) * rounds // len(WAYS)]
    with RealRun(tmp_path, "osmosis", "--mission", str(write_row(tmp_path)), "--rate", "2") as run:
        run.wait_for("goal 1/2")
        chaos = Chaos(run, world=("simulator",))
        left = chaos.carry_out(hits)
        code, result = run.result()
    done = "\n".join(map(str, chaos.struck))
    assert complaints(run, code, result, "A", chaos.struck) == [], f"{done}\n{run.story}"
    assert left == [], "the mission was over before everybody was hit"
