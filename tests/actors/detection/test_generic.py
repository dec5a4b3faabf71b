"""Ready-made detection modules: timelines of monitors, and reports on the bus."""

import asyncio
import math
from collections.abc import Callable, Collection
from contextlib import asynccontextmanager
from dataclasses import replace
from typing import Any

import pytest

from rampart import Actor, Context, DetectionState
from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.envelope import decode
from rampart.actors.detection.disagreement import Disagreement, Vote, apart
from rampart.actors.detection.finding import Sustained
from rampart.actors.detection.freshness import Freshness
from rampart.actors.detection.link_lost import LinkLost
from rampart.actors.detection.overload import Overload
from rampart.actors.detection.process_usage import ProcessUsage
from rampart.actors.detection.progress import Progress, ProgressMonitor, Step
from rampart.actors.detection.rate import Rate, RateMonitor
from rampart.actors.detection.threshold import Threshold
from rampart.actors.detection.unchanged import Unchanged, UnchangedMonitor
from rampart.actors.detection.watchdog import Watchdog, WatchdogCore
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.machine.absence import GRACE_S
from rampart.actors.machine.patience import Usage
from rampart.actors.machine.process_usage import ProcessCount
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.runtime.parameters import read_parameters
from rampart.manager.spec.tables import FAILOVER_S
from rampart.testing import Ear, VirtualSystem, play, run, table
from tests.osmosis_system import POSE, System
from tests.tank import LEVEL, PUMP, SECOND, THIRD, TOPICS, Level, Phase, Pump
from tests.virtual_time import within


# g: no error, w: error, ?: unknown; error for 300 ms, none for 200 ms.
@pytest.mark.parametrize(("events", "expected"), **table({
    "wrong for long enough": ("gwwwwgggg", "----AAA--"),
    "wrong for a moment": ("gwwgww", "------"),
    "an error, then silence: the last note stands": ("gw......", "----AAAA"),
    "well, then silence: not cured": ("wwwwg...", "---AAAAA"),
    "a source that stutters": ("wwwwgwgwggg", "---AAAAAAA-"),
    "unknown: both times start again": ("ww?wwww", "------A"),
}))
def test_what_lasts(events, expected):
    monitor = Sustained(0.3, 0.2)

    def handle(event, now_s):
        if event == "?":
            monitor.doubt()
        else:
            monitor.note("wrong" if event == "w" else "", now_s)

    assert play(monitor, handle, events) == expected


# m: a message. At least 10 Hz within 300 ms (3), at most 20 Hz (6).
@pytest.mark.parametrize(("least", "most", "clear_s", "events", "expected"), **table({
    "the start is forgiven for 500 ms": (10.0, math.inf, 0.0, "........", "-----AAA"),
    "too seldom": (10.0, math.inf, 0.0, "mmmmm.mmmm", "-----AAA--"),
    "it comes back": (10.0, math.inf, 0.0, "mmmmmm..mmmmm", "------AAAA---"),
    "too often, and silence is in order": (0.0, 8.0, 0.0, "m.m.mmmm....", "------AA----"),
    "in order again after a while of silence": (0.0, 8.0, 0.4, "mmmm........", "--AAAAAA----"),
}))
def test_how_often(least, most, clear_s, events, expected):
    monitor = RateMonitor(least, most, 0.3, 0.0, 0.5, clear_s=clear_s)
    assert play(monitor, lambda _event, now_s: monitor.heard(now_s), events) == expected


def test_a_rate_of_which_nothing_could_be_heard_is_counted_from_the_start():
    monitor = RateMonitor(10.0, math.inf, 0.3, 0.0, 0.5)
    for tick in range(10):
        monitor.heard(0.1 * tick)
    monitor.missed(5.0)
    for tick in range(10):
        monitor.heard(5.0 + 0.1 * tick)
        assert not monitor.active
    monitor.expire(7.0)
    assert monitor.active


def followed(monitor: ProgressMonitor):
    def handle(event: str, now_s: float) -> None:
        if event == "b":
            monitor.busy(now_s + 0.5)
        else:
            monitor.heard(event, now_s)

    return handle


def said_to(monitor: UnchangedMonitor):
    def handle(event: str, now_s: float) -> None:
        monitor.heard(event.lower(), now_s, renewed=event.isupper())

    return handle


STEPS = (Step("1", 0.4), Step("2", 0.3, ("3", "1")), Step("3"))


