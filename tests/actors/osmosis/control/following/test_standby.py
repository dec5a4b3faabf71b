"""Two computers of one command: who drives, what when they disagree, and what a standby follows."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.bus.envelope import Header
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.control.following.light_row import LightRow, RowLimits
from rampart.actors.osmosis.control.following.motion_loop import (
    DEAD_BAND_RADPS,
    MOST_RADPS,
    MotionLoop,
)
from rampart.actors.osmosis.control.pilot.command_pair import FORGET_S, CommandPair
from rampart.actors.osmosis.control.pilot.safety_gate import Checks, GateLimits, SafetyGate
from rampart.actors.osmosis.control.polyline import NO_POINTS
from rampart.actors.osmosis.messages import PilotMode

PERIOD_S = 0.05


class Bench:
    """A gate in good health, fed each 50 ms with the commands that a test names."""

    def __init__(self, checks: Checks | None = None) -> None:
        self.gate = SafetyGate(GateLimits(), checks or Checks(), 0.0)
        self.now = 1.0
        self.sequence = 0
        self.lives = {"osmosis_control": 1, "standby_control": 1}

    def send(self, source, command, age_s=0.0):
        self.sequence += 1
        take = self.gate.command if source == "osmosis_control" else self.gate.standby
        header = Header(source, self.lives[source], self.sequence, self.now - age_s)
        return take(m.Twist(*command), header, self.now)

    def tick(self, active=None, standby=None, ticks=1, age_s=0.0):
        """Let periods pass; None is silence."""
        for _ in range(ticks):
            self.now += PERIOD_S
            self.gate.manager_alive(self.now, 1)
            self.gate.scan(NO_POINTS, self.now)
            if active is not None:
                self.send("osmosis_control", active, age_s)
            if standby is not None:
                self.send("standby_control", standby)
        return self

    @property
    def out(self):
        output = self.gate.output(self.now)
        return output.linear_mps, output.angular_radps

    @property
    def reason(self):
        return self.gate.output(self.now).reason


@pytest.mark.parametrize("bad", [(3.0, 0.0), (0.0, 9.0), (math.nan, 0.0)])
def test_when_the_active_ones_command_is_refused_the_standby_drives_until_it_is_good_again(bad):
    bench = Bench().tick((0.8, 0.0), (0.7, 0.0), ticks=20)
    bench.send("osmosis_control", bad)
    assert bench.out == (0.7, 0.0)
    assert bench.reason.startswith("standby drives: command")
    bench.tick((0.8, 0.0), (0.7, 0.0), ticks=9)
    assert bench.reason == "standby drives: osmosis control has just recovered"
    bench.tick((0.8, 0.0), (0.7, 0.0), ticks=3)
    assert (bench.out, bench.reason) == ((0.8, 0.0), "")


def test_when_the_active_one_is_silent_for_four_periods_the_standby_drives():
    bench = Bench().tick((0.8, 0.0), (0.7, 0.0), ticks=20)
    assert bench.tick(None, (0.7, 0.0), ticks=4).out == (0.8, 0.0)
    assert bench.tick(None, (0.7, 0.0)).out == (0.7, 0.0)
    assert bench.reason == "standby drives: no fresh command"


def test_a_source_that_stutters_does_not_take_the_wheel_back_between_two_bad_commands():
    bench = Bench().tick((0.8, 0.0), (0.7, 0.0), ticks=20)
    for _ in range(20):
        assert bench.tick((3.0, 0.0), (0.7, 0.0)).out == (0.7, 0.0)
        assert bench.tick((0.8, 0.0), (0.7, 0.0), ticks=4).out == (0.7, 0.0)


def test_while_a_respawned_follower_accelerates_from_zero_the_standby_drives_on():
    bench = Bench().tick((0.8, 0.0), (0.8, 0.0), ticks=20)
    bench.lives["osmosis_control"] = 2
    for tick in range(25):
        assert bench.tick((0.04 * tick, 0.0), (0.8, 0.0)).out == (0.8, 0.0)
    assert bench.tick((0.8, 0.0), (0.8, 0.0), ticks=8).reason == ""


@pytest.mark.parametrize(("active", "standby", "driven"), [
    ((0.8, -0.7), (0.8, 0.2), (0.3, 0.2)),
    ((0.8, 0.2), (0.8, -0.7), (0.3, 0.2)),
    ((1.0, 0.0), (0.2, 1.0), (0.2, 0.0)),
    ((0.1, 0.5), (0.8, 0.5), (0.1, 0.5)),
])
def test_when_they_disagree_the_gentler_of_each_component_drives_and_slowly(
        active, standby, driven):
    bench = Bench().tick((0.8, 0.0), (0.8, 0.0), ticks=20)
    bench.tick(active, standby, ticks=5)
    assert bench.out == driven
    assert bench.reason == "active and standby disagree"
    bench.tick((0.8, 0.0), (0.8, 0.0), ticks=9)
    assert (bench.out, bench.reason) == ((0.8, 0.0), "")


def test_doubt_outlasts_the_respawn_of_one_and_ends_when_nobody_is_left_to_compare():
    bench = Bench().tick((0.8, 0.0), (0.8, 0.0), ticks=20)
    bench.tick((0.8, 0.9), (0.8, 0.0), ticks=6)
    bench.tick((0.8, 0.9), ticks=40)
    assert bench.out == (0.3, 0.9)
    bench.tick((0.8, 0.9), ticks=round(FORGET_S / PERIOD_S))
    assert bench.out == (0.8, 0.9)


commands = st.one_of(st.none(), st.tuples(st.floats(-1, 1), st.floats(-2, 2)))


@given(st.lists(st.tuples(commands, commands, st.booleans(), st.booleans()), max_size=25))
def test_whatever_comes_what_drives_lies_between_zero_and_what_one_of_the_two_wants(steps):
    pair, now, lives = CommandPair(), 0.0, [1, 1]
    last = [None, None]
    for active, standby, active_dies, standby_dies in steps:
        now += PERIOD_S
        lives = [lives[0] + active_dies, lives[1] + standby_dies]
        pair.active(active, now, lives[0], now)
        pair.standby(standby, now, lives[1], now)
        last = [active, standby]
        driven, _ = pair.choice((active, "refused"), standby, now)
        assert (driven is None) == (last == [None, None])
        for index in (0, 1) if driven is not None else ():
            wants = [c[index] for c in last if c is not None]
            assert any(min(0.0, w) <= driven[index] <= max(0.0, w) for w in wants)


# ---- an order that bounds the speed -------------------------------------------------------------


def test_the_lowest_ordered_bound_holds_until_its_order_ends_and_keeps_the_turn_rate():
    bench = Bench().tick((0.9, 0.4), ticks=3)
    bench.gate.order("RM7", m.PilotOrder(True, PilotMode.AUTO, "weak wheel", 0.5))
    bench.gate.order("RM8", m.PilotOrder(True, PilotMode.AUTO, "worse", 0.3))
    assert bench.out == (0.3, 0.4)
    bench.gate.order("RM8", m.PilotOrder(False, PilotMode.AUTO, ""))
    assert (bench.out, bench.reason) == ((0.5, 0.4), "speed limited by an order")
    bench.gate.order("RM7", m.PilotOrder(False, PilotMode.AUTO, ""))
    assert (bench.out, bench.gate.top_speed_mps) == ((0.9, 0.4), 0.0)
    for nonsense in (0.0, -1.0, math.nan):
        bench.gate.order("RM7", m.PilotOrder(True, PilotMode.AUTO, "", nonsense))
        assert bench.out == (0.9, 0.4)


# ---- the standby --------------------------------------------------------------------------------


def straight_row():
    row = LightRow(((0.0, 0.0), (40.0, 0.0)), limits=RowLimits(pass_after_s=5.0),
                   edge_m=lambda _x, _y: 9.0)
    row.step(20.0, 0.0, 0.0, NO_POINTS, PERIOD_S)
    return row


def test_a_standby_goes_back_where_the_active_one_does_and_stops_when_it_does():
    row = straight_row()
    row.adopt((15.0, 0.0), passing=False)
    assert row.back_to == pytest.approx((15.0, 0.0))
    row.adopt((15.1, 0.0), passing=False)
    assert row.back_to == pytest.approx((15.0, 0.0))
    row.adopt(None, passing=False)
    assert row.back_to is None


# ---- the yaw loop -------------------------------------------------------------------------------


def drive(loop, drag_radps, seconds, meant=lambda _t: 0.2, speed_mps=0.8):
    """A base that turns by `drag_radps` in addition to its command; returns the last yaw rates."""
    yaw = x = y = rate = 0.0
    rates, commands = [], []
    for tick in range(round(seconds / PERIOD_S)):
        now = tick * PERIOD_S
        loop.pose(now, x, y, yaw)
        command = loop.turn(speed_mps, meant(now), PERIOD_S)
        rate += (1 - math.exp(-PERIOD_S / 0.15)) * (command + drag_radps - rate)
        yaw += rate * PERIOD_S
        x += speed_mps * math.cos(yaw) * PERIOD_S
        y += speed_mps * math.sin(yaw) * PERIOD_S
        rates.append(rate)
        commands.append(command)
    return rates, commands


@pytest.mark.parametrize("drag_radps", [-0.7, 0.3])
def test_a_constant_drag_is_compensated_up_to_the_dead_band(drag_radps):
    loop = MotionLoop(2.0)
    rates, _ = drive(loop, drag_radps, 8.0)
    assert rates[-1] == pytest.approx(0.2, abs=DEAD_BAND_RADPS + 0.05)


@pytest.mark.parametrize("meant", [
    lambda _t: 0.2, math.sin, lambda t: min(max(4 * (t - 1), 0), 1.5)],
    ids=["constant", "weaving", "into a turn"])
def test_with_a_healthy_base_next_to_nothing_is_added(meant):
    loop = MotionLoop(2.0)
    _, commands = drive(loop, 0.0, 6.0, meant)
    assert max(abs(c - meant(i * PERIOD_S)) for i, c in enumerate(commands)) < 0.05


def test_a_robot_that_stands_winds_nothing_up_and_a_drag_that_is_over_is_unlearnt():
    loop = MotionLoop(2.0)
    for tick in range(100):
        loop.pose(tick * PERIOD_S, 1.0, 2.0, 0.5)
        loop.turn(0.8, 1.0, PERIOD_S)
    assert loop.added_radps == 0.0
    drive(loop, -0.7, 6.0)
    assert loop.turn(0.0, 0.0, PERIOD_S) == 0.0, "standstill is commanded as standstill"
    rates, _ = drive(loop, 0.0, 8.0)
    assert rates[-1] == pytest.approx(0.2, abs=DEAD_BAND_RADPS + 0.05)


@given(st.lists(st.tuples(st.floats(-2, 2), st.floats(-3, 3), st.floats(-9, 9)), max_size=40))
def test_whatever_the_poses_say_the_sum_keeps_its_bound_and_so_does_what_is_added(steps):
    loop = MotionLoop(2.0)
    for tick, (meant, yaw, place) in enumerate(steps):
        loop.pose(tick * PERIOD_S, place, -place, yaw)
        turn = loop.turn(0.5, meant, PERIOD_S)
        assert abs(turn) <= 2.0
        assert abs(loop.added_radps) <= MOST_RADPS
        assert abs(turn - meant) <= MOST_RADPS + 1e-9


def test_a_loop_that_only_listens_adds_what_the_other_does_until_that_is_silent():
    loop = MotionLoop(2.0)
    loop.adopt(0.3, until_s=1.0)
    drive(loop, -0.7, 0.9)
    assert loop.added_radps == pytest.approx(0.3, abs=0.02)
    drive_on = [loop.pose(1.0 + i * PERIOD_S, i * 0.04, 0.0, 0.0) or loop.turn(0.8, 0.5, PERIOD_S)
                for i in range(40)]
    assert drive_on[-1] > 0.5 + 0.3
