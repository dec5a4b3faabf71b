"""DM3: a command out of bounds. DM9: two computers of one command that disagree."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.osmosis.detection.bounds import beyond
from rampart.actors.osmosis.detection.command_disagreement import (
    CommandComparison,
    ComparisonLimits,
)
from rampart.testing import play, table


@given(st.floats(), st.floats())
def test_active_if_and_only_if_the_command_is_out_of_bounds(linear, angular):
    fault = beyond(linear, angular, 1.0, 2.0)
    outside = not abs(linear) <= 1.0 + 2.1e-6 or not abs(angular) <= 2.0 + 3.1e-6
    inside = abs(linear) <= 1.0 and abs(angular) <= 2.0
    assert fault or not outside
    assert not (fault and inside)


# ---- DM9 ----------------------------------------------------------------------------------------

LIMITS = ComparisonLimits(angular_s=0.3, linear_s=0.6, hold_s=0.2, forget_s=1.0)
GOOD, TURNS, SLOW = (0.8, 0.0), (0.8, 0.9), (0.2, 0.0)
PAIRS = {
    "=": (GOOD, GOOD), "w": (GOOD, TURNS), "W": (TURNS, GOOD), "v": (GOOD, SLOW),
    "~": ((0.8, 0.1), (0.7, -0.1)), "a": (GOOD, None), "s": (None, GOOD),
    "n": (GOOD, (math.nan, 0.0)),
}
SOURCES = ("standby", "active")


class Bench:
    """A comparison and the incarnations of its sources."""

    def __init__(self, **changes) -> None:
        self.comparison = CommandComparison(SOURCES, LIMITS, **changes)
        self.lives = {"standby": 1, "active": 1}

    def handle(self, event: str, now_s: float) -> None:
        if event in "12":
            self.lives[SOURCES[int(event) - 1]] += 1
            return
        for source, command in zip(("active", "standby"), PAIRS[event], strict=True):
            if command is not None:
                self.comparison.take(source, command, now_s, self.lives[source], now_s)

    def play(self, events: str) -> str:
        return play(self.comparison, self.handle, events)


# = agree, ~ nearly, w W turn rates differ, v speeds differ, a s one is silent, 1 2 one is reborn
@pytest.mark.parametrize(("events", "expected"), **table({
    "agreement": ("==~~==", "------"),
    "turn rates differ for too long": ("==wwww", "-----A"),
    "a moment's difference": ("==ww==ww==", "----------"),
    "speeds may differ longer: a follower accelerates": ("==vvvvv===", "----------"),
    "but not for ever": ("==vvvvvvvv", "--------AA"),
    "agreement has to last": ("wwww=ww===", "---AAAAAA-"),
    "one is silent: nothing to compare": ("==aaaaaa", "--------"),
    "accused, then silent for so long that nothing is claimed": ("wwwwaaaaaaaaaaaaa",
                                                                "---AAAAAAAAAAAA--"),
    "not a number is the subject of others": ("==nnnnnn", "--------"),
}))
def test_disagreement_timeline(events, expected):
    assert Bench().play(events) == expected


@pytest.mark.parametrize(("events", "accused"), **table({
    "nobody": ("====", ()),
    "first the standby, whose restart costs nothing": ("wwww", ("standby#1",)),
    "it stays accused until it is reborn": ("wwwwwwww", ("standby#1",)),
    "they differ still when it is back: it was the other": ("wwww1wwww", ("active#1",)),
    "not at once, a new life has its time": ("wwww1ww", ("standby#1",)),
    "back and agreed: nobody": ("wwww1====", ()),
    "both are new and differ still: the last one stays accused": ("wwww1wwww2wwwww", ("active#1",)),
    "another time, from the beginning": ("wwww1====wwww", ("standby#2",)),
}))
def test_who_is_accused(events, accused):
    bench = Bench()
    bench.play(events)
    assert bench.comparison.nodes == accused


def test_a_respawned_comparison_claims_nothing_before_it_knows():
    assert Bench(known_after_s=0.2).play(".=") == "?-"
    assert Bench(known_after_s=0.2).play("aaaa") == "??--", "one alone is no pair"


@given(st.text("=wv1a", max_size=30))
def test_active_and_an_accused_life_go_together(events):
    bench = Bench()
    bench.play(events)
    assert bool(bench.comparison.nodes) == bench.comparison.active
