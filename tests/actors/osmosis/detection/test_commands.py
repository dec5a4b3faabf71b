"""DM2, DM3, DM6, DM9, DM12, DM13: what is wrong with commands, and who does not follow them."""

from __future__ import annotations

import asyncio
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.detection.freshness import Freshness, FreshnessMonitor
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.control.pilot.safety_pilot import SafetyPilot
from rampart.actors.osmosis.detection.actuator_failure import ActuatorMonitor, MotionLimits
from rampart.actors.osmosis.detection.bounds import beyond
from rampart.actors.osmosis.detection.command_disagreement import (
    CommandComparison,
    ComparisonLimits,
)
from rampart.actors.osmosis.detection.pilot_output import (
    PilotLimits,
    PilotOutput,
    PilotOutputMonitor,
)
from rampart.testing import Ear, play, table
from tests.actors.osmosis.control.world import full_sweep
from tests.manager.bench import full_system
from tests.osmosis_system import COMMAND, POSE, in_system


@given(st.floats(), st.floats())
def test_active_if_and_only_if_the_command_is_out_of_bounds(linear, angular):
    fault = beyond(linear, angular, 1.0, 2.0)
    outside = not abs(linear) <= 1.0 + 2.1e-6 or not abs(angular) <= 2.0 + 3.1e-6
    inside = abs(linear) <= 1.0 and abs(angular) <= 2.0
    assert fault or not outside
    assert not (fault and inside)


# ---- DM9 ----------------------------------------------------------------------------------------

PAIR_LIMITS = ComparisonLimits(angular_s=0.3, linear_s=0.6, hold_s=0.2, forget_s=1.0)
GOOD, TURNS, SLOW = (0.8, 0.0), (0.8, 0.9), (0.2, 0.0)
PAIRS = {
    "=": (GOOD, GOOD), "w": (GOOD, TURNS), "W": (TURNS, GOOD), "v": (GOOD, SLOW),
    "~": ((0.8, 0.1), (0.7, -0.1)), "a": (GOOD, None), "s": (None, GOOD),
    "n": (GOOD, (math.nan, 0.0)),
}
SOURCES = ("standby", "active")


class PairBench:
    """A comparison and the incarnations of its sources."""

    def __init__(self, **changes) -> None:
        self.comparison = CommandComparison(SOURCES, PAIR_LIMITS, **changes)
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
    assert PairBench().play(events) == expected


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
    bench = PairBench()
    bench.play(events)
    assert bench.comparison.nodes == accused


def test_a_respawned_comparison_claims_nothing_before_it_knows():
    assert PairBench(known_after_s=0.2).play(".=") == "?-"
    assert PairBench(known_after_s=0.2).play("aaaa") == "??--", "one alone is no pair"


@given(st.text("=wv1a", max_size=30))
def test_active_and_an_accused_life_go_together(events):
    bench = PairBench()
    bench.play(events)
    assert bool(bench.comparison.nodes) == bench.comparison.active


# ---- DM12: the outputs of the Safety Pilot -------------------------------------------------------

PERIOD_S = 0.05
HELD_S = 0.99


class PilotBench:
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
    bench = PilotBench()
    for tick in range(40):
        assert not bench.drive(1, (0.8, 0.04 * tick), first="sent")


@pytest.mark.parametrize("sent", [(1.3, 0.1), (0.8, -0.4), (0.5, 0.1)])
def test_what_nobody_asked_for_accuses_the_pilots_life_within_a_fifth_of_a_second(sent):
    bench = PilotBench()
    bench.drive(1, sent=sent)
    assert not bench.drive(5), "one strange message is a race"
    assert bench.drive(4, sent=sent)
    assert bench.monitor.nodes == ("safety_pilot#1",)
    assert "which no command explains" in bench.monitor.reason


@pytest.mark.parametrize(("reason", "stopped", "borne", "wrong"), [
    ("obstacle: slowed down", False, (0.3, 0.05), (0.9, 0.1)),  # it may send less, but not more
    ("RM2: because", True, (0.0, 0.0), (0.8, 0.1))])  # it must not drive