# 1, 2, 3: a step; b: busy for 500 ms.
@pytest.mark.parametrize(("events", "expected"), **table({
    "in order, from the middle": ("23112", "-----"),
    "in another order that is allowed": ("121123", "------"),
    "a step that is left out": ("1133.1", "--AAA-"),
    "a step that takes too long": ("1.....2", "----AA-"),
    "the last one may take as long as it likes": ("123......", "---------"),
    "busy": ("1b.....2", "------A-"),
    "no step at all": ("1x.2", "-AA-"),
    "late, and busy only then": ("1....b", "----AA"),
}))
def test_steps(events, expected):
    monitor = ProgressMonitor("task", STEPS, busy_at_most_s=1.0)
    assert play(monitor, followed(monitor), events) == expected


POINTS = (Step("1", 0.4, at_least_s=0.2), Step("2", 0.3), Step("3", 0.6))


# A slot is 100 ms; each event is a check point that is passed.
@pytest.mark.parametrize(("events", "expected"), **table({
    "in order": ("1.23.1.23", "---------"),
    "too soon, and right again with the next one": ("123.", "-A--"),
    "left out, and swapped": ("1..32", "---AA"),
    "repeated": ("1.22", "---A"),
    "late": ("1....2", "----A-"),
    "never": ("1.2......", "-----AAAA"),
    "unknown": ("1.x", "--A"),
}))
def test_check_points(events, expected):
    monitor = ProgressMonitor("point", POINTS, busy_at_most_s=1.0, each=True)
    assert play(monitor, followed(monitor), events) == expected


def test_after_steps_that_could_not_be_heard_any_step_may_be_the_next():
    monitor = ProgressMonitor("task", STEPS, busy_at_most_s=1.0)
    monitor.heard("1", 0.0)
    monitor.missed()
    monitor.heard("3", 5.0)
    assert not monitor.active
    monitor.heard("2", 5.1)
    assert monitor.active, "only the first one after it is believed"


def test_a_step_is_not_busy_for_longer_than_it_may_be():
    monitor = ProgressMonitor("task", STEPS, busy_at_most_s=0.2)
    monitor.heard("1", 0.0)
    monitor.busy(1e6)
    assert monitor.due_s == pytest.approx(0.6)
    monitor.busy(math.nan)
    assert monitor.due_s == pytest.approx(0.4)


# a, b, c ...: a value, A: the same as a, of a new process; x may last. The same for 300 ms is too
# long; it then has to go on changing for 200 ms.
@pytest.mark.parametrize(("events", "expected"), **table({
    "it is always the same": ("aaaaaa", "---AAA"),
    "it is the same for a moment": ("aaabaaab", "--------"),
    "it goes on changing": ("aaaabcde", "---AAA--"),
    "it changes once": ("aaaabbbbbb", "---AAAAAAA"),
    "silence is not the same": ("aa......", "--------"),
    "the same after silence": ("a...a", "----A"),
    "active, then silence: the last value stands": ("aaaa...", "---AAAA"),
    "what may last is a change": ("aaaaxxx", "---AAA-"),
    "a new process is given time": ("aaAaaaa", "-----AA"),
}))
def test_what_never_changes(events, expected):
    monitor = UnchangedMonitor("it", 0.3, 0.2, may_last=("x",))
    assert play(monitor, said_to(monitor), events) == expected


@pytest.mark.parametrize(("events", "expected"), **table({
    "silence": ("......", "???---"),
    "the same from the start": ("aaaaa", "???AA"),
    "a change": ("abbb", "?---"),
    "a single value shows nothing": ("a.....", "???---"),
    "a value that may last shows that the fault is absent": ("xxxx", "----"),
}))
def test_what_never_changes_to_a_module_that_was_respawned(events, expected):
    monitor = UnchangedMonitor("it", 0.3, 0.2, may_last=("x",), known_after_s=0.3)
    assert play(monitor, said_to(monitor), events) == expected


@pytest.mark.parametrize(("values", "active"), [
    ((1.0, 1.4, 0.6, 1.2), True), ((1.0, 1.3, 1.6, 1.9), False), ((math.nan,) * 4, True),
    ((1.0, math.nan, 1.0, math.nan), False), ((True, True, True, True), True)])
def test_numbers_that_are_the_same(values, active):
    monitor = UnchangedMonitor("it", 0.3, within=0.5)
    for i, value in enumerate(values):
        monitor.heard(value, i / 10)
    assert monitor.active == active


