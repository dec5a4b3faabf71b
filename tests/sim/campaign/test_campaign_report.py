"""The report of a campaign: figures, runs shown one by one, atomic writing."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from html import unescape
from pathlib import Path

import msgspec
import pytest

from rampart.sim.campaign import report
from rampart.sim.campaign.job import DecisionTaken, Job
from rampart.sim.campaign.report import Campaign, headline, render, worth_showing
from rampart.sim.campaign.statistics import percent
from rampart.sim.campaign.store import Run
from rampart.sim.faults.scenario import FaultOutcome, PlannedFault
from rampart.sim.osmosis.trial import paper_tables
from rampart.sim.osmosis.trial.paper_tables import Decided, section
from tests.sim.campaign.test_campaign import result

ABOUT = Campaign("A campaign", "rampart campaign --runs 3", 7)
OUT = Path("out/my campaign")


def run(fault: str = "gps-bias", *, row: str = "", affected: int = 1, ftm: bool = True,
        obstacles: int = 0, strategy: str = "", seed: int = 1, retuned=None, obstacle_m=None,
        prohibited_m=0.8, **more) -> Run:
    planned = (PlannedFault(fault, 12.0),) if fault else ()
    job = Job(row=row or fault or "none", faults=planned, ftm=ftm, options={"obstacles": obstacles},
              strategy=strategy, seed=seed, retuned=retuned or {})
    return Run(job, result(**{
        "duration_s": 90.0, "margins": {"obstacle_m": obstacle_m, "prohibited_m": prohibited_m},
        "injected_s": 12.0 if planned else None, "detected_after_s": None,
        "outcomes": tuple(FaultOutcome(p.text(), 12.0, affected) for p in planned)} | more))


def paper_page(runs: list[Run], decided: Sequence[Decided] = ()) -> str:
    return render(OUT, replace(ABOUT, section=section(paper_tables.cells(runs), decided)), runs)


def text_of(page: str, between: str = "") -> str:
    return " ".join(unescape(re.sub(r"<[^>]*>", between, page.replace("<wbr>", ""))).split())


# -- the page ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("ended", "told"), [
    ({"safe": False, "severity": 1.0}, "1 of 2 runs was unsafe (95 % interval: 9.5 to 90.5 %); 2 "),
    ({"success": False}, "none of 2 runs were unsafe (95 % interval: at most 65.8 %); 1 "),
    ({}, "none of 1 run were unsafe (95 % interval: at most 79.3 %); 1 completed the mission. "
         "In 1 run more the fault had no effect.")])
def test_the_headline_counts_a_run_that_ends_badly_though_its_fault_had_no_effect(ended, told):
    line = headline([run("gps-bias", seed=1), run("gps-bias", seed=2, affected=0, **ended)])
    assert f"With fault tolerance {told}" in line.replace("\N{NO-BREAK SPACE}", " ")


def test_the_headline_gives_the_upper_bound_of_the_interval_when_no_run_was_unsafe():
    told = headline([run(seed=seed) for seed in range(1000)])
    assert "none of 1,000 runs" in told
    assert "at most 0.4\N{NO-BREAK SPACE}%" in told


def test_text_from_outside_is_escaped():
    evil = "<script>alert('x')</script>\"&"
    made = run("gps-bias", row=evil, safe=False, unsafe_s=20.0, reasons=(evil,), failures=(evil,))
    papers = section([], [Decided((evil,), 1, (evil,), 2, (evil,))])
    page = render(Path(evil), Campaign(evil, evil, 1, papers), [made])
    assert "<script" not in page
    assert page.count("&lt;script&gt;") >= 7


def test_the_page_needs_nothing_but_itself():
    made = run(detected_after_s=0.1)
    page = render(OUT, ABOUT, [made])
    assert not re.search(r"<(script|link|img|iframe)|https?://|url\((?!#)|@import", page)
    targets = set(re.findall(r'(?:href="|url\()#([^")]*)', page))
    assert targets <= set(re.findall(r'id="([^"]*)"', page))
    assert len(re.findall(r'id="([^"]*)"', page)) == len(set(re.findall(r'id="([^"]*)"', page)))


def test_the_page_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    made = run()
    page = report.write_campaign_report(tmp_path / "new", ABOUT, [made])
    before = render(tmp_path / "new", ABOUT, [made])
    assert page.read_text(encoding="utf-8") == before
    monkeypatch.delattr(Path, "replace")  # of the new page by the old one
    with pytest.raises(AttributeError):
        report.write_campaign_report(tmp_path / "new", ABOUT, [])
    assert [file.read_text(encoding="utf-8") for file in page.parent.iterdir()] == [before]


# -- the paper's tables ------------------------------------------------------------------------


def paper_runs() -> list[Run]:
    """Return the paper's runs with the paper's verdicts."""
    made = []
    for job in paper_tables.paper_jobs():
        expected = paper_tables.WITH_FTM if job.ftm else paper_tables.WITHOUT_FTM
        mission, safety = expected[job.row][job.options["obstacles"] // 2].split(", ")
        base = run(job.faults[0].fault if job.faults else "", success=mission == "success",
                   safe=safety == "safe")
        made.append(Run(job, base.result))
    return made


def test_the_papers_runs_are_shown_as_its_tables_beside_its_verdicts():
    decided = [Decided(("FTM7",), 1, ("RM4",), 1, ("RM4",)),
               Decided(("FTM1", "FTM6"), 2, ("RM1",), 3, ("RM5",))]
    page = paper_page(paper_runs(), decided)
    text = text_of(page, " ")
    assert "24 of 24 verdicts of tables IV and V agree" in text
    assert "FTM7 1 1 RM4 RM4 ✓ agrees" in text
    assert "FTM1, FTM6 2 3 RM1 RM5 ✗ differs" in text
    several = len(paper_tables.FAULTS["control node crash"])
    for verdict, counts, tables in (("fail, unsafe", "0 success, 0 safe", 1),
                                    ("fail, safe", f"0 success, {several} safe", 2)):
        cells = f" {verdict} ✓ {verdict} {several} {counts}" * 2  # without and with obstacles
        assert text.count(f"safe control node crash{cells}") == tables
    assert "Where the verdicts differ" not in page


def test_where_a_verdict_differs_the_story_of_the_worst_run_is_told():
    runs = paper_runs()
    at = next(i for i, r in enumerate(runs)
              if paper_tables.condition_of(r.job) == paper_tables.CONDITIONS[1]
              and r.job.row == "command not updated" and r.job.options["obstacles"] == 2)
    runs[at] = Run(runs[at].job, msgspec.structs.replace(
        runs[at].result, safe=False, reasons=("1 collision",),
        decisions=(DecisionTaken(12.5, ("FTM2",), ("RM2",)),)))
    text = text_of(paper_page(runs))
    assert "23 of 24 verdicts of tables IV and V agree" in text
    assert ("command not updated, 2 obstacles, with FTM, as in the paper: the paper has fail, "
            "safe, our worst run fail, unsafe (1 collision).") in text
    assert "12.50 s FTM2: RM2" in text
    assert f"rampart campaign --replay {runs[at].job.key} --out 'out/my campaign'" in text


# -- the worst runs ----------------------------------------------------------------------------


def test_unprotected_runs_do_not_crowd_out_those_with_fault_tolerance():
    bare = [run(f"drop:t/{n}", seed=n, ftm=False, safe=False) for n in range(9)]
    mild = [run(f"drop:t/{n}", seed=n, success=False) for n in range(2)]
    assert [r.job.ftm for r in worth_showing([*bare, *mild])] == [True] * 2 + [False] * 4
    unsafe = run("gps-bias", safe=False, prohibited_m=0.9)
    less = [run("gps-bias", success=False), run("gps-bias", safe=False, prohibited_m=1.0)]
    shown = worth_showing([less[0], *bare, *mild, unsafe, less[1]])
    assert shown[0] is unsafe
    assert [r.job.row for r in shown].count("gps-bias") == 1
    assert len(worth_showing(bare, 2)) == 2
    told = [run(), run(ftm=False), run("drop:t/0", affected=0)]
    assert worth_showing(told) == told[:2]


def test_a_run_is_shown_with_its_moments_in_order_and_the_command_to_repeat_it():
    made = run("kill:hmi", safe=False, success=False, detected_after_s=1.0, unsafe_s=20.0,
               prohibited_m=-0.25, reasons=("0.5 s in the prohibited area",),
               decisions=(DecisionTaken(13.5, ("FTM5",), ("RM4",)), DecisionTaken(15.0, (), ())))
    page = render(OUT, ABOUT, [made])
    card = page[page.index("<section"):page.index("</section>") + len("</section>")]
    moments = re.findall(r"<tr>(.*?)</tr>", card, re.DOTALL)
    assert [text_of(moment, " ") for moment in moments] == [
        "0:12.0 fault injected", "0:13.0 first detection", "0:13.5 FTM5: RM4",
        "0:15.0 nothing: no recovery", "0:20.0 first unsafe", "1:30.0 end of the run"]
    assert "smallest margin −0.25 m" in card  # noqa: RUF001 - a minus sign
    assert f"rampart campaign --replay {made.job.key} --out &#39;out/my campaign&#39;" in card
    assert page.count("<section") == 1


# -- grouping, words ---------------------------------------------------------------------------


@pytest.mark.parametrize(("share", "text"), [
    (0.0, "0"), (1.0, "100"), (0.9996, "99.96"), (0.999999, "> 99.99"), (0.00001, "< 0.01"),
    (0.345, "34.5"), (math.nan, "–")])  # noqa: RUF001
def test_a_share_never_reads_as_all_or_nothing_unless_it_is(share, text):
    assert percent(share) == text


def test_conditions_that_differ_have_rows_of_their_own_and_others_are_told_once():
    latched = {"RM2": {"latched": True}}
    runs = [run(obstacles=0), run(obstacles=2), run(retuned=latched), run(ftm=False)]
    shown = re.findall(r'<th[^>]*colspan[^>]*>(.*?)</th>', render(OUT, ABOUT, runs), re.DOTALL)
    assert len(shown) == 4
    assert text_of(shown[0]) == "without FTM, no obstacles"
    assert sum("retuned" in text for text in shown) == 1
    assert not any("measured" in text for text in shown)
