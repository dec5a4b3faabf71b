"""The benchmark's tables, plots and page."""

from __future__ import annotations

import re

import pytest

from rampart.cli.bench.figures import (
    Figures,
    Floor,
    Kill,
    Machine,
    Size,
    Spread,
    killed,
)
from rampart.cli.bench.page import WIDTH, Lane, html, number, plot, sections, svg, ticks

ALL = Figures(
    "1.0", "today", "rampart bench <b>", Machine(2, 24, "Linux", "Python", "1.10", 0.5),
    peers=(killed("dora", "dora & co", [Kill(5.0, None, 20.0, 300.0)],
                  beside=[Kill(output=30.0)]),
           killed("rampart-actor", "Rampart", [Kill(5.0, None, 20.0, 30.0)]),
           killed("circus", "circus", [], "not installed: make bench-peers")),
    floors=(Floor("fork", "fork", "ms", Spread(3, 0.5, 0.4, 0.6)),
            Floor("trip", "trip", "ms", Spread(3, 1.0, 0.9, 1.2), "of actors",
                  Spread(3, 1.2, 1.1, 1.9), 1.2, 1.25)),
    restart=(killed("planner", "plan/route", [Kill(9.0, 10.0, None, 40.0)]),),
    size=(Size(10, 1.5, 12.0, 8.0, 120.0, 0.1, Spread(1, 30.0, 30.0, 30.0), 1.0,
               samples_ms=(30.0,)),
          Size(140, note="did not start")),
    keys=(Floor("DM4", "DM4, killed", "ms", Spread(3, 20.0, 19.0, 25.0), "with keys",
                Spread(3, 22.0, 20.0, 30.0), 1.1, 1.5),))


@pytest.mark.parametrize(("low", "high", "expected"), [
    (3.0, 40.0, [2, 5, 10, 20, 50]), (10.0, 10.0, [10, 20]), (0.3, 0.4, [0.2, 0.5])])
def test_an_axis_has_round_ends(low, high, expected):
    assert ticks(low, high) == pytest.approx(expected)


def test_a_plot_keeps_everything_within_its_axis():
    drawn = plot("", [Lane("a", [12.0, 80.0], Spread(2, 30.0, 11.0, 85.0))])
    lane = drawn.lanes[0]
    places = [drawn.ticks[0][0], lane.low, *lane.dots, lane.high, drawn.ticks[-1][0]]
    assert places == sorted(places)
    assert places[0] > 0
    assert places[-1] < WIDTH
    assert plot("", []) is None


@pytest.mark.parametrize(("value", "text"), [
    (None, "–"), (0.1234, "0.123"), (12.34, "12.3"), (99.96, "100"), (1234.5, "1234")])  # noqa: RUF001
def test_figures_have_three_digits(value, text):
    assert number(value) == text


def test_each_part_has_its_rows():
    shown = {section.name: section for section in sections(ALL)}
    assert list(shown) == ["peers", "floors", "restart", "size", "keys"]
    assert shown["peers"].rows[0] == (
        "dora & co", "5", "20", "300", "300 to 300", "10", "10 to 10", "1")
    assert shown["peers"].rows[2][-1] == "0; not installed: make bench-peers"
    assert shown["floors"].rows[1][-2:] == ("1.2", "at most 1.25")
    assert shown["restart"].rows[0][:3] == ("planner", "plan/route", "9")
    assert shown["size"].rows[1][-1] == "did not start"
    assert shown["keys"].rows[0][-2:] == ("1.1", "at most 1.5")
    for section in shown.values():
        assert {len(row) for row in section.rows} == {len(section.head)}


def test_a_part_that_was_not_measured_is_not_shown():
    assert sections(Figures("", "", "", ALL.machine)) == []


def test_the_page_needs_nothing_but_itself():
    page = html(ALL)
    assert "rampart bench &lt;b&gt;" in page
    assert "dora &amp; co" in page
    assert page.count("<svg") == 5
    assert not re.search(r"<script|<link|\bsrc=|@import|url\(", page)
    assert set(re.findall(r"https?://[^\"']+", page)) == {"http://www.w3.org/2000/svg"}


def test_a_plot_of_its_own_brings_its_colours():
    drawn = sections(ALL)[0].plot
    assert "--track: #" in svg(drawn, alone=True)
    assert "--track: #" not in svg(drawn, alone=False)