@pytest.mark.parametrize(("one", "other", "angle", "distance"), [
    (1.0, 3.0, False, 2.0), (3.0, -3.0, True, math.tau - 6.0), ("a", "a", False, 0.0),
    ("a", "b", False, math.inf), (True, False, False, math.inf), (1.0, math.nan, False, math.inf),
    (math.inf, math.inf, False, math.inf)])
def test_how_far_apart(one, other, angle, distance):
    assert apart(one, other, angle=angle) == pytest.approx(distance)


# -- on the bus --------------------------------------------------------------------------------


def reports(kind: Callable[[Context], Actor], script: list[tuple[Any, ...]], until_s: float,
            respawned: bool = False, **parameters: Any) -> list[tuple[float, str, str]]:
    """Return when a module changed its state, that, and why.

    The script is what is said: time, topic, message and, if it is not the gauge, by whom, and when.
    """

    async def scenario() -> list[tuple[float, str, str]]:
        async with VirtualSystem(topics=TOPICS) as system:
            ear = system.start("ear", Ear)
            system.incarnations["D"] = 1 if respawned else 0
            system.start("D", kind, **parameters)
            for row in script:
                at_s, topic, message, source, stamp_s = row if len(row) == 5 else (
                    *row, "gauge", None)
                await asyncio.sleep(max(0.0, at_s - system.clock.now()))
                system.say(topic, message, source, stamp_s=stamp_s)
            await asyncio.sleep(until_s - system.clock.now())
            found: list[tuple[float, str, str]] = []
            for at_s, report in ear.heard:
                if not found or found[-1][1] != report.state.value:
                    found.append((round(at_s, 3), report.state.value, report.reason))
            return found

    return run(scenario)


def levels(*heights: float, topic: Any = LEVEL) -> list[tuple[float, Any, Any]]:
    return [(round((i + 1) * 0.1, 3), topic, Level(height)) for i, height in enumerate(heights)]


@pytest.mark.parametrize(("heights", "limits", "expected"), **table({
    "above": ((3, 3, 1, 1, 1, 1), {"above": 2.0}, [(0.1, "3 is above 2"), (0.5, "")]),
    "below": ((1, -1, -1), {"below": 0.0}, [(0.2, "-1 is below 0")]),
    "no number": ((1, math.nan), {"above": 2.0}, [(0.2, "nan is not finite")]),
    "its sign does not matter": ((1, -3), {"above": 2.0, "absolute": True},
                                 [(0.2, "3 is above 2")]),
    "on the limit": ((2, 2), {"above": 2.0, "below": 2.0 - 1e-6}, []),
    "hysteresis": ((3, 1.9, 1.9, 1.9, 1.9), {"above": 2.0, "hysteresis": 0.5},
                   [(0.1, "3 is above 2")]),
}))
def test_threshold(heights, limits, expected):
    found = reports(Threshold, levels(*heights), 1.0, value="tank/level:height_m", **limits)
    assert [(at_s, why.removeprefix("tank/level:height_m: ")) for at_s, _, why in found[1:]] == (
        expected)


@pytest.mark.parametrize(("kind", "parameters"), [
    (Threshold, {"value": "tank/level:height_m", "above": 2.0}),
    (Rate, {"topic": "tank/level", "at_least_hz": 5.0}),
    (Disagreement, {"one": "tank/level:height_m", "other": "tank/second:height_m"}),
    (Progress, {"value": "tank/pump:phase", "steps": [{"at": "idle"}, {"at": "filling"}]}),
    (Unchanged, {"value": "tank/level:height_m", "for_s": 1.0})])
def test_a_respawned_module_claims_nothing_before_it_knows(kind, parameters):
    assert reports(kind, [], 0.15, respawned=True, **parameters) == []


def test_a_respawned_module_that_finds_an_error_reports_when_it_has_lasted():
    """Idle before would release the recovery that acts against it."""
    found = reports(Threshold, levels(3.0, 3.0, 3.0, 3.0), 0.45, respawned=True,
                    value="tank/level:height_m", above=2.0, for_s=0.2)
    assert [state for _, state, _ in found] == ["active"]


def test_a_rate_is_reported():
    found = reports(Rate, levels(*[1.0] * 60), 8.0, topic="tank/level", at_least_hz=5.0)
    assert [(state, why) for _, state, why in found] == [
        ("idle", ""), ("active", "fewer than 5 messages in 1 s")]
    assert found[1][0] == pytest.approx(6.6)  # the fifth from last came at 5.6


