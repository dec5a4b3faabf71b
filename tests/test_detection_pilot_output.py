"""DM12: what reaches the base, against what the Safety Pilot was asked for and says it does."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.detection.pilot_output_monitor import PilotOutputMonitor

PERIOD_S = 0.05


class Bench:
    """A pilot that is fed one command a period, and what it makes of it."""

    def __init__(self) -> None:
        self.monitor = PilotOutputMonitor("safety_pilot", 0.0, 5.0)
        self.now = 0.0
        self.life = 1
        self.monitor.said(stopped=False, reason="", now_s=0.0)
        self.drive(10)

    def drive(self, ticks, asked=(0.8, 0.1), sent=None, *, first="asked", age_s=0.0):
        """Let periods pass. `sent` None: what was asked; False: nothing is sent."""
        for _ in range(ticks):
            self.now += PERIOD_S
            got = asked if sent is None else sent
            if first == "asked":
                self.monitor.asked(*asked, self.now)
            if got is not False:
                self.monitor.sent(*got, self.now - age_s, self.life, self.now)
            if first == "sent":
                self.monitor.asked(*asked, self.now + 0.001)
            while self.monitor.due_s <= self.now:
                self.monitor.expire(self.monitor.due_s)
        return self.monitor.active

    def says(self, reason, *, stopped=False):
        self.monitor.said(stopped=stopped, reason=reason, now_s=self.now)


def test_what_was_asked_for_may_pass():
    assert not Bench().drive(40)


def test_also_when_the_output_is_heard_before_the_command_that_it_follows():
    bench = Bench()
    for tick in range(40):
        bench.drive(1, (0.8, 0.04 * tick), first="sent")
    assert not bench.monitor.active


@pytest.mark.parametrize("sent", [(1.3, 0.1), (0.8, 0.6), (0.8, -0.4), (0.5, 0.1), (-0.8, 0.1)])
def test_what_nobody_asked_for_accuses_the_pilots_life_within_a_fifth_of_a_second(sent):
    bench = Bench()
    assert bench.drive(4, sent=sent)
    assert bench.monitor.nodes == ("safety_pilot#1",)
    assert "nobody has asked for" in bench.monitor.reason


def test_one_strange_message_is_a_race():
    bench = Bench()
    bench.drive(1, sent=(0.2, 0.9))
    assert not bench.drive(5)


def test_while_it_says_that_an_obstacle_slows_the_robot_it_may_send_less_but_not_more():
    bench = Bench()
    bench.says("obstacle: slowed down")
    assert not bench.drive(40, sent=(0.3, 0.05))
    assert bench.drive(5, sent=(0.9, 0.1))


def test_while_it_says_that_it_stops_it_must_not_drive():
    bench = Bench()
    bench.says("RM2: because", stopped=True)
    assert not bench.drive(20, sent=(0.0, 0.0))
    assert bench.drive(5)
    assert "says that it stops" in bench.monitor.reason


def test_its_word_may_follow_its_deed():
    bench = Bench()
    bench.drive(3, sent=(0.3, 0.1), asked=(0.3, 0.1))
    bench.says("", stopped=True)
    assert not bench.drive(3)


def test_standstill_needs_no_explanation():
    assert not Bench().drive(40, sent=(0.0, 0.0))


@pytest.mark.parametrize(("what", "arguments"), [
    ("it is silent", {"sent": False}), ("it sends old news", {"age_s": 0.4})])
def test_a_pilot_that_is_late_is_accused_before_the_dead_man_trips(what, arguments):
    bench = Bench()
    assert not bench.drive(5, **{**arguments, **({"age_s": 0.2} if "age_s" in arguments else {})})
    assert bench.drive(2, **arguments), what
    assert "no fresh command" in bench.monitor.reason


def test_a_new_life_that_is_well_for_half_a_second_clears_it():
    bench = Bench()
    bench.drive(5, sent=(1.3, 0.1))
    bench.life = 2
    assert bench.drive(9)
    assert not bench.drive(4)
    assert bench.monitor.nodes == ()


def test_a_new_life_that_is_as_wrong_is_accused_by_its_own_number():
    bench = Bench()
    bench.drive(5, sent=(1.3, 0.1))
    bench.life = 2
    assert bench.drive(6, sent=(1.3, 0.1))
    assert bench.monitor.nodes == ("safety_pilot#2",)


def test_before_the_system_runs_silence_is_start_up_and_then_it_is_not():
    monitor = PilotOutputMonitor("safety_pilot", 0.0, 5.0)
    assert monitor.due_s == 5.0
    monitor.expire(5.0)
    assert monitor.active


shares = st.floats(0.0, 1.0)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(st.floats(-1, 1), st.floats(-2, 2), shares, shares), max_size=30))
def test_a_pilot_that_only_takes_away_and_says_so_is_never_accused(steps):
    bench = Bench()
    bench.says("obstacle: slowed down")
    for linear, angular, less, turn in steps:
        assert not bench.drive(1, (linear, angular), (linear * less, angular * turn))
