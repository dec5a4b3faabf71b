"""The speed controllers: which pilot they obey, and what they do without commands."""

import math

import pytest
from quadrotor.rotors import IDLE_N, IN_TIME_S, LATE_S, SpeedControllers

FIRST, SECOND = (3.0,) * 4, (4.0,) * 4


class Bench:
    """Speed controllers, and two pilots that command every 10 ms."""

    def __init__(self, hold_s=0.4):
        self.rotors = SpeedControllers(("pilot", "reserve"), hold_s)
        self.tick = 0
        self.play(0.1)

    @property
    def now_s(self):
        return self.tick * 0.01

    def play(self, seconds, *, pilot=FIRST, reserve=SECOND, each=1, late_s=0.0):
        """Return what the rotors do at the end, and how often they changed over."""
        changes, driven = 0, None
        for _ in range(round(seconds / 0.01)):
            self.tick += 1
            before = self.rotors.obeys
            if pilot is not None and self.tick % each == 0:
                self.rotors.command("pilot", pilot, self.now_s - late_s)
            if reserve is not None:
                self.rotors.command("reserve", reserve, self.now_s)
            driven = self.rotors.turn(self.now_s)
            changes += self.rotors.obeys != before
        return driven, changes


def test_while_both_command_in_time_the_first_flies():
    assert Bench().play(5.0) == (FIRST, 0)


@pytest.mark.parametrize("first", [
    {"pilot": None}, {"each": 10}, {"late_s": 0.3}, {"pilot": (-1.0, 3.0, 3.0, 3.0)},
    {"pilot": (math.nan, 3.0, 3.0, 3.0)}, {"pilot": (9.0,) * 4}],
    ids=["silent", "slow", "late", "negative", "no number", "too much"])
def test_the_reserve_flies_at_once_and_as_long_as_the_first_is_not_in_time(first):
    bench = Bench()
    assert bench.play(LATE_S + 0.02, **first) == (SECOND, 1)
    assert bench.play(3.0, **first) == (SECOND, 0)


def test_the_first_flies_again_when_it_has_been_in_time_for_a_while():
    bench = Bench()
    bench.play(0.2, pilot=None)
    assert bench.play(IN_TIME_S - 0.05)[0] == SECOND
    bench.play(0.05, pilot=None)
    assert bench.play(IN_TIME_S - 0.05)[0] == SECOND
    assert bench.play(0.1) == (FIRST, 1)


def test_a_reserve_that_fails_while_it_flies_hands_over_at_once():
    bench = Bench()
    bench.play(0.2, pilot=None)
    bench.play(0.1)
    assert bench.play(LATE_S + 0.02, reserve=None) == (FIRST, 1)


def test_when_both_are_dead_the_last_command_holds_for_a_while_and_then_they_idle():
    bench = Bench()
    assert bench.play(0.35, pilot=None, reserve=None)[0] == FIRST
    assert bench.play(0.1, pilot=None, reserve=None)[0] == (IDLE_N,) * 4
    assert bench.rotors.age_s(bench.now_s) == pytest.approx(0.45)
    assert bench.play(0.05, pilot=None)[0] == SECOND


def test_a_command_that_is_old_or_from_a_stranger_changes_nothing():
    bench = Bench()
    assert bench.rotors.command("pilot", SECOND, bench.now_s - 1.0)
    assert not bench.rotors.command("stranger", SECOND, bench.now_s)
    assert bench.rotors.turn(bench.now_s) == FIRST