@pytest.mark.parametrize(("script", "for_s", "expected"), [
    (levels(1, 1, 1, 1) + levels(1, 2, 2, 2, topic=SECOND), 0.1,
     [(0.3, "active", "tank/level:height_m is 1, tank/second:height_m is 2")]),
    (levels(1) + levels(*[9.0] * 30, topic=SECOND), 0.5, [])])  # who is silent is not compared
def test_two_gauges_that_disagree(script, for_s, expected):
    found = reports(Disagreement, sorted(script, key=lambda e: e[0]), 1.0, stale_s=0.3, for_s=for_s,
                    one="tank/level:height_m", other="tank/second:height_m", more_than=0.5)
    assert found[1:] == expected


def test_two_of_three_have_to_agree():
    fields = [f"{topic.key}:height_m" for topic in (LEVEL, SECOND, THIRD)]
    script = sorted([*levels(1, 1, 1, 1, 1), *levels(1, 1, 5, 5, 5, topic=SECOND),
                     *levels(1, 1, 1, 9, 9, topic=THIRD)], key=lambda e: e[0])
    found = reports(Vote, script, 1.0, values=fields, agree=2, within=0.5, for_s=0.0)
    assert found[-1] == (0.4, "active", "1 of 3 agree, expected 2: tank/second:height_m is 5, "
                         "tank/third:height_m is 9")
    assert [state for _, state, _ in found] == ["idle", "active"]


def test_a_pump_that_leaves_out_a_step():
    steps = [{"at": "idle", "to": ["filling"]}, {"at": "filling", "within_s": 1.0},
             {"at": "draining"}]
    script = [(0.1, PUMP, Pump(Phase.IDLE)), (0.2, PUMP, Pump(Phase.DRAINING)),
              (0.4, PUMP, Pump(Phase.IDLE)), (0.5, PUMP, Pump(Phase.FILLING, busy_until_s=2.0))]
    found = reports(Progress, script, 3.0, value="tank/pump:phase", steps=steps,
                    busy_until="tank/pump:busy_until_s")
    assert [(at_s, state) for at_s, state, _ in found] == [
        (0.0, "idle"), (0.2, "active"), (0.4, "idle"), (2.0, "active")]
    assert found[1][2] == "tank/pump:phase is 'draining' after 'idle', expected 'filling'"


@within(lambda: VirtualSystem(topics=TOPICS))
async def test_a_new_process_begins_its_check_points_anywhere_and_is_held_to_their_order(system):
    reported = system.hear(ftm_topics.DETECTION)
    system.start("D", Progress, value="tank/pump:phase", each=True, steps=[
        {"at": "idle"}, {"at": "filling"}, {"at": "draining"}])
    await asyncio.sleep(0.1)
    for phase, incarnation, state in (
            (Phase.FILLING, 1, "idle"), (Phase.IDLE, 2, "idle"), (Phase.IDLE, 2, "active"),
            (Phase.FILLING, 2, "idle")):
        system.say(PUMP, Pump(phase), "pump", incarnation=incarnation)
        await asyncio.sleep(0.05)
        assert reported[-1].message.state.value == state, (phase, incarnation)


@within(lambda: VirtualSystem(topics=TOPICS))
async def test_a_list_that_is_too_short_for_a_parameter_s_index_is_reported(system):
    """The module was silent about it, and idle for the whole run."""
    reported = system.hear(bus_topics.DIAGNOSTIC, "D")
    system.start("D", Threshold, value="tank/level:cells[7]", above=2.0)
    await asyncio.sleep(0.1)
    system.say(LEVEL, Level(3.0, (1.0, 2.0)), "gauge")
    await asyncio.sleep(0.1)
    await system.settle()
    assert "cells[7]" in reported[-1].message.reason


@pytest.mark.parametrize(("kind", "parameters", "nodes"), [
    (Threshold, {"value": "tank/level:height_m", "above": 2.0}, ("gauge#4", "second", "pump")),
    (Disagreement, {"one": "tank/level:height_m", "other": "tank/second:height_m", "for_s": 0.0},
     ("gauge#4", "second#2", "pump"))])
@within(lambda: VirtualSystem(topics=TOPICS))
async def test_suspects_are_named_by_the_incarnation_that_was_heard(
        system, kind, parameters, nodes):
    ear = system.start("ear", Ear)
    system.start("D", kind, suspects=["gauge", "second", "pump"], **parameters)
    await asyncio.sleep(0.1)
    system.say(LEVEL, Level(3.0), "gauge", incarnation=4)
    system.say(SECOND, Level(2.0), "second", incarnation=2)
    await asyncio.sleep(0.1)
    assert ear.heard[-1][1].nodes == nodes


