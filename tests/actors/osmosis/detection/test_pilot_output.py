"""DM12: the base's commands against the inputs and the status of the Safety Pilot."""

from __future__ import annotations

import asyncio
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart import systems
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
from rampart.manager.spec.specification import parse_specification
from rampart.testing import Ear, run
from tests.actors.osmosis.control.laser_sweeps import full_sweep
from tests.osmosis_system import System

PERIOD_S = 0.05
HELD_S = 0.99
OSMOSIS = parse_specification(
    (systems.SHIPPED / "osmosis.toml").read_text(encoding="utf-8"), "osmosis.toml")


class Bench:
    """A pilot that is fed one command a period, and what it makes of it."""

    def __init__(self) -> None:
        self.monitor = PilotOutputMonitor("safety_pilot", 0.0, 5.0, PilotLimits(held_s=HELD_S))
        self.now = 0.0
        self.life = 1
        self.monitor.status(stopped=False, reason="", now_s=0.0)
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
        bench.drive(1, (0.8, 0.04 * tick), first="sent")
    assert not bench.monitor.active


@pytest.mark.parametrize("sent", [(1.3, 0.1), (0.8, 0.6), (0.8, -0.4), (0.5, 0.1), (-0.8, 0.1)])
def test_what_nobody_asked_for_accuses_the_pilots_life_within_a_fifth_of_a_second(sent):
    bench = Bench()
    assert bench.drive(4, sent=sent)
    assert bench.monitor.nodes == ("safety_pilot#1",)
    assert "which no command explains" in bench.monitor.reason


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
    assert "reports a stop" in bench.monitor.reason


def test_its_word_may_follow_its_deed():
    bench = Bench()
    bench.drive(3, sent=(0.3, 0.1), asked=(0.3, 0.1))
    bench.says("", stopped=True)
    assert not bench.drive(3)


@pytest.mark.parametrize(("what", "arguments"), [
    ("it is silent", {"sent": False}), ("it sends old news", {"age_s": 0.4}),
    ("its stamps are of the future", {"age_s": -1e9}),
    ("its stamps are infinite", {"age_s": -math.inf}),
    ("its stamps are no numbers", {"age_s": math.nan})])
def test_a_pilot_that_is_late_is_accused_before_the_dead_man_trips(what, arguments):
    bench = Bench()
    bearable = {"age_s": 0.2} if arguments.get("age_s") == 0.4 else {}
    assert not bench.drive(5, **{**arguments, **bearable})
    assert bench.drive(2, **arguments), what
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
    assert not bench.drive(18, sent=sent, first="nobody")


def test_a_pilot_that_goes_on_for_longer_is_accused():
    bench = Bench()
    last_s = bench.now
    while not bench.drive(1, sent=(0.8, 0.1), first="nobody"):
        assert bench.now - last_s < HELD_S + 0.2
    assert bench.now - last_s > HELD_S
    assert "which no command explains" in bench.monitor.reason


def test_while_nobody_asks_it_may_not_send_anything_else():
    bench = Bench()
    bench.drive(6, sent=(0.8, 0.1), first="nobody")
    assert bench.drive(4, sent=(0.9, 0.1), first="nobody")


def test_a_pilot_that_is_stuck_at_an_old_command_is_accused_as_soon_while_new_ones_come():
    """A command that another one of the same computer has replaced explains nothing for long."""
    bench = Bench()
    assert not bench.drive(6, (0.3, -0.4), (0.8, 0.1))
    assert bench.drive(4, (0.3, -0.4), (0.8, 0.1))


def test_what_a_joystick_asked_for_last_is_not_held():
    bench = Bench()
    bench.says("the joystick pre-empts")
    bench.drive(20, (-0.2, 0.5), by="")
    assert bench.drive(10, sent=(-0.2, 0.5), first="nobody")


def test_a_respawned_module_claims_nothing_of_a_pilot_whose_output_is_old_when_it_is_heard():
    monitor = PilotOutputMonitor("safety_pilot", 10.0, 0.3, known=False)
    monitor.sent(0.0, 0.0, 9.0, 1, 10.01)
    assert not monitor.known
    monitor.sent(0.0, 0.0, 1e9, 1, 10.02)
    assert not monitor.known
    monitor.sent(0.0, 0.0, 10.03, 1, 10.03)
    assert (monitor.known, monitor.active) == (True, False)


@pytest.mark.parametrize("silent_s", [0.5, 5.0])
def test_a_sound_pilot_is_not_accused_when_both_computers_of_the_command_fall_silent(silent_s):
    """With the pilot itself, and the timeout of the shipped system."""

    async def scenario():
        async with System(system=OSMOSIS) as system:
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
            return ear.states

    assert run(scenario) == ["idle"]


def test_before_the_system_runs_silence_is_start_up_and_then_it_is_not():
    monitor = PilotOutputMonitor("safety_pilot", 0.0, 5.0)
    assert monitor.due_s == 5.0
    monitor.expire(5.0)
    assert monitor.active


shares = st.floats(0.0, 1.0)


@given(st.lists(st.tuples(st.floats(-1, 1), st.floats(-2, 2), shares, shares), max_size=30))
def test_a_pilot_that_only_takes_away_and_says_so_is_never_accused(steps):
    bench = Bench()
    bench.says("obstacle: slowed down")
    for linear, angular, less, turn in steps:
        assert not bench.drive(1, (linear, angular), (linear * less, angular * turn))
