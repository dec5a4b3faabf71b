"""DM3: commands that the robot was never meant to drive."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.detection.finding import Sustained
from rampart.actors.osmosis.detection.bounds import beyond
from rampart.testing import play, table

COMMANDS = {
    "0": (0.0, 0.0), "v": (1.0, 0.0), "r": (-1.0, 2.0), "t": (0.3, -2.0),
    "V": (1.01, 0.0), "R": (-3.0, 0.0), "T": (0.0, 2.1), "n": (math.nan, 0.0),
    "i": (0.0, -math.inf),
}


def checker(**changes: float) -> Sustained:
    return Sustained(0.0, **{"clear_s": 0.3, **changes})


def command(check: Sustained):
    return lambda event, now_s: check.note(beyond(*COMMANDS[event], 1.0, 2.0), now_s)


# small letters and 0 are within bounds, V R T are beyond, n and i are no numbers
TIMELINES = {
    "good commands": ("0vrt0v", "------"),
    "the first bad command": ("vvVvvv", "--AAAA"),
    "it comes twice": ("VvvvvTvvvv", "AAAA-AAAA-"),
    "good again, but not for long enough": ("VvvVvvvv", "AAAAAAA-"),
    "too fast backward": ("R", "A"),
    "not a number": ("vn", "-A"),
    "infinite turn rate": ("vi", "-A"),
    "it never comes: that is the subject of DM2": ("......", "------"),
    "nonsense and then silence is not cured": ("V......", "AAAAAAA"),
    "every second command is bad": ("VvVvVvVv", "AAAAAAAA"),
}


@pytest.mark.parametrize(("events", "expected"), **table(TIMELINES))
def test_bounds_timeline(events, expected):
    check = checker()
    assert play(check, command(check), events) == expected


@given(st.floats(), st.floats())
def test_active_if_and_only_if_the_command_is_out_of_bounds(linear, angular):
    fault = beyond(linear, angular, 1.0, 2.0)
    outside = not abs(linear) <= 1.0 + 2.1e-6 or not abs(angular) <= 2.0 + 3.1e-6
    inside = abs(linear) <= 1.0 and abs(angular) <= 2.0
    assert fault or not outside
    assert not (fault and inside)