@within(lambda: VirtualSystem(topics=TOPICS))
async def test_a_suspect_that_sends_nothing_itself_is_named_by_the_incarnation_of_that_time(system):
    """Named without one, a living suspect was reported as restarted although it was not."""
    ear = system.start("ear", Ear)
    system.start("D", Unchanged, value="tank/level:height_m", for_s=0.3, suspects=["pump"])
    await asyncio.sleep(0.1)
    for tick in range(9):
        system.incarnations["pump"] = 3 if tick < 6 else 4  # it is replaced
        system.say(LEVEL, Level(3.0), "gauge")
        await asyncio.sleep(0.1)
    named = [m.nodes for _, m in ear.heard if m.nodes]
    # The new process has 0.3 s of its own before it is suspected.
    assert set(named) == {("pump#3",)}


@pytest.mark.parametrize(("kind", "parameters", "words"), [
    (Threshold, {"value": "a:b"}, "above = *: missing; give above, below or both"),
    (Threshold, {"value": "a:b", "above": 1.0, "below": 2.0}, "below = 2.0: must be smaller"),
    (Rate, {"topic": "a"}, "at_least_hz: missing"),
    (Rate, {"topic": "a", "at_least_hz": 5.0, "at_most_hz": 5.0}, "at_most_hz = 5.0: must be"),
    (Vote, {"values": ["a:b", "c:d"], "agree": 3}, "agree = 3: there are only 2 values"),
    (Progress, {"value": "a:b", "steps": [{"at": "x"}, {"at": "x"}]}, "'x' is listed twice"),
    (Progress, {"value": "a:b", "steps": [{"at": "x", "within_s": 1.0, "at_least_s": 2.0},
                                          {"at": "y"}]}, "at_least_s of 'x' must be from 0"),
    (Progress, {"value": "a:b", "steps": [{"at": "x", "to": ["z"]}, {"at": "y"}]},
     "'x' leads to 'z', which is not a step"),
    (ProcessUsage, {"watch": ["a"]}, "memory_mb: missing"),
])
def test_parameters_that_make_no_sense_are_refused_by_name(kind, parameters, words):
    with pytest.raises(ValueError, match=r".") as caught:
        read_parameters(kind.Parameters, parameters, "x.toml", "D.parameters")
    text = str(caught.value)
    assert "\n" not in text
    assert words.replace(" = *", "") in text.replace(" = None", "")


# -- processes ---------------------------------------------------------------------------------


@pytest.mark.parametrize("here", [True, False])
@within(VirtualSystem)
async def test_a_node_of_this_machine_that_takes_too_much_is_named(system, here):
    used = {"busy": 0.0, "memory": 1e6}
    ear = system.start("ear", Ear)
    system.start("D", lambda context: ProcessUsage(replace(
        context, is_here=lambda _node: here, usage=lambda pid: ProcessCount(
            used["busy"], int(used["memory"]), 0.0) if pid == 77 else None)),
        watch=["a"], processor_share=0.5, memory_mb=50, for_s=1.0, clear_s=1.0)

    async def after(busy_s: float, memory: float = 1e6) -> str:
        used["memory"] = memory
        for _ in range(20):
            system.say(bus_topics.HEARTBEAT, bm.Heartbeat(77, 1, 0.1, 0, 0), "a", incarnation=3)
            used["busy"] += busy_s
            await asyncio.sleep(0.1)
        return ear.heard[-1][1].reason

    assert await after(0.02) == ""
    why = await after(0.08)
    if here:
        assert "of a core, more than 0.5" in why
        assert ear.heard[-1][1].nodes == ("a#3",)
        assert await after(0.0) == ""
        assert await after(0.0, 60e6) == "a: 60 MB of memory, more than 50 MB"
    else:  # the number of a process of another machine proves nothing
        assert ear.states == ["idle"]


# -- a host that cannot be reached -------------------------------------------------------------


def lost(*hosts: str) -> fm.NodeTable:
    return fm.NodeTable(tuple(
        fm.NodeInfo(f"router_a_{host}", "supervision", 1, fm.NodeState.UNREACHABLE if host in hosts
                    else fm.NodeState.RUNNING, 1, 0, host=host) for host in ("ground", "moon")))


