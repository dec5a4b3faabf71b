import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rampart.actors.bus.envelope import Header
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis.control.pilot.command_pair import FORGET_S, CommandPair
from rampart.actors.osmosis.control.pilot.safety_gate import Checks, GateLimits, SafetyGate
from rampart.actors.osmosis.control.pilot.swept_path import StoppingRoom, limited
from rampart.actors.osmosis.control.polyline import NO_POINTS
from rampart.actors.osmosis.messages import PilotMode
from tests.actors.osmosis.control.world import Circle, World

LIMITS = GateLimits()
BASELINE = Checks(inputs=False, manager=False)
PERIOD_S = 0.05
ROOM = StoppingRoom()


class Bench:
    """A settled gate with a live manager and scanner."""

    def __init__(self, checks=None):
        self.gate = SafetyGate(LIMITS, checks or Checks(), 0.0)
        self.now = self.held_since_s = 1.0
        self.sequence = 0
        self.manager = self.scanner = True
        self.life = 1
        self.wait(0.0)

    def wait(self, seconds):
        self.now += seconds
        if self.manager:
            self.gate.manager_alive(self.now, 1)
        if self.scanner:
            self.gate.scan(NO_POINTS, self.now)

    def send(self, linear, angular=0.0, *, age=0.0, sequence=None, life=None, by="control"):
        self.sequence = self.sequence + 1 if sequence is None else sequence
        take = {"control": self.gate.command, "standby": self.gate.standby,
                "stick": self.gate.joystick}[by]
        twist = m.StickTwist(linear, angular, self.held_since_s) if by == "stick" else m.Twist(
            linear, angular)
        header = Header(by, self.life if life is None else life, self.sequence, self.now - age)
        return take(twist, header, self.now)

    def tick(self, active=None, standby=None, ticks=1):
        """Let periods pass with commands of both computers; None is silence."""
        for _ in range(ticks):
            self.wait(PERIOD_S)
            if active is not None:
                self.send(*active)
            if standby is not None:
                self.send(*standby, by="standby", life=1)
        return self

    @property
    def out(self):
        output = self.gate.output(self.now)
        return output.linear_mps, output.angular_radps

    @property
    def reason(self):
        return self.gate.output(self.now).reason


def wall(distance_m, width_m=1.0):
    """Echoes of a wall across, so far ahead of the hull."""
    y = np.linspace(-width_m / 2, width_m / 2, 41)
    return np.column_stack((np.full(41, 0.36 + distance_m), y))


@pytest.mark.parametrize(("mode", "auto", "stick", "expected"), [
    (PilotMode.AUTO, 0.5, None, 0.5),
    (PilotMode.AUTO, 0.5, -0.2, -0.2),
    (PilotMode.AUTO, None, -0.2, -0.2),
    (PilotMode.TELEOPERATION, 0.5, None, 0.0),
    (PilotMode.TELEOPERATION, 0.5, -0.2, -0.2),
    (PilotMode.STOP, 0.5, None, 0.0),
    (PilotMode.STOP, 0.5, -0.2, 0.0),
])
@pytest.mark.parametrize("checks", [Checks(), BASELINE], ids=["checked", "baseline"])
def test_who_drives(mode, auto, stick, expected, checks):
    bench = Bench(checks)
    bench.gate.order("RM2", m.PilotOrder(mode is not PilotMode.AUTO, mode, "because"))
    if auto is not None:
        bench.send(auto)
    if stick is not None:
        bench.send(stick, by="stick")
    assert bench.out == (expected, 0.0)


def test_an_order_ends_only_by_the_word_of_who_gave_it():
    bench = Bench()
    bench.send(0.5)
    bench.gate.order("RM2", m.PilotOrder(True, PilotMode.STOP, "stale command"))
    for engaged in (True, False):
        bench.gate.order("RM5", m.PilotOrder(engaged, PilotMode.TELEOPERATION, ""))
        assert bench.gate.mode is PilotMode.STOP, "the strictest"
        assert bench.out == (0.0, 0.0)
    assert bench.reason == "RM2: stale command"
    bench.gate.order("RM2", m.PilotOrder(False, PilotMode.STOP, ""))
    assert bench.out == (0.5, 0.0)


