"""The soak: its plan, its statistics, its page, and in the slow part the tool itself."""

from __future__ import annotations

import json
import random
import subprocess
import sys
from dataclasses import replace

import pytest
from PIL import Image

from tests import ROOT
from tests.whole.chaos import WAYS, targets
from tests.whole.chaos_pairs import LAUNCHER, PAUSE
from tests.whole.chaos_runs import load
from tests.whole.soak_growth import WARM_UP_S, Sample, growth, student
from tests.whole.soak_page import write_page
from tests.whole.soak_plan import EVERY_S, FIRST_S, LASTS_S, plan
from tests.whole.soak_runs import Soak, main, usage
from tests.whole.soak_summary import growths, summary, wrong


def samples(slope: float, *, missions: int = 3, minutes: int = 20, noise: float = 1.0,
            seed: int = 1) -> list[Sample]:
    """A figure that grows by `slope` an hour in each mission, each of which has its own level."""
    dice = random.Random(seed)
    return [Sample(60.0 * minutes * mission + s, mission, s,
                   500 - 40 * mission + slope * s / 3600 + dice.gauss(0, noise))
            for mission in range(missions) for s in range(0, 60 * minutes, 10)]


# ---- what grows ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("slope", "verdict"), [
    (0.0, "within noise"), (30.0, "GROWS"), (-30.0, "within noise"),
    (5.0, "grows, less than counts")])
def test_a_slope_is_found_whatever_the_level_of_each_mission(slope, verdict):
    found = growth("memory", "MB", samples(slope, noise=0.3), counts=10.0)
    assert found.verdict == verdict
    assert found.slope == pytest.approx(slope, abs=1.0)


def test_of_a_hundred_figures_that_do_not_grow_few_seem_to():
    seem = sum(growth("x", "", samples(0.0, seed=i), 0.0).low > 0 for i in range(100))
    assert seem <= 8  # 2.5 of them are expected


def test_what_becomes_a_process_s_own_in_its_first_minutes_is_no_growth():
    loading = [replace(s, value=s.value - max(0.0, 300 - s.into_s)) for s in samples(0.0)]
    assert growth("memory", "MB", loading, 1.0).verdict == "within noise"


def test_of_little_nothing_is_said():
    assert growth("x", "", [], 1.0).verdict == "too short to tell"
    assert growth("x", "", samples(90.0, missions=1, minutes=4), 1.0).verdict == "too short to tell"


@pytest.mark.parametrize(("free", "quantile"), [
    (1, 12.706), (5, 2.571), (10, 2.228), (30, 2.042), (120, 1.980)])
def test_the_quantiles_are_those_of_the_tables(free, quantile):
    assert student(free) == pytest.approx(quantile, rel=0.006)


# ---- what goes wrong ----------------------------------------------------------------------------


def test_every_five_seconds_something_goes_wrong_by_seed_and_mission():
    spec = load()
    everybody = len(targets(spec).mortal)
    plans = [plan(spec, seed, mission, 600.0) for seed in (1, 2) for mission in (0, 1)]
    assert plans[0] == plan(spec, 1, 0, 600.0)
    assert len({(p.blows, p.faults) for p in plans}) == 4
    for one in plans:
        moments = sorted([b.at_s for b in one.blows] + [f.at_s for f in one.faults])
        assert moments == [FIRST_S + i * EVERY_S for i in range(118)]
        assert sorted((b.name, b.way) for b in one.blows[:everybody]) == sorted(
            (name, "KILL") for name in targets(spec).mortal)
        assert one.blows[everybody - 1].at_s < WARM_UP_S  # before it counts what grows
        later = len(one.blows) - everybody
        assert 0.3 < later / (later + len(one.faults)) < 0.7
        assert all(LASTS_S[0] <= f.duration_s <= LASTS_S[1] < EVERY_S for f in one.faults)
    assert plan(spec, 1, 0, 300.0).blows == plans[0].blows[:len(plan(spec, 1, 0, 300.0).blows)]


def test_everybody_is_among_the_victims_and_world_and_launcher_are_only_stopped_for_a_moment():
    spec = load()
    of = targets(spec)
    blows = [b for mission in range(20) for b in plan(spec, 1, mission, 1800.0).blows]
    assert {b.name for b in blows} == {*of.mortal, *of.world, LAUNCHER}
    assert {b.way for b in blows} == {*WAYS, PAUSE}
    assert {b.name for b in blows if b.way == PAUSE} == {*of.world, LAUNCHER}
    kinds = {f.fault for mission in range(20) for f in plan(spec, 1, mission, 1800.0).faults}
    assert "gps-bias" in kinds
    assert any(name.startswith("delay:") for name in kinds)


# ---- what is kept, and shown --------------------------------------------------------------------


@pytest.fixture
def file(tmp_path):
    """A soak of twenty minutes, as it would be kept."""
    soak = Soak(tmp_path / "soak.jsonl", 1)
    soak.add("begin", at_s=0.0, mission=0, utc="2026-01-01T00:00:00+00:00")
    for s in range(0, 1200, 10):
        soak.add("sample", at_s=float(s), mission=0, into_s=float(s), used={
            LAUNCHER: [90_000 + s % 70, 110_000, 40, 9], "localization": [9_000, 20_000, 20, 5]})
    soak.add("blow", at_s=10.0, mission=0, into_s=10.0, name="localization", way="KILL", pid=7,
             back_s=0.05, absent=False)
    soak.add("latency", mission=0, into_s=10.0, what="KILL localization", detected_s=0.01,
             over_s=0.04)
    soak.add("latency", mission=0, into_s=15.0, what="drop:plan/route", affected=12,
             detected_s=0.6, over_s=4.0)
    soak.add("mission", at_s=1200.0, mission=0, verdict="success", cut=False, safety="safe", code=0,
             reasons=[], duration_s=1199.0, resets=1, left=[], behind=0.0, kept="")
    return tmp_path / "soak.jsonl"