@pytest.mark.parametrize(("parameters", "hosts", "reason"), [
    ({}, ("ground", "moon"), "no link to ground, moon"),
    ({"host": "moon"}, ("ground",), ""),
    ({"host": "moon"}, ("ground", "moon"), "no link to moon"),
    ({"for_s": 1.0}, ("ground",), ""),
    ({"for_s": 0.3}, ("ground",), "no link to ground"),
])
def test_who_is_lost_is_told_after_the_time_that_was_said(parameters, hosts, reason):
    tables = (lost(), lost(*hosts), lost(*hosts), lost(), lost())
    script = [(0.4 * i, ftm_topics.NODES, one, "supervisor", None) for i, one in enumerate(tables)]
    found = reports(LinkLost, script, 1.7, **parameters)
    assert [(state, why) for _, state, why in found] == [
        ("idle", ""), ("active", reason), ("idle", "")][:3 if reason else 1]


# -- many nodes that are late at once: what they have in common is the machine -----------------


NODES = ("a", "b", "c", "d", "e", "f")


def overloaded(script: list[tuple[float, Collection[str], float]], until_s: float = 6.0,
               waits_until_s: float = 0.0, under_way_s: float = 0.0, **options: bool
               ) -> list[tuple[float, str]]:
    """When DM14 changed its state: heartbeats at a time, from nodes, that were so late.

    Until `waits_until_s` their processes wait for a processor for a fifth of the time.
    """
    def module(context: Context) -> Overload:
        return Overload(replace(context, scheduled=lambda _pid: Usage(
            "S", 1.0, 0.2 * min(context.clock.now(), waits_until_s))))

    beats = [(at_s, bus_topics.HEARTBEAT, bm.Heartbeat(ord(node), 1, 0.1, 0, 0, late_s), node,
              at_s - under_way_s)
             for at_s, nodes, late_s in script for node in nodes]
    found = reports(module, beats, until_s, **options, watch=list(NODES), late_s=0.15, clear_s=1.0,
                    wait_s=4.0)
    return [(round(at_s, 1), state) for at_s, state, _ in found]


def test_many_that_are_late_at_once_are_an_overload_until_they_have_not_been_for_a_while():
    script = [(1.0 + 0.2 * i, "abc", 0.2) for i in range(5)]
    assert overloaded(script)[1:] == [(1.0, "active"), (3.3, "idle")]


@pytest.mark.parametrize("script", [
    [(1.0 + 0.1 * i, "a", 3.0) for i in range(20)],  # one is a fault of its own
    [(1.0, "a", 0.2), (2.0, "b", 0.2), (3.0, "c", 0.2)],  # not at once
    [(1.0 + 0.1 * i, NODES, 0.05) for i in range(20)],  # not late enough
])
def test_few_or_a_little_late_are_no_overload(script):
    assert {state for _, state in overloaded(script)} == {"idle"}


def test_one_that_was_late_for_long_counts_for_as_long():
    """A loop that turns every 0.9 s reports every 0.9 s; another one reports in between."""
    script = [(1.0 + 0.45 * i, "ab"[i % 2], 0.9) for i in range(8)]
    assert [state for _, state in overloaded(script, 4.0)] == ["idle", "active"]


def test_what_is_long_under_way_is_late_as_well():
    script = [(1.0 + 0.1 * i, "abcd", 0.0) for i in range(5)]
    assert [s for _, s in overloaded(script, 1.5, under_way_s=0.4)] == ["idle", "active"]


@pytest.mark.parametrize(("waits_until_s", "idle_s"), [(0.0, 2.5), (3.2, 4.7), (99.0, 6.5)])
def test_it_lasts_while_many_wait_for_a_processor_but_not_for_ever(waits_until_s, idle_s):
    found = overloaded([(1.0, "abc", 0.2)], 9.0, waits_until_s)
    assert found[1:] == [(1.0, "active"), (pytest.approx(idle_s, abs=0.4), "idle")]


def test_a_successor_says_nothing_before_it_knows():
    assert overloaded([], 0.4, respawned=True) == []
    assert overloaded([], 2.0, respawned=True) == [(0.5, "idle")]
    assert overloaded([(0.3, "abc", 0.2)], 0.9, respawned=True) == [(0.3, "active")]


# -- DM4, DM5, DM7: nodes that die, stop or hang, and come back


