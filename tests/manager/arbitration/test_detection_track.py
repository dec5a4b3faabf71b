"""Belief in a detection module, as timelines: one character per 100 ms, report in, belief out."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.manager.arbitration.detection_track import (
    DetectionHeard,
    DetectionRules,
    DetectionTrack,
    hear,
    overdue,
    pass_time,
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
            track = hear(track, DetectionHeard("DM", report == "A", since_s=now), rules, now)
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


def heard(name: str, at_s: float, **changes) -> DetectionTrack:
    track = hear(DetectionTrack(name, heard_s=0.0), DetectionHeard(name, False), RULES, at_s)
    return msgspec.structs.replace(track, **changes)


def test_a_report_is_as_old_as_what_it_says_not_as_its_arrival():
    def said(stamp_s: float, active: bool = False) -> DetectionHeard:
        return DetectionHeard("DM", active, stamp_s=stamp_s)

    track = heard("DM", 10.0)
    assert hear(track, said(9.0), RULES, 10.5).heard_s == 10.0
    assert hear(track, said(10.2), RULES, 10.5).heard_s == 10.2
    assert hear(track, said(10.55), RULES, 10.5).heard_s == 10.5  # a clock that is ahead
    silent = pass_time(track, RULES, 11.0)
    assert silent.silent
    assert hear(silent, said(10.1), RULES, 11.1).silent
    assert not hear(silent, said(10.9), RULES, 11.1).silent
    assert hear(silent, said(9.0, active=True), RULES, 11.1).reported


@pytest.mark.parametrize(("ages_s", "found"), [
    ((0.1, 0.2, 0.1), None), ((0.1, 0.55, 0.1), None), ((0.1, 0.6, 0.1), "DM1"),
    ((0.6, 0.6, 0.1), None), ((0.1, 0.6, 0.3), None), ((0.1, 0.3, 0.6), None),
    ((0.2, 0.2, 0.9), "DM2"), ((0.6, 0.6, 0.6), None)])
def test_one_is_overdue_only_if_all_others_are_in_time(ages_s, found):
    tracks = tuple(heard(f"DM{i}", 10.0 - age_s) for i, age_s in enumerate(ages_s))
    which = overdue(tracks, RULES, 10.0)
    assert (which.name if which else None) == found


def test_one_that_was_never_heard_or_counts_as_silent_is_not_overdue():
    assert overdue((DetectionTrack("DM", heard_s=0.0),), RULES, 10.0) is None
    assert overdue((heard("DM", 9.0, silent=True),), RULES, 10.0) is None


@given(st.lists(st.tuples(st.integers(1, 30), st.integers(1, 30)), min_size=1, max_size=20))
def test_however_it_flaps_it_is_released_within_the_bound(flaps):
    """No starvation: idle for `release_hold_max_s`, it is believed."""
    beliefs = play("".join("A" * a + "i" * i for a, i in flaps) + "i" * 31)
    assert beliefs.endswith(".")
    # And no thrashing: between two rises of belief lies at least one hold.
    assert ".A" in "." + beliefs


@given(st.text("Ai", min_size=1, max_size=80))
def test_an_active_report_is_always_believed_at_once(reports):
    for report, belief in zip(reports, play(reports), strict=True):
        assert report == "i" or belief == "A"


def test_without_hold_belief_follows_the_reports():
    rules = DetectionRules(1.0, 2.0, 0.0, 0.0)
    assert play("iAiAAiiA", rules) == ".A.AA..A"