def test_its_output_is_as_its_status_says(reason, stopped, borne, wrong):
    bench = PilotBench()
    bench.drive(3, (0.3, 0.1))
    bench.says(reason, stopped=stopped)
    assert not bench.drive(3, (0.3, 0.1)), "its word may follow its deed"
    assert not bench.drive(20, sent=borne)
    assert bench.drive(5, sent=wrong)


@pytest.mark.parametrize("late", [
    {"sent": False}, {"age_s": 0.4}, {"age_s": -1e9}, {"age_s": math.nan}])
def test_a_pilot_that_is_late_is_accused_before_the_dead_man_trips(late):
    bench = PilotBench()
    assert not bench.drive(5, **{**late, **({"age_s": 0.2} if late == {"age_s": 0.4} else {})})
    assert bench.drive(2, **late)
    assert "no fresh command" in bench.monitor.reason


def test_a_new_life_that_is_well_for_half_a_second_clears_it():
    bench = PilotBench()
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
    bench = PilotBench()
    bench.drive(1, (0.7, 0.2), by="standby")
    last_s = bench.now
    while not bench.drive(1, sent=sent, first="nobody"):
        assert bench.now - last_s < HELD_S + 0.2
    assert bench.now - last_s > HELD_S - PERIOD_S
    other = PilotBench()
    other.drive(6, sent=(0.8, 0.1), first="nobody")
    assert other.drive(4, sent=(0.9, 0.1), first="nobody"), "but not with another"


def test_a_command_explains_no_longer_when_a_new_one_came_or_when_it_was_a_joysticks():
    stuck = PilotBench()
    assert not stuck.drive(6, (0.3, -0.4), (0.8, 0.1))
    assert stuck.drive(4, (0.3, -0.4), (0.8, 0.1))
    bench = PilotBench()
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
    bench = PilotBench()
    bench.says("obstacle: slowed down")
    for linear, angular, less, turn in steps:
        assert not bench.drive(1, (linear, angular), (linear * less, angular * turn))


# ---- DM13: wheels or a brake that do not follow --------------------------------------------------

MOTION_LIMITS = MotionLimits(hold_s=5.0)
RADIUS_M = MOTION_LIMITS.wheel_radius_m
STATUS_S = 0.1


class BaseBench:
    def __init__(self) -> None:
        self.monitor = ActuatorMonitor(MOTION_LIMITS)
        self.now = 0.0

    def run(self, seconds, treads=(0.8, 0.8, 0.8, 0.8), command=(0.8, 0.0), ground=None,
            braking=False):
        """Let time pass with the same wheels, command, speed over ground and brake."""
        for _ in range(round(seconds / STATUS_S)):
            self.now += STATUS_S
            self.monitor.commanded(*command, self.now)
            if ground is not None:
                self.monitor.moved(ground, 0.0, self.now)
            self.monitor.status(tuple(t / RADIUS_M for t in treads), braking=braking,
                                now_s=self.now)
            while self.monitor.due_s <= self.now:
                self.monitor.expire(self.monitor.due_s)
        return self.monitor.active


@pytest.mark.parametrize("kept", [
    {"ground": 0.8}, {"treads": (0.0,) * 4, "braking": True},
    *({"treads": treads, "command": (0.6, 0.9), "ground": 0.6}  # its two sides differ rightly
      for treads in ((0.2, 1.0, 0.2, 1.0), (-0.5, 0.5, -0.5, 0.5))),
    *({"treads": (nonsense, 0.8, 0.8, 0.8)} for nonsense in (math.nan, math.inf))])
def test_a_sound_base_is_left_alone(kept):
    assert not BaseBench().run(10, **kept)


@pytest.mark.parametrize(("treads", "wheel"), [
    ((0.0, 0.8, 0.8, 0.8), "front left"), ((0.8, 0.0, 0.8, 0.8), "front right"),
    ((0.8, 0.8, 0.5, 0.8), "rear left"), ((-0.6, 0.6, -0.6, 0.3), "rear right")])
def test_a_wheel_that_does_not_keep_up_is_named_within_a_second(treads, wheel):
    bench = BaseBench()
    assert bench.run(0.9, treads)
    assert bench.monitor.reason == f"the {wheel} wheel lags behind its neighbour"


def test_a_jolt_is_no_failure():
    bench = BaseBench()
    for _ in range(10):
        bench.run(0.3, (0.2, 0.8, 0.8, 0.8))
        assert not bench.run(0.2)