@pytest.mark.parametrize("bad", [
    (1.01, 0.0), (0.0, -2.1), (math.nan, 0.0), (0.0, -math.inf)])
def test_a_command_out_of_bounds_is_refused_counted_and_leaves_zero(bad):
    bench = Bench()
    bench.send(0.5)
    assert bench.send(*bad) != ""
    assert bench.gate.refused == 1
    assert bench.out == (0.0, 0.0)
    assert bench.reason != ""
    bench.send(0.4)
    assert bench.out == (0.4, 0.0)


floats = st.floats(allow_nan=True, allow_infinity=True)


@settings(deadline=None)
@given(st.lists(st.tuples(floats, floats, st.booleans(), st.floats(-2, 2),
                          st.integers(0, 5), st.integers(1, 3)), max_size=8))
def test_whatever_comes_nothing_out_of_bounds_leaves_the_gate(messages):
    bench = Bench()
    for linear, angular, stick, age, sequence, incarnation in messages:
        bench.wait(0.05)
        bench.send(linear, angular, age=age, sequence=sequence, life=incarnation,
                   by="stick" if stick else "control")
        out = bench.out
        assert abs(out[0]) <= LIMITS.max_linear_mps * 1.00001
        assert abs(out[1]) <= LIMITS.max_angular_radps * 1.00001


def test_a_stale_command_is_refused_and_one_that_grows_stale_is_dropped():
    bench = Bench()
    for age in (0.6, -0.5, math.nan):
        assert bench.send(0.5, age=age) != ""
        assert bench.out == (0.0, 0.0)
    assert bench.send(0.5, -0.5) == ""
    bench.wait(0.49)
    assert (bench.out, bench.reason) == ((0.5, -0.5), "")
    bench.wait(0.02)
    assert bench.out == (0.0, 0.0)
    assert bench.reason == "no fresh command"


@pytest.mark.parametrize(("incarnation", "sequence", "taken"), [
    (2, 11, True), (2, 10, False), (2, 9, False), (1, 99, False), (3, 1, True)])
def test_the_sequence_only_goes_forward(incarnation, sequence, taken):
    bench = Bench()
    bench.send(0.5, life=2, sequence=10)
    refused = bench.send(0.1, life=incarnation, sequence=sequence)
    assert (refused == "") is taken
    assert bench.out == (0.1 if taken else 0.5, 0.0), "the newer command stays in force"


def drives_at(statuses, until_s):
    """When the gate lets a command pass, sampled each 0.05 s; statuses as (time, stamp, life)."""
    bench, left = Bench(), sorted(statuses)
    bench.manager = False
    start_s, driven = bench.now, []
    while bench.now - start_s < until_s:
        while left and left[0][0] <= bench.now - start_s + 1e-9:
            _, stamp_s, life = left.pop(0)
            bench.gate.manager_alive(start_s + stamp_s, life)
        bench.send(0.5)
        if bench.out[0] > 0:
            driven.append(bench.now - start_s)
        bench.wait(0.05)
    return driven


@pytest.mark.parametrize(("statuses", "least_s", "most_s"), [
    ([(0.05 * n, 0.05 * n, 1) for n in range(21)], 1.4, LIMITS.manager_timeout_s + 1.05),
    ([(0.05 * n, min(0.05 * n, 1.0), 1) for n in range(99)], 1.4, LIMITS.manager_timeout_s + 1.05),
    ([(0.4 * n, 0.4 * n, n + 1) for n in range(1, 40)], 0.0, LIMITS.manager_timeout_s + 0.05),
    ([(at, at, n + 1) for n in range(1, 40) for at in (0.4 * n, 0.4 * n + 0.05)], 0.0, 2.5),
    ([(3.0, 3.0, 1), (3.05, 3.05, 1)], 3.1, 3.7),
], ids=["silent", "old news", "hangs after each start", "hangs soon after it", "is back"])
def test_the_robot_stops_when_the_manager_is_silent_or_hangs_and_drives_when_it_is_back(
        statuses, least_s, most_s):
    assert least_s <= max(drives_at(statuses, 6.0)) <= most_s