def test_a_soak_is_read_again_and_goes_on_after_a_line_that_was_cut_off(file):
    with file.open("a") as out:
        out.write('{"kind": "sam')
    soak = Soak(file, 1)
    assert (soak.missions, soak.lasted_s) == (1, 1200.0)
    soak.add("begin", at_s=1200.0, mission=1, utc="")
    assert Soak(file, 1).missions == 2
    with pytest.raises(SystemExit, match="of another seed than 2"):
        Soak(file, 2)


def test_the_summary_says_what_was_and_what_is_wrong(file):
    soak = Soak(file, 1)
    lines = summary(soak.records)
    assert lines[0] == ("0.33 hours, 1 missions: 1 of 1 safe, 1 successful, 0 cut, 1 resets of the "
                        "emergency stop")
    assert lines[1].startswith("2 faults: 1 of processes, 1 of messages")
    assert any(f"memory of its own, {LAUNCHER}" in line and "within noise" in line
               for line in lines)
    assert wrong(soak.records) == []
    soak.add("blow", at_s=20.0, mission=0, into_s=20.0, name="hmi", way="STOP", pid=8, back_s=None,
             absent=False)
    soak.add("mission", at_s=1300.0, mission=1, verdict="fail", cut=False, safety="unsafe", code=3,
             reasons=["hit a wall"], duration_s=90.0, resets=0, left=["hmi"], behind=0.0,
             kept="here")
    found = wrong(soak.records)
    assert [line.split(":")[0] for line in found] == [
        "WRONG mission 1", "WRONG mission 1", "WRONG mission 0, 20 s"]
    assert "unsafe: hit a wall; kept in here" in found[0]


def test_a_leak_of_one_process_is_wrong(file):
    soak = Soak(file, 1)
    for record in soak.of("sample"):
        record["used"]["localization"][0] += int(record["at_s"] * 10)
    assert [line.split(",")[1].split()[0] for line in wrong(soak.records)
            if "its own" in line] == ["localization"]


@pytest.mark.parametrize(("leak_kb_a_second", "found"), [(0, []), (10, ["routers"])])
def test_routers_that_change_over_do_not_grow_and_a_leak_of_theirs_is_found(file, leak_kb_a_second,
                                                                            found):
    soak = Soak(file, 1)
    for record in soak.of("sample"):
        leak = int(record["at_s"] * leak_kb_a_second)
        a, b = (12_000, 8_000) if record["at_s"] < 700 else (8_000, 12_000)
        record["used"] |= {"router_a": [a, a, 30, 9], "router_b": [b + leak, b, 30, 9]}
    assert [line.split(",")[1].split()[0] for line in wrong(soak.records)
            if "its own" in line] == found


@pytest.mark.parametrize(("name", "verdict"), [
    (LAUNCHER, "within noise"), ("router_a", "within noise"),
    ("localization", "grows, less than counts")])
def test_what_is_known_to_grow_hides_nothing(file, name, verdict):
    soak = Soak(file, 1)
    for record in soak.of("sample"):
        for router in ("router_a", "router_b"):
            record["used"].setdefault(router, [8_000, 8_000, 30, 9])
        record["used"][name][0] += int(record["at_s"] * 3)
    [others] = [one for one in growths(soak.records) if one.what.endswith("the others")]
    assert others.verdict == verdict


def test_the_page_has_the_plot_in_it_and_the_plot_is_a_picture(file):
    soak = Soak(file, 1)
    png, page = write_page(soak.records, ["1 < 2"], file)
    with Image.open(png) as image:
        assert image.size[0] == 1100
        assert len(image.convert("RGB").getcolors(1 << 20)) > 10
    assert "data:image/png;base64," in page.read_text()
    assert "1 &lt; 2" in page.read_text()


def test_the_summary_alone_needs_no_run(file, capsys):
    assert main(["--summary", "--file", str(file)]) == 0
    assert "1 of 1 safe" in capsys.readouterr().out
    assert file.with_suffix(".png").is_file()


def test_what_a_process_uses_is_read_and_one_that_is_gone_uses_nothing():
    import os
    own, share, descriptors, threads = usage(os.getpid())
    assert 1000 < own <= share + own
    assert descriptors > 2
    assert threads >= 1
    assert usage(2**22 + 1) is None


@pytest.mark.slow
@pytest.mark.processes
@pytest.mark.alone
@pytest.mark.timeout(300)
def test_a_short_soak_is_safe_and_goes_on_where_it_was(tmp_path):
    file = tmp_path / "soak.jsonl"
    for hours, begun in ((0.012, 1), (0.02, 2)):
        done = subprocess.run(
            [sys.executable, "-m", "tests.whole.soak_runs", "--hours", str(hours), "--laps", "0",
             "--file", str(file)], check=False, capture_output=True, text=True, cwd=ROOT)
        records = [json.loads(line) for line in file.read_text().splitlines()]
        assert done.returncode == 0, done.stdout + done.stderr
        assert sum(r["kind"] == "begin" for r in records) == begun
    missions = [r for r in records if r["kind"] == "mission"]
    assert [(m["safety"], m["cut"], m["left"]) for m in missions] == [("safe", True, [])] * 2
    assert sum(r["kind"] in ("blow", "latency") for r in records) > 3
    assert all(LAUNCHER in r["used"] and len(r["used"]) > 30
               for r in records if r["kind"] == "sample" and r["into_s"] > 5)
    assert file.with_suffix(".html").is_file()
