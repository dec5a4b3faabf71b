"""DM12: the base's commands against the inputs and the status of the Safety Pilot."""

from __future__ import annotations

import asyncio
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.control.pilot.safety_pilot import SafetyPilot
from rampart.actors.osmosis.detection.pilot_output import (
    PilotLimits,
    PilotOutput,
    PilotOutputMonitor,
)
from rampart.testing import Ear
from tests.actors.osmosis.control.laser_sweeps import full_sweep
from tests.manager.bench import full_system
from tests.osmosis_system import in_system

PERIOD_S = 0.05
HELD_S = 0.99


class Bench:
    """A pilot that is fed one command a period, and what it makes of it."""

    def __init__(self) -> None:
        self.monitor = PilotOutputMonitor("safety_pilot", 0.0, 5.0, PilotLimits(held_s=HELD_S))
        self.now = 0.0
        self.life = 1
        self.says("")
        self.drive(10)

    def drive(self, ticks, asked=(0.8, 0.1), sent=None, *, first="asked", age_s=0.0,
              by="active"):
        """Let periods pass. `sent` None: what was asked; False: nothing is sent."""
        for _ in range(ticks):
            self.now += PERIOD_S
            got = asked if sent is None else sent
            if first == "asked":
                self.monitor.commanded(*asked, self.now, by)
            if got is not False:
                self.monitor.sent(*got, self.now - age_s, self.life, self.now)
            if first == "sent":
                self.monitor.commanded(*asked, self.now + 0.001, by)
            while self.monitor.due_s <= self.now:
                self.monitor.expire(self.monitor.due_s)
        return self.monitor.active

    def says(self, reason, *, stopped=False):
        self.monitor.status(stopped=stopped, reason=reason, now_s=self.now)


def test_also_when_the_output_is_heard_before_the_command_that_it_follows():
    bench = Bench()
    for tick in range(40):
        assert not bench.drive(1, (0.8, 0.04 * tick), first="sent")


@pytest.mark.parametrize("sent", [(1.3, 0.1), (0.8, -0.4), (0.5, 0.1)])
def test_what_nobody_asked_for_accuses_the_pilots_life_within_a_fifth_of_a_second(sent):
    bench = Bench()
    bench.drive(1, sent=sent)
    assert not bench.drive(5), "one strange message is a race"
    assert bench.drive(4, sent=sent)
    assert bench.monitor.nodes == ("safety_pilot#1",)
    assert "which no command explains" in bench.monitor.reason


@pytest.mark.parametrize(("reason", "stopped", "borne", "wrong"), [
    ("obstacle: slowed down", False, (0.3, 0.05), (0.9, 0.1)),  # it may send less, but not more
    ("RM2: because", True, (0.0, 0.0), (0.8, 0.1))])  # it must not drive
def test_its_output_is_as_its_status_says(reason, stopped, borne, wrong):
    bench = Bench()
    bench.drive(3, (0.3, 0.1))
    bench.says(reason, stopped=stopped)
    assert not bench.drive(3, (0.3, 0.1)), "its word may follow its deed"
    assert not bench.drive(20, sent=borne)
    assert bench.drive(5, sent=wrong)


@pytest.mark.parametrize("late", [
    {"sent": False}, {"age_s": 0.4}, {"age_s": -1e9}, {"age_s": math.nan}])
def test_a_pilot_that_is_late_is_accused_before_the_dead_man_trips(late):
    bench = Bench()
    assert not bench.drive(5, **{**late, **({"age_s": 0.2} if late == {"age_s": 0.4} else {})})
    assert bench.drive(2, **late)
    assert "no fresh command" in bench.monitor.reason


def test_a_new_life_that_is_well_for_half_a_second_clears_it():
    bench = Bench()
    bench.drive(5, sent=(1.3, 0.1))
    bench.life = 2
    assert bench.drive(9)
    assert not bench.drive(4)
    assert bench.monitor.nodes == ()
    assert not bench.drive(40, sent=(0.0, 0.0)), "standstill needs no explanation"
    bench.life = 3
    assert bench.drive(6, sent=(1.3, 0.1))
    assert bench.monitor.nodes == ("safety_pilot#3",), "one that is as wrong"


@pytest.mark.parametrize("sent", [(0.8, 0.1), (0.7, 0.2)], ids=["active", "standby"])
def test_when_nobody_asks_any_more_the_pilot_may_go_on_with_a_last_command_for_its_timeout(sent):
    bench = Bench()
    bench.drive(1, (0.7, 0.2), by="standby")
    last_s = bench.now
    while not bench.drive(1, sent=sent, first="nobody"):
        assert bench.now - last_s < HELD_S + 0.2
    assert bench.now - last_s > HELD_S - PERIOD_S
    other = Bench()
    other.drive(6, sent=(0.8, 0.1), first="nobody")
    assert other.drive(4, sent=(0.9, 0.1), first="nobody"), "but not with another"


def test_a_command_explains_no_longer_when_a_new_one_came_or_when_it_was_a_joysticks():
    stuck = Bench()
    assert not stuck.drive(6, (0.3, -0.4), (0.8, 0.1))
    assert stuck.drive(4, (0.3, -0.4), (0.8, 0.1))
    bench = Bench()
    bench.says("the joystick pre-empts")
    bench.drive(20, (-0.2, 0.5), by="")
    assert bench.drive(10, sent=(-0.2, 0.5), first="nobody")


def test_a_module_claims_nothing_before_it_has_heard_a_fresh_output_or_waited():
    monitor = PilotOutputMonitor("safety_pilot", 10.0, 0.3, known=False)
    for stamp_s, now_s, known in ((9.0, 10.01, False), (1e9, 10.02, False), (10.03, 10.03, True)):
        monitor.sent(0.0, 0.0, stamp_s, 1, now_s)
        assert (monitor.known, monitor.active) == (known, False)
    first = PilotOutputMonitor("safety_pilot", 0.0, 5.0)
    assert first.due_s == 5.0
    first.expire(5.0)
    assert first.active


@pytest.mark.parametrize("silent_s", [0.5, 5.0])
@in_system(system=full_system())
async def test_a_sound_pilot_is_not_accused_when_both_computers_of_the_command_fall_silent(
        system, silent_s):
    """With the pilot itself, and the timeout of the shipped system."""
    ear = system.start("ear", Ear)
    system.start("safety_pilot", SafetyPilot)
    system.start("DM12", PilotOutput)
    await system.settle()
    told = fm.ManagerStatus((), (), (), (), "safety-first", 0)
    for i in range(round((3.0 + silent_s) * 20)):
        system.say(ftm_topics.MANAGER_STATUS, told)
        system.say(topics.SCAN, full_sweep(number=i))
        if i < 40 or i >= 40 + silent_s * 20:
            system.say(topics.COMMAND, m.Twist(0.8, 0.1), "osmosis_control")
            system.say(topics.STANDBY_COMMAND, m.Twist(0.8, 0.1), "standby_control")
        await asyncio.sleep(PERIOD_S)
    assert ear.states == ["idle"]


shares = st.floats(0.0, 1.0)


@given(st.lists(st.tuples(st.floats(-1, 1), st.floats(-2, 2), shares, shares), max_size=30))
def test_a_pilot_that_only_takes_away_and_says_so_is_never_accused(steps):
    bench = Bench()
    bench.says("obstacle: slowed down")
    for linear, angular, less, turn in steps:
        assert not bench.drive(1, (linear, angular), (linear * less, angular * turn))
