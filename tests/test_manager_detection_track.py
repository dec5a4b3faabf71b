"""Belief in a detection module, as timelines: one character per 100 ms, report in, belief out."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from manager.detection_track import (
    DetectionRules,
    DetectionTrack,
    hear,
    pass_time,
    release_hold_s,
)

RULES = DetectionRules(silence_timeout_s=0.95, startup_grace_s=2.0, release_hold_s=0.5,
                       release_hold_max_s=3.0)


def play(reports: str, rules: DetectionRules = RULES) -> str:
    """A: reports active, i: reports idle, -: says nothing.

    Out: A believed active, S active because silent, . believed idle.
    """
    track, beliefs = DetectionTrack("DM", heard_s=0.0), ""
    for tick, report in enumerate(reports):
        now = tick / 10
        if report in "Ai":
            track = hear(track, rules, now, active=report == "A", reason="", nodes=(), since_s=now)
        track = pass_time(track, rules, now)
        beliefs += "S" if track.silent else "A" if track.active else "."
    return beliefs


@pytest.mark.parametrize(("reports", "beliefs"), [
    # active at once; idle after half a second
    ("iiAAAiiiiiiiii",
     "..AAAAAAAA...."),
    # the second flap soon after the first is held for nearly twice as long
    ("iiAiiAiiiiiiiiiiiiii",
     "..AAAAAAAAAAAAAA...."),
    # silence after 0.95 s is activity; a report ends it, after the hold
    ("i----------iiiiiii",
     ".........." "SAAAAA.."),
    # activity that falls silent stays active
    ("iA----------AAii",
     ".AAAAAAAAAASAAAA"),
    # never heard: the grace of two seconds, then silent
    ("-----------------------",
     ".....................SS"),
])
def test_timeline(reports, beliefs):
    assert beliefs == play(reports)


def test_one_fault_is_held_for_the_plain_hold():
    track = DetectionTrack("DM", heard_s=0.0)
    track = hear(track, RULES, 100.0, active=True, reason="x", nodes=("a",), since_s=99.9)
    track = hear(track, RULES, 101.0, active=False, reason="", nodes=(), since_s=101.0)
    assert release_hold_s(track, RULES) == 0.5
    assert (track.since_s, track.nodes, track.rises) == (99.9, ("a",), 1)


@pytest.mark.parametrize("period_s", [0.2, 0.5, 1.0, 2.0])
def test_flapping_is_soon_seen_as_one_long_activity(period_s):
    half = round(period_s * 5)
    beliefs = play(("A" * half + "i" * half) * round(40 / period_s))
    assert "." not in beliefs[200:]


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 30), st.integers(1, 30)), min_size=1, max_size=20))
def test_however_it_flaps_it_is_released_within_the_bound(flaps):
    """No starvation: idle for `release_hold_max_s`, it is believed."""
    beliefs = play("".join("A" * a + "i" * i for a, i in flaps) + "i" * 31)
    assert beliefs.endswith(".")
    # And no thrashing: between two rises of belief lies at least one hold.
    assert ".A" in "." + beliefs


@settings(max_examples=100, deadline=None)
@given(st.text("Ai", min_size=1, max_size=80))
def test_an_active_report_is_always_believed_at_once(reports):
    for report, belief in zip(reports, play(reports), strict=True):
        assert report == "i" or belief == "A"


def test_without_hold_belief_follows_the_reports():
    rules = DetectionRules(1.0, 2.0, 0.0, 0.0)
    assert play("iAiAAiiA", rules) == ".A.AA..A"