def test_a_speed_over_ground_that_is_not_the_one_commanded_is_seen():
    bench = BaseBench()
    assert not bench.run(1.5, ground=0.3), "the wheels turn"
    assert bench.run(1.0, ground=0.3)
    other = BaseBench()
    other.run(3, ground=0.8)
    assert other.run(3, command=(0.0, 0.0), ground=0.8), "it goes on when it should stand"


def test_while_the_command_changes_the_speed_is_the_ramps_business():
    bench = BaseBench()
    for step in range(30):
        assert not bench.run(0.1, command=(0.03 * step, 0.0), ground=max(0.0, 0.03 * step - 0.3))


@pytest.mark.parametrize(("deceleration", "found"), [(2.0, False), (5.0, False), (0.4, True)])
def test_a_brake_is_judged_while_it_is_on(deceleration, found):
    bench = BaseBench()
    bench.run(1.0)
    for tick in range(8):
        speed = max(0.0, 0.8 - deceleration * tick * STATUS_S)
        bench.run(STATUS_S, (speed,) * 4, braking=True)
    assert bench.monitor.active is found
    assert ("brake" in bench.monitor.reason) is found


def test_a_finding_stays_a_while_after_the_last_evidence():
    bench = BaseBench()
    bench.run(1.0, (0.0, 0.8, 0.8, 0.8))
    assert bench.run(4.5)
    assert not bench.run(1.0)


@given(st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1)), min_size=1, max_size=30))
def test_neighbours_that_turn_alike_are_never_accused(sides):
    bench = BaseBench()
    for left, right in sides:
        assert not bench.run(STATUS_S, (left, right, left, right), (left, right - left))


# ---- within_s of the shipped spec: each in its slowest case --------------------------------------

PROMISED_S = {detection.name: detection.within_s for detection in full_system().detections}
RESPAWN_S = full_system().timing.respawn_s


def compare(active: tuple[float, float], standby: tuple[float, float]) -> list[float]:
    """Return when DM9 names one instance and then the other; the active one is wrong."""
    monitor = CommandComparison(("standby_control", "osmosis_control"))
    accused_s: dict[tuple[str, ...], float] = {}
    standby_life, back_s = 1, 0.0
    for tick in range(200):
        now_s = tick * PERIOD_S
        monitor.take("osmosis_control", active, now_s, 1, now_s)
        if now_s >= back_s:
            monitor.take("standby_control", standby, now_s, standby_life, now_s)
        if monitor.nodes and monitor.nodes not in accused_s:
            accused_s[monitor.nodes] = now_s
            if len(accused_s) == 1:  # it is respawned
                standby_life, back_s = 2, now_s + RESPAWN_S
    assert list(accused_s) == [("standby_control#1",), ("osmosis_control#1",)]
    return list(accused_s.values())


def test_dm9_knows_which_speed_is_wrong_in_its_time_and_a_turn_rate_far_sooner():
    first_s, second_s = compare((0.9, 0.0), (0.4, 0.0))
    assert 2.0 <= first_s < second_s
    # The respawn between the two is the budget's, which counts one for each recovery.
    assert second_s - RESPAWN_S <= PROMISED_S["DM9"] <= second_s - RESPAWN_S + 0.2
    first_s, second_s = compare((0.5, 0.9), (0.5, 0.0))
    assert second_s < 2.0


@pytest.mark.parametrize("stuck", [(0.8, 0.0), (0.0, 0.7)])
def test_dm12_finds_an_output_that_is_stuck_in_its_time(stuck):
    monitor = PilotOutputMonitor("safety_pilot", 0.0, 5.0)
    found_s = None
    for tick in range(60):
        now_s = tick * PERIOD_S
        monitor.commanded(*(stuck if now_s < 1.0 else (0.0, 0.0)), now_s)
        monitor.sent(*stuck, now_s, 1, now_s)
        if monitor.active and found_s is None:
            found_s = now_s
    last_asked_s = 1.0 - PERIOD_S
    assert found_s - last_asked_s <= PROMISED_S["DM12"] + 1e-9
    assert found_s - last_asked_s > 0.5 * PROMISED_S["DM12"]