def test_a_gate_just_started_waits_for_the_orders_it_may_have_missed():
    gate = SafetyGate(LIMITS, Checks(), 10.0)
    gate.manager_alive(10.1, 1)
    gate.scan(NO_POINTS, 10.1)
    gate.command(m.Twist(0.5, 0.0), Header("osmosis_control", 1, 1, 10.1), 10.1)
    assert gate.output(10.1).linear_mps == 0.0
    gate.order("RM2", m.PilotOrder(True, PilotMode.STOP, ""))
    assert gate.output(10.5).linear_mps == 0.0
    gate.order("RM2", m.PilotOrder(False, PilotMode.STOP, ""))
    assert gate.output(10.5).linear_mps == 0.5


def test_the_baseline_keeps_only_repetition_obstacle_stop_and_joystick():
    bench = Bench(BASELINE)
    bench.manager = bench.scanner = False
    bench.send(3.0, 5.0, age=9.0)
    bench.wait(60.0)
    assert bench.out == (3.0, 5.0), "out of bounds, stale, no manager, no scan: it goes on"
    bench.send(0.5, sequence=0)
    assert bench.out == (0.5, 0.0), "older sequence: taken"
    bench.send(math.nan)
    assert bench.out == (0.5, 0.0), "what no base can execute is not kept"
    bench.gate.scan(wall(0.1), bench.now)
    assert bench.out == (0.0, 0.0)


def test_backwards_where_no_laser_looks_drives_the_stick_alone_and_slowly():
    bench = Bench()
    bench.send(-0.2, 0.4, by="stick")
    assert bench.out == (-0.2, 0.4)
    bench.send(-1.0, 0.4, by="stick")
    assert bench.out == (-LIMITS.reverse_mps, 0.4)
    assert "no laser to the rear" in bench.gate.output(bench.now).reason
    bench.wait(0.31)
    assert "backwards, where there is no laser" in bench.send(-0.2)
    assert bench.out == (0.0, 0.0)
    assert bench.send(0.2) == ""
    assert bench.out == (0.2, 0.0)


@pytest.mark.parametrize("stamp_s", [None, 3600.0, math.nan])
def test_without_a_fresh_scan_the_robot_stops_whatever_the_stamp_says(stamp_s):
    bench = Bench()
    bench.scanner = False
    if stamp_s is None:
        bench.wait(0.6)
    else:
        bench.gate.scan(NO_POINTS, bench.now + stamp_s)
    for _ in range(20):
        bench.wait(0.1)
        bench.send(0.5)
        assert bench.out == (0.0, 0.0)
        assert bench.reason == "no fresh laser scan"


@pytest.mark.parametrize(("points", "linear", "angular", "expected"), [
    (NO_POINTS, 1.0, 0.0, "free"),
    (wall(0.6), 1.0, 0.0, "slower"),
    (wall(0.15), 1.0, 0.0, "stopped"),
    (wall(0.6), -1.0, 0.0, "free"),
    (wall(0.2), 0.0, 1.5, "free"),
    (np.array(((0.0, 0.55),)), 0.7, 0.0, "free"),
    (np.array(((0.5, 0.45),)), 1.0, 0.0, "slower"),
    (np.array(((0.30, 0.36),)), 0.0, 1.0, "stopped"),
    (np.array(((-0.45, 0.0),)), -0.5, 0.0, "stopped"),
    (np.array(((0.6, 0.7),)), 0.8, 1.5, "slower"),
    (wall(0.2), 0.5, 1.5, "turning"),
], ids=["nothing", "wall near", "wall at once", "away from it", "turn in place", "flank passed",
        "corner brushed", "turn into it", "something behind", "in the bend",
        "turn away in front of it"])
def test_what_the_echoes_allow(points, linear, angular, expected):
    out = limited(linear, angular, points, ROOM)
    if expected == "free":
        assert out == (linear, angular)
    elif expected == "slower":
        assert 0.0 < out[0] < linear
        assert out[1] == angular
    elif expected == "turning":
        assert out == (0.0, angular)
    else:
        assert out == (0.0, 0.0)


