"""DM4, DM5, DM7: nodes that die, stop or hang, and come back."""

from __future__ import annotations

import asyncio
import math

import pytest

from rampart.actors.bus.envelope import decode
from rampart.actors.detection.freshness import Freshness
from rampart.actors.detection.watchdog import Watchdog, WatchdogCore
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.ftm.messages import DetectionState
from rampart.actors.machine.absence import GRACE_S
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.runtime.actor import Actor
from rampart.actors.runtime.parameters import read_parameters
from rampart.manager.spec.tables import FAILOVER_S
from rampart.testing import Ear, play, run, table
from tests.osmosis_system import POSE, System
from tests.virtual_time import within

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


@pytest.mark.parametrize("watch_list", ["a", [], [1], [""]])
def test_a_watch_list_that_is_none_is_refused_by_name(watch_list):
    with pytest.raises(ValueError, match=r"DM4: x\.watch.* = .*: expected a (list of node )?name"):
        read_parameters(Watchdog.Parameters, {"watch": watch_list}, "DM4", "x")


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


def watched(script):
    """Run a script with DM6, the source that it watches, and a reader of its reports."""
    async def scenario():
        async with System() as system:
            ear, source = system.start("ear", Ear), system.start("localization", Source)
            module = system.start("DM6", Freshness, **POSE, timeout_s=TIMEOUT_S)
            return await script(system, ear, source, module)

    return run(scenario)


async def publish(source: Source, count: int, **words: float) -> None:
    for _ in range(count):
        source.publish(topics.POSE, m.Pose(0.0, 0.0, 0.0), **words)
        await asyncio.sleep(0.05)


def active_after_s(disturb) -> float | None:
    """Return how long after the last pose DM6 becomes active, if something happens to it."""
    async def script(system, ear, source, module):
        await asyncio.sleep(2.0)
        await publish(source, 20)
        last_s = system.clock.now() - 0.05
        ear.heard.clear()
        disturb(module)
        await asyncio.sleep(1.5)
        return next((at_s - last_s for at_s, report in ear.heard if report.reason), None)

    return watched(script)


@pytest.mark.parametrize(("held_until_s", "active_s"), [
    (None, TIMEOUT_S),  # silence counts as soon as it lasts
    (0.26, 0.31),  # hardly late: that excuses nothing
    (0.29, 0.38), (0.33, 0.46)])  # it reads its mail for as long as it was late
def test_a_module_that_was_late_reads_its_mail_before_it_judges(held_until_s, active_s):
    def disturb(module: Actor) -> None:
        if held_until_s:
            loop = asyncio.get_running_loop()
            loop.call_later(0.2, module.hold, True)
            loop.call_later(held_until_s, module.hold, False)

    assert active_after_s(disturb) == pytest.approx(active_s, abs=2e-3)


def test_a_module_that_does_not_decide_yet_is_not_silent():
    async def script(system, ear, source, module):
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

    watched(script)


@pytest.mark.parametrize("again", [False, True])
def test_when_its_router_has_died_it_waits_for_the_bus_but_not_for_ever(again):
    def disturb(module: Actor) -> None:
        answers = iter([True])
        module._bus.moved = lambda: next(answers, again)

    # It asks with its next report, within 0.2 s.
    assert TIMEOUT_S < active_after_s(disturb) <= 0.2 + FAILOVER_S + 1e-3