def test_dm13_finds_a_speed_that_is_not_the_one_commanded_in_its_time_and_a_wheel_sooner():
    wheel_radps = 0.8 / 0.1175

    def found_s(first_radps: float, ground_mps: float) -> float:
        monitor, now_s = ActuatorMonitor(), 0.0
        while not monitor.active:
            now_s += PERIOD_S
            monitor.commanded(0.8, 0.0, now_s)
            monitor.moved(ground_mps, 0.0, now_s)
            monitor.status((first_radps, *(wheel_radps,) * 3), braking=False, now_s=now_s)
            assert now_s < 5.0
        return now_s

    assert 0.8 * PROMISED_S["DM13"] < found_s(wheel_radps, 0.3) <= PROMISED_S["DM13"]
    assert found_s(0.0, 0.8) <= 0.65


# ---- DM2, DM6: a topic that goes stale, by the stamps of its samples -----------------------------

# f fresh sample, o the first sample once more, d delayed by 1 s, + stamped 100 s ahead,
# i infinitely far ahead, n no number
TIMELINES = {
    "it stops and goes on": ("ff......fff.", "----AAAAAA--"),
    "it never comes: the start is forgiven for 500 ms, no longer": (".......", "-----AA"),
    "a frozen source repeats its old sample": ("ffoooooooo", "----AAAAAA"),
    "a link delivers every sample a second late": ("fddddddd", "---AAAAA"),
    "it stutters just inside the timeout": ("f..f..f..f", "----------"),
    "the hold starts anew when it goes stale in between": ("f...f....fff", "---AAAAAAAA-"),
    "samples that come too rarely are not enough": ("f....f...f...f", "---AAAAAAAAAAA"),
    "a stamp from the future is not a sample": ("+++++++", "-----AA"),
    "a source with a wrong clock is not fresh for ever": ("f++++++", "---AAAA"),
    "a stamp from the future does not make honest ones look old": ("+f+fffff", "--------"),
    "nor is one that is no number or infinite": ("fninin", "---AAA"),
}


def stamp(event: str, now_s: float) -> float:
    return {"f": now_s, "o": 0.0, "d": now_s - 1.0, "+": now_s + 100.0, "n": math.nan,
            "i": math.inf}[event]


@pytest.mark.parametrize(("events", "expected"), **table(TIMELINES))
def test_freshness_timeline(events, expected):
    monitor = FreshnessMonitor("command", timeout_s=0.3, hold_s=0.2, start_s=0.0, grace_s=0.5)
    assert play(monitor, lambda e, t: monitor.heard(stamp(e, t), t), events) == expected


@in_system()
async def test_the_actor_reports_at_once_and_repeats_what_has_not_changed_each_second(system):
    ear = system.start("ear", Ear)
    dm2 = system.start("DM2", Freshness, **COMMAND, timeout_s=0.3)
    await asyncio.sleep(0.01)
    assert ear.states == ["idle"]
    system.say(topics.COMMAND, m.Twist(0.5, 0.0))
    sent_s = system.clock.now()
    await asyncio.sleep(2.0)
    first = next(at for at, report in ear.heard if report.state == "active")
    assert first == pytest.approx(sent_s + 0.3, abs=1e-6)
    assert len(ear.heard) == pytest.approx(2.0 + 1, abs=1)
    for _ in range(10):
        system.say(topics.COMMAND, m.Twist(0.5, 0.0))
        await asyncio.sleep(0.05)
    assert ear.states == ["idle", "active", "idle"]
    assert dm2.state is fm.DetectionState.IDLE
    assert ear.heard[-1][1].reason == ""


@in_system()
async def test_it_names_the_suspected_node_and_the_life_that_was_heard_last(system):
    ear = system.start("ear", Ear)
    system.start("DM6", Freshness, **POSE, timeout_s=0.3, suspects=["localization"])
    system.start("DM2", Freshness, **COMMAND, timeout_s=0.3, suspects=["osmosis_control"])
    await system.settle()
    for _ in range(5):
        system.say(topics.POSE, m.Pose(0.0, 0.0, 0.0), "localization", incarnation=2)
        await asyncio.sleep(0.1)
    await asyncio.sleep(5.0)
    named = {report.reason: report.nodes for _, report in ear.heard if report.reason}
    assert named == {"localization not updated for 0.3 s": ("localization#2",),
                     "command never heard": ("osmosis_control",)}