@pytest.mark.parametrize("speed", [0.5, 1.0])
def test_an_obstacle_that_appears_1_2_m_ahead_is_not_touched(speed):
    world = World(linear_mps=speed)
    world.circles.append(Circle(0.36 + 1.2 + 0.3, 0.0, 0.3))
    speeds = []
    for _ in range(120):
        world.move(*limited(speed, 0.0, world.scan(noise_m=0.01), ROOM))
        speeds.append(world.linear_mps)
    assert speeds[-1] == 0.0
    assert 0.1 < world.least_clearance_m < 0.35
    assert len({round(v, 1) for v in speeds}) >= 5, "gradually, no bang-bang"
    assert np.diff(speeds).max() <= 0.1


def stopped_by_an_order(bench):
    bench.gate.order("RM2", m.PilotOrder(True, PilotMode.STOP, "because"))
    bench.gate.output(bench.now)
    bench.gate.order("RM2", m.PilotOrder(False, PilotMode.STOP, ""))


def stopped_for_want_of_a_scan(bench):
    bench.gate.scan(NO_POINTS, bench.now, "the laser repeats itself")
    bench.gate.output(bench.now)
    bench.gate.scan(NO_POINTS, bench.now)


@pytest.mark.parametrize(("stop", "checks"), [
    (stopped_by_an_order, Checks()), (stopped_by_an_order, BASELINE),
    (lambda bench: bench.gate.braked(bench.now), Checks()), (stopped_for_want_of_a_scan, Checks())])
def test_a_stick_held_since_before_a_stop_ended_stands_the_robot_until_it_is_let_go(stop, checks):
    bench = Bench(checks)
    bench.held_since_s = bench.now
    bench.send(0.5, by="stick")
    assert bench.out == (0.5, 0.0)
    bench.wait(0.1)
    stop(bench)
    for _ in range(20):
        bench.wait(0.1)
        bench.send(0.5)
        bench.send(0.5, by="stick")
        assert bench.out == (0.0, 0.0)
    assert "release it first" in bench.reason
    assert bench.gate.forbidden(bench.now) == bench.reason
    bench.wait(0.31)
    bench.send(0.4)
    assert bench.out == (0.4, 0.0), "let go, the mission goes on"
    bench.held_since_s = bench.now
    bench.send(0.5, by="stick")
    assert bench.out == (0.5, 0.0)


@pytest.mark.parametrize("since_s", [0.0, math.nan, 60.0])
def test_a_stick_that_cannot_be_held_since_then_drives_nothing(since_s):
    bench = Bench()
    bench.held_since_s = since_s
    bench.send(0.5, by="stick")
    assert bench.out == (0.0, 0.0)


def test_a_hand_over_to_teleoperation_does_not_interrupt_the_stick_that_drives():
    bench = Bench()
    bench.held_since_s = bench.now
    bench.send(0.5, by="stick")
    bench.wait(0.1)
    bench.gate.order("RM5", m.PilotOrder(True, PilotMode.TELEOPERATION, "because"))
    bench.send(0.5, by="stick")
    assert bench.out == (0.5, 0.0)


def test_the_lowest_ordered_bound_holds_until_its_order_ends_and_keeps_the_turn_rate():
    bench = Bench().tick((0.9, 0.4))
    bench.gate.order("RM7", m.PilotOrder(True, PilotMode.AUTO, "weak wheel", 0.5))
    bench.gate.order("RM8", m.PilotOrder(True, PilotMode.AUTO, "worse", 0.3))
    assert bench.out == (0.3, 0.4)
    bench.gate.order("RM8", m.PilotOrder(False, PilotMode.AUTO, ""))
    assert (bench.out, bench.reason) == ((0.5, 0.4), "speed limited by an order")
    for nonsense in (0.0, -1.0, math.nan):
        bench.gate.order("RM7", m.PilotOrder(True, PilotMode.AUTO, "", nonsense))
        assert (bench.out, bench.gate.top_speed_mps) == ((0.9, 0.4), 0.0)


# ---- two computers of one command ---------------------------------------------------------------