# One node. b heartbeat of the first process, B of the second, g one sent before the last event;
# what the supervisor publishes: p the first is started, x it has crashed, s it is stopped, w it
# hangs, u it is unstable; P, X and U of the second; S it is stable, N a new supervisor adopts it.
TIMELINES = {
    "it hangs, and goes on": ("pbb....bb", "-----AA--"),
    "it sends nothing: the grace is 500 ms": ("......", "-----A"),
    "its process is there but sends nothing": ("p.....", "-----A"),
    "it dies before its first heartbeat": ("px.", "-AA"),
    "a process is not enough, a heartbeat is": ("pbbxP....B", "---AAAAAA-"),
    "the new process beats before it is published": ("pbbx.BPB", "---AA---"),
    "the old process's end is published after the new one's start": ("pbbPBxBB", "--------"),
    "the old process's end is published twice": ("pbbxPBxBB", "---AA----"),
    "a heartbeat was under way when it died": ("pbbxg..", "---AAAA"),
    "replaced without a crash, the new life never works": ("pbbP....", "------AA"),
    "it dies twice": ("pbxPBBXX", "--AA--AA"),
    "the new life hangs": ("pbxPB....", "--AA---AA"),
    "it is stopped, and goes on": ("pbbs.b", "---AA-"),
    "it hangs and is replaced": ("pbw.PB", "--AAA-"),
    "unstable, until it is stable": ("pbbxuPBBSBB", "---AAAAA---"),
    "unstable, and the supervisor is replaced": ("pbbxuPBBNBB", "---AAAAA---"),
    "unstable by the new supervisor, too": ("pbbxuPBBNUB", "---AAAAA-AA"),
    "a heartbeat of the old life after the new one's": ("pbxPB.b..", "--AA---AA"),
}


EVENTS = {"p": "respawned", "x": "crashed", "s": "stopped", "w": "wedged", "u": "unstable"}


def watch(core: WatchdogCore):
    last = {"change": 0.0}

    def handle(event: str, now_s: float) -> None:
        match event:
            case "b" | "B":
                core.beat("node", 1 if event == "b" else 2, now_s, now_s)
            case "g":
                core.beat("node", 1, last["change"] - 0.001, now_s)
            case "S":
                core.event("node", "stable", 2, now_s, now_s)
            case "N" | "n":  # a new supervisor adopts the process
                core.event("node", "adopted", 2, now_s, now_s, by=("supervisor", 2))
            case _:
                last["change"] = now_s
                core.event("node", EVENTS[event.lower()], 1 if event.islower() else 2, now_s, now_s)

    return handle


@pytest.mark.parametrize(("events", "expected"), **table(TIMELINES))
def test_watchdog_timeline(events, expected):
    core = WatchdogCore(["node"], timeout_s=0.3, start_s=0.0, grace_s=0.5)
    assert play(core, watch(core), events) == expected


@pytest.mark.parametrize(("events", "expected"), **table({
    "it knows with the first heartbeat": ("p.b", "??-"),
    "a process is not enough to know": ("p....", "???AA"),
    "no process at all": (".....", "???AA"),
}))
def test_a_respawned_watchdog_claims_nothing_before_it_knows(events, expected):
    core = WatchdogCore(["node"], timeout_s=0.3, start_s=0.0, grace_s=0.3, known=False)
    assert play(core, watch(core), events) == expected


def test_it_names_those_who_failed_and_why():
    core = WatchdogCore(["a", "b", "c"], 0.3, 0.0, 0.5)
    core.beat("a", 1, 0.0, 0.0)
    core.beat("b", 4, 0.0, 0.0)
    core.event("b", "crashed", 4, 0.1, 0.1)
    core.expire(0.3)
    assert core.nodes == ("a", "b")
    assert core.reason == "a: no heartbeat for 0.3 s; b: process of incarnation 4 is gone"
    core.expire(0.5)
    assert core.nodes == ("a", "b", "c")
    core.beat("a", 2, 0.6, 0.6)
    core.event("stranger", "crashed", 1, 0.6, 0.6)
    core.beat("stranger", 1, 0.6, 0.6)
    assert core.nodes == ("b", "c")


@pytest.mark.parametrize("stamp_s", [1e9, math.inf, math.nan])
def test_a_heartbeat_of_no_possible_time_does_not_bring_the_dead_to_life(stamp_s):
    core = WatchdogCore(["a"], 0.3, 0.0, 0.5)
    core.beat("a", 1, 0.0, 0.0)
    core.event("a", "crashed", 1, 0.1, 0.1)
    core.beat("a", 1, stamp_s, 0.11)
    assert core.nodes == ("a",)
    core.beat("a", 1, 0.12, 0.12)
    assert core.nodes == ()


class Node(Actor):
    """A node that does nothing but beat."""