@pytest.mark.parametrize("bad", [(3.0, 0.0), (0.0, 9.0), (math.nan, 0.0)])
def test_when_the_active_ones_command_is_refused_the_standby_drives_until_it_is_good_again(bad):
    bench = Bench().tick((0.8, 0.0), (0.7, 0.0), ticks=20)
    bench.send(*bad)
    assert bench.out == (0.7, 0.0)
    assert bench.reason.startswith("standby drives: command")
    for _ in range(20):  # one that stutters does not take the wheel back
        assert bench.tick((3.0, 0.0), (0.7, 0.0)).out == (0.7, 0.0)
        assert bench.tick((0.8, 0.0), (0.7, 0.0), ticks=4).out == (0.7, 0.0)
    bench.tick((0.8, 0.0), (0.7, 0.0), ticks=5)
    assert bench.reason == "standby drives: osmosis control has just recovered"
    bench.tick((0.8, 0.0), (0.7, 0.0), ticks=3)
    assert (bench.out, bench.reason) == ((0.8, 0.0), "")


def test_when_the_active_one_is_silent_for_four_periods_the_standby_drives():
    bench = Bench().tick((0.8, 0.0), (0.7, 0.0), ticks=20)
    assert bench.tick(None, (0.7, 0.0), ticks=4).out == (0.8, 0.0)
    assert bench.tick(None, (0.7, 0.0)).out == (0.7, 0.0)
    assert bench.reason == "standby drives: no fresh command"


def test_while_a_respawned_follower_accelerates_from_zero_the_standby_drives_on():
    bench = Bench().tick((0.8, 0.0), (0.8, 0.0), ticks=20)
    bench.life = 2
    for tick in range(25):
        assert bench.tick((0.04 * tick, 0.0), (0.8, 0.0)).out == (0.8, 0.0)
    assert bench.tick((0.8, 0.0), (0.8, 0.0), ticks=8).reason == ""


@pytest.mark.parametrize(("active", "standby", "driven"), [
    ((0.8, -0.7), (0.8, 0.2), (0.3, 0.2)), ((0.8, 0.2), (0.8, -0.7), (0.3, 0.2)),
    ((1.0, 0.0), (0.2, 1.0), (0.2, 0.0))])
def test_when_they_disagree_the_gentler_of_each_component_drives_and_slowly(
        active, standby, driven):
    bench = Bench().tick((0.8, 0.0), (0.8, 0.0), ticks=20)
    bench.tick(active, standby, ticks=5)
    assert (bench.out, bench.reason) == (driven, "active and standby disagree")
    bench.tick((0.8, 0.0), (0.8, 0.0), ticks=9)
    assert (bench.out, bench.reason) == ((0.8, 0.0), "")


def test_doubt_outlasts_the_respawn_of_one_and_ends_when_nobody_is_left_to_compare():
    bench = Bench().tick((0.8, 0.0), (0.8, 0.0), ticks=20)
    bench.tick((0.8, 0.9), (0.8, 0.0), ticks=6)
    assert bench.tick((0.8, 0.9), ticks=40).out == (0.3, 0.9)
    assert bench.tick((0.8, 0.9), ticks=round(FORGET_S / PERIOD_S)).out == (0.8, 0.9)


commands = st.one_of(st.none(), st.tuples(st.floats(-1, 1), st.floats(-2, 2)))


@given(st.lists(st.tuples(commands, commands, st.booleans(), st.booleans()), max_size=25))
def test_whatever_comes_what_drives_lies_between_zero_and_what_one_of_the_two_wants(steps):
    pair, now, lives = CommandPair(), 0.0, [1, 1]
    for active, standby, active_dies, standby_dies in steps:
        now += PERIOD_S
        lives = [lives[0] + active_dies, lives[1] + standby_dies]
        pair.active(active, now, lives[0], now)
        pair.standby(standby, now, lives[1], now)
        driven, _ = pair.choice((active, "refused"), standby, now)
        given_now = [c for c in (active, standby) if c is not None]
        assert (driven is None) == (given_now == [])
        for index in (0, 1) if driven is not None else ():
            assert any(min(0.0, c[index]) <= driven[index] <= max(0.0, c[index])
                       for c in given_now)