@within(System)
async def test_a_killed_node_and_its_return_are_reported_without_any_time_passing(system):
    ear = system.start("ear", Ear)
    for name in ("a", "b"):
        system.start(name, Node)
    system.start("DM4", Watchdog, watch=["a", "b"], timeout_s=0.35)
    await asyncio.sleep(1.0)
    await system.kill("b")
    killed_s = system.clock.now()
    await system.settle()
    at, report = ear.heard[-1]
    assert (at, report.state, report.nodes) == (killed_s, DetectionState.ACTIVE, ("b",))
    system.start("b", Node)
    await system.settle()
    assert ear.states == ["idle", "active", "idle"]


@within(System)
async def test_without_a_supervisor_a_node_whose_loop_hangs_is_reported_after_twice_the_timeout(
        system):
    ear = system.start("ear", Ear)
    node = system.start("a", Node)
    system.start("DM4", Watchdog, watch=["a"], timeout_s=0.35)
    await asyncio.sleep(0.55)
    node.hold(True)
    await asyncio.sleep(0.5)
    assert ear.states == ["idle"]
    await asyncio.sleep(0.2)
    assert ear.heard[-1][1].reason == "a: no heartbeat for 0.7 s"
    active_s = next(at for at, r in ear.heard if r.state is DetectionState.ACTIVE)
    assert active_s == pytest.approx(0.5 + 2 * 0.35, abs=1e-3)


# -- a module that could not receive anything blames no node for that, for a short ti


TIMEOUT_S = 0.3


class Source(Actor):
    outputs = (topics.POSE,)


@asynccontextmanager
async def watched():
    """DM6, the source that it watches, and a reader of its reports."""
    async with System() as system:
        ear, source = system.start("ear", Ear), system.start("localization", Source)
        module = system.start("DM6", Freshness, **POSE, timeout_s=TIMEOUT_S)
        yield system, ear, source, module


async def publish(source: Source, count: int, **words: float) -> None:
    for _ in range(count):
        source.publish(topics.POSE, m.Pose(0.0, 0.0, 0.0), **words)
        await asyncio.sleep(0.05)


def held(until_s: float) -> Callable[[Actor], None]:
    """A module's loop stands still from 0.2 s on until then."""
    def disturb(module: Actor) -> None:
        loop = asyncio.get_running_loop()
        loop.call_later(0.2, module.hold, True)
        loop.call_later(until_s, module.hold, False)

    return disturb


def moved(again: bool) -> Callable[[Actor], None]:
    """The router has died, and does so again and again."""
    def disturb(module: Actor) -> None:
        answers = iter([True])
        module._bus.moved = lambda: next(answers, again)

    return disturb


@pytest.mark.parametrize(("disturb", "least_s", "most_s"), [
    (lambda _module: None, TIMEOUT_S, TIMEOUT_S),  # silence counts as soon as it lasts
    (held(0.26), 0.31, 0.31),  # hardly late: that excuses nothing
    # it reads its mail for as long as it was late
    (held(0.29), 0.38, 0.38), (held(0.33), 0.46, 0.46),
    # it waits for the bus, but not for ever: it asks with its next report, within 0.2 s
    *((moved(again), TIMEOUT_S + 4e-3, 0.2 + FAILOVER_S) for again in (False, True))])
@within(watched)
async def test_a_module_that_was_late_or_lost_its_router_reads_its_mail_before_it_judges(
        given, disturb, least_s, most_s):
    system, ear, source, module = given
    await asyncio.sleep(2.0)
    await publish(source, 20)
    last_s = system.clock.now() - 0.05
    ear.heard.clear()
    disturb(module)
    await asyncio.sleep(1.5)
    active_s = next(at_s - last_s for at_s, report in ear.heard if report.reason)
    assert least_s - 2e-3 <= active_s <= most_s + 2e-3


@within(watched)
async def test_a_module_that_does_not_decide_yet_is_not_silent(given):
    system, ear, source, module = given
    await publish(source, 2)
    module.hold(True)
    await asyncio.sleep(5.0)
    ear.heard.clear()
    module.hold(False)
    await publish(source, 1, stamp=system.clock.now() - 4.0)
    await asyncio.sleep(0.9 * GRACE_S - 0.05)
    posted = system.hub.postings.get(ftm_topics.DETECTION.at("DM6"))
    assert posted is not None
    report, _ = decode(ftm_topics.DETECTION, posted)
    assert system.clock.now() - report.stamp <= 0.2
    assert not [report for _, report in ear.heard if report.reason]
