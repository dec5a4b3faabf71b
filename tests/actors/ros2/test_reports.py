"""Modules for ROS 2: detections of what its nodes report, and the respawn of lifecycle nodes."""

from __future__ import annotations

import asyncio
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import msgspec
import pytest

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.messages import Heartbeat, Message
from rampart.actors.bus.topic import Qos, Topic
from rampart.actors.detection.finding import Recurrent
from rampart.actors.ftm import messages as m
from rampart.actors.ftm import topics
from rampart.actors.ros2.reports import ActionResult, Diagnostics, LogMatch, StatusMonitor
from rampart.actors.ros2.respawn_lifecycle import RespawnLifecycle
from rampart.actors.runtime.parameters import read_parameters
from rampart.testing import VirtualSystem, play, table
from tests import ROOT
from tests.actors.ros2.test_gateway import SYSTEM, beside, refusal
from tests.virtual_time import within

LEVELS = {"o": 0, "w": 1, "e": 2, "s": 3, "x": 7}


# o, w, e, s: the level of the one status. It may be 300 ms old.
@pytest.mark.parametrize(("times", "events", "expected"), **table({
    "well": ({}, "oooo", "----"),
    "an error": ({}, "ooeeooo", "--AA---"),
    "a warning is below it": ({}, "owwo", "----"),
    "stale, and a level that ROS 2 does not have, are above it": ({}, "osoxo", "-A-A-"),
    "for a moment": ({"for_s": 0.2}, "oeeooee", "-------"),
    "for long enough": ({"for_s": 0.2}, "oeee", "---A"),
    "it has to be well for a while": ({"clear_s": 0.2}, "eoeooo", "AAAAA-"),
    "it is there no more": ({}, "o......", "---AAAA"),
    "and comes again": ({}, "o...o", "---A-"),
    "an error is not healed by silence": ({}, "e....", "AAAAA"),
    "it was never there": ({"grace_s": 0.5}, ".......", "-----AA"),
    "a restarted module does not know at once": (
        {"grace_s": 0.3, "known": False}, "oooo", "???-"),
    "but knows an error": ({"grace_s": 0.5, "known": False}, ".e", "?A"),
}))
def test_a_status(times, events, expected):
    monitor = StatusMonitor("a*", 2, 0.3, **{"grace_s": 0.3} | times)
    assert play(monitor, lambda event, now_s: monitor.heard(
        [("arm", LEVELS[event], "why"), ("base", 2, "another one")], now_s, now_s),
        events) == expected


def test_of_several_statuses_the_worst_is_named():
    monitor = StatusMonitor("*", 1, 1.0)
    monitor.heard([("arm", 1, "warm"), ("base", 0, "")], 0.0, 0.0)
    assert monitor.reason == "arm: warn: warm"
    monitor.heard([("base", 2, "hot\nand loud")], 0.1, 0.1)
    assert monitor.reason == "base: error: hot and loud"
    monitor.heard([("base", 0, "")], 0.2, 0.2)
    assert monitor.reason == "arm: warn: warm"
    monitor.expire(1.1)
    assert monitor.reason == "arm: no status for 1 s"


def test_a_status_with_an_old_stamp_is_not_new():
    monitor = StatusMonitor("*", 2, 1.0)
    for tick in range(12):
        monitor.heard([("arm", 0, "")], 0.0, tick / 10)
    assert monitor.reason == "arm: no status for 1 s"


def test_more_statuses_than_are_remembered_are_an_error():
    monitor = StatusMonitor("*", 2, 1.0)
    monitor.heard([(f"s{number}", 0, "") for number in range(100_000)], 0.0, 0.0)
    assert monitor.reason == "more than 1000 statuses match '*'"


# !: an event. Three within 500 ms; 200 ms without one end it.
@pytest.mark.parametrize(("count", "events", "expected"), **table({
    "one": (1, ".!....", "-AA---"),
    "too few": (3, "!!....!!", "--------"),
    "enough": (3, "!!!...", "--AA--"),
    "too slow": (3, "!..!..!..!", "----------"),
    "it goes on": (3, "!!!!!..", "--AAAA-"),
    "again, with those before": (3, "!!!..!", "--AA-A"),
}))
def test_events_that_recur(count, events, expected):
    monitor = Recurrent(count, 0.5, 0.2)
    assert play(monitor, lambda _event, now_s: monitor.happened("it", now_s), events) == expected


@pytest.mark.parametrize("kind", [Diagnostics, ActionResult, LogMatch])
def test_the_reference_has_the_parameters_there_are(kind):
    text = (ROOT / "docs/reference/ros2.md").read_text(encoding="utf-8")
    (row,) = re.findall(rf"^\| `{kind.__name__}` \| .* \| (.*) \|$", text, re.MULTILINE)
    known = {field.name for field in msgspec.structs.fields(kind.Parameters)}
    assert set(re.findall(r"`([a-z_]+)`", row)) == known


# -- from the wire of ROS 2 on ---------------------------------------------------------------------

REPORTS = """
[[node]]
name = "asker"
actor = "tests.actors.ros2.robot:Asker"
kind = "control"
parameters = { topic = "nav/goal" }

[[node]]
name = "reporter"
actor = "tests.actors.ros2.robot:Reporter"
kind = "world"

[[ros2]]
goal = "/navigate_to_pose"
type = "nav2_msgs/action/NavigateToPose"
from = "nav/goal"
to = "nav/state"

[[ros2]]
subscribe = "/diagnostics"
type = "diagnostic_msgs/msg/DiagnosticArray"
to = "ros/diagnostics"
publishers = "any"

[[ros2]]
subscribe = "/rosout"
type = "rcl_interfaces/msg/Log"
to = "ros/log"
publishers = "any"

[[ros2]]
subscribe = "/navigate_to_pose/_action/status"
type = "action_msgs/msg/GoalStatusArray"
to = "ros/goals"

[[detection]]
name = "D_STATUS"
title = "A driver reports an error"
actor = "rampart.actors.ros2.reports:Diagnostics"
within_s = 3.0
parameters = { topic = "ros/diagnostics", status = "*", stale_s = 2.0, suspects = ["gateway"] }

[[detection]]
name = "D_LOG"
title = "The planner finds no way"
actor = "rampart.actors.ros2.reports:LogMatch"
within_s = 3.0
parameters = { topic = "ros/log", logger = "planner*", level = "warn", \
matches = "(?i)no (way|path)", count = 3, within_s = 1.0 }

[[detection]]
name = "D_GOAL"
title = "A goal of another node is aborted"
actor = "rampart.actors.ros2.reports:ActionResult"
within_s = 3.0
parameters = { topic = "ros/goals", count = 2, within_s = 5.0 }

[[detection]]
name = "D_OWN"
title = "A goal of the system is refused"
actor = "rampart.actors.ros2.reports:ActionResult"
within_s = 3.0
parameters = { topic = "nav/state" }

[[mechanism]]
name = "M_REPORTS"
detect = "D_STATUS or D_LOG or D_GOAL or D_OWN"
recover = "R_RESTART"
event = "missing"
against = { within_s = 20.0, hazard = "the robot stands" }
"""


async def started(system, *modules):
    """Start modules, gateway and reporter; return the reporter, and the modules' reports."""
    heard = system.hear(topics.DETECTION)
    for name in modules:
        system.start_node(name)
    system.start_node("gateway")
    reporter = system.start_node("reporter")
    await asyncio.sleep(0.5)

    def changes(name):
        found = []
        for one in heard:
            report = one.message
            if one.header.source == name and (report.state.value, report.reason) not in found[-1:]:
                found.append((report.state.value, report.reason))
        return found

    return reporter, changes


@beside(REPORTS)
async def test_an_error_in_the_diagnostics_is_named_until_it_is_over(system):
    """The gateway's own report kept a module active; a second node's message replaced a first."""
    reporter, changes = await started(system, "D_STATUS")
    assert changes("D_STATUS") == [("idle", "")]
    reporter.statuses = {"arm": (2, "91 °C")}
    await asyncio.sleep(0.5)
    reporter.statuses = {"arm": (0, "60 °C")}
    await asyncio.sleep(1.0)
    assert changes("D_STATUS") == [("idle", ""), ("active", "arm: error: 91 °C"), ("idle", "")]
    await system.kill("reporter")
    await asyncio.sleep(3.0)  # the gateway reports D_STATUS itself as an error now
    assert changes("D_STATUS")[3:] == [("active", "arm: no status for 2 s")]
    reporter = system.start_node("reporter")
    await asyncio.sleep(1.0)
    assert changes("D_STATUS")[4:] == [("idle", "")]
    reporter.is_silent = True
    reporter.report({"lidar": (2, "no data")})
    reporter.report({"camera": (0, "ok")})
    await asyncio.sleep(0.1)
    assert changes("D_STATUS")[5:] == [("active", "lidar: error: no data")]


@beside(REPORTS)
async def test_lines_of_the_log_are_counted(system):
    reporter, changes = await started(system, "D_LOG")
    for name, level, text in (("planner_server", 30, "No path to (2, 3)"),
                              ("planner_server", 30, "no way at all"),
                              ("planner_server", 20, "no path, never mind"),
                              ("controller_server", 40, "no path"),
                              ("planner_server", 40, "no plugin")):
        reporter.log(name, level, text)
    await asyncio.sleep(0.3)
    assert changes("D_LOG") == [("idle", "")]
    reporter.log("planner_server", 40, "still no path")
    await asyncio.sleep(2.0)
    assert changes("D_LOG") == [("idle", ""), (
        "active", "3 within 1 s, the last: planner_server: still no path"), ("idle", "")]


@beside(REPORTS)
async def test_goals_of_others_that_are_aborted_are_counted_once_each(system):
    reporter, changes = await started(system, "D_GOAL")
    for goals in ([6, 6, 2], [6, 6, 4], [6, 6, 4, 2], [6, 6, 4, 6], [6, 6, 4, 6]):
        reporter.goals(goals)
        await asyncio.sleep(0.1)
    assert changes("D_GOAL") == [("idle", "")]  # two are older than the run
    reporter.goals([6, 6, 4, 6, 6])
    await asyncio.sleep(0.1)
    assert changes("D_GOAL")[-1] == ("active", "2 within 5 s, the last: a goal aborted")


@beside(REPORTS)
async def test_a_goal_of_the_system_that_no_server_answers(system):
    _, changes = await started(system, "D_OWN")
    topic = system.actors["gateway"].chosen_topic("nav/goal")
    system.say(topic, topic.type())
    await asyncio.sleep(1.3)
    assert changes("D_OWN")[:2] == [
        ("idle", ""), ("active", "goal 1 unanswered: no server answers")]


@pytest.mark.parametrize(("topic", "words"), [
    ("ros/log", "D_STATUS: parameters.topic: ros/log: expected diagnostic_msgs/msg/Diagnostic"),
    ("ros/nothing", "ros/nothing")])
def test_a_topic_of_another_type_is_refused_before_anything_runs(tmp_path, topic, words):
    assert words in refusal(tmp_path, SYSTEM + REPORTS.replace(
        'topic = "ros/diagnostics"', f'topic = "{topic}"'))


class Ask(Message, frozen=True):
    """A request without fields."""


class Transition(Message, frozen=True):
    """Of lifecycle_msgs."""

    id: int
    label: str


class Change(Message, frozen=True):
    """A request of a transition."""

    transition: Transition


class State(Message, frozen=True):
    """An answer; None if there is none."""

    id: int | None = None


ASK = Topic("planner/ask", Ask, Qos.COMMAND, 0, "", "GetState.")
STATE = Topic("planner/state", State, Qos.COMMAND, 0, "", "Its answer.")
CHANGE = Topic("planner/change", Change, Qos.COMMAND, 0, "", "ChangeState.")
GIVEN = {"nodes": ["planner", "guard"], "lifecycle": ["planner"], "ask": ["planner/ask"],
         "state": ["planner/state:id"], "change": ["planner/change"],
         "appear_s": 0.5, "configure_s": 0.6, "activate_s": 0.7}
ACTIVE, FINALIZED = 3, 4


class Case:
    """The recovery, a manager that commands it, a supervisor, and a lifecycle node `planner`."""

    def __init__(self, system: VirtualSystem) -> None:
        self.system = system
        self.state: int | None = ACTIVE
        self.next = {(1, 1): 2, (2, 3): ACTIVE}
        self.changes: list[int] = []
        self.answers = True
        self.requests = system.hear(topics.RESPAWN)
        self.reports = system.hear(topics.RECOVERY)
        self.asks, self.orders = system.hear(ASK), system.hear(CHANGE)
        self.seen = 0, 0
        system.start("R", RespawnLifecycle, **GIVEN)

    async def play(self, for_s: float) -> None:
        for _ in range(round(for_s / 0.01)):
            await asyncio.sleep(0.01)
            for heard in self.orders[self.seen[1]:]:
                self.changes.append(heard.message.transition.id)
                self.state = self.next.get((self.state, self.changes[-1]), self.state)
            if len(self.asks) > self.seen[0] and self.answers:
                self.system.say(STATE, State(self.state), "gateway")
            self.seen = len(self.asks), len(self.orders)

    def command(self, decision: int, *nodes: str) -> None:
        self.system.say(topics.RECOVERY_COMMAND, m.RecoveryCommand(
            True, decision, nodes, "why"), "manager", member="R")

    async def die_and_come_back(self, node: str, incarnation: int, state: int | None) -> None:
        self.say_event(node, "crashed", incarnation)
        self.command(incarnation, node)
        await self.system.settle()
        assert self.requests[-1].message.node == node
        self.state = state
        self.say_event(node, "respawned", incarnation + 1)
        await asyncio.sleep(0.01)
        self.system.say(bus_topics.HEARTBEAT, Heartbeat(1, 0, 0.1, 0, 0), node,
                        incarnation=incarnation + 1, member=node)
        await self.system.settle()

    def say_event(self, node: str, event: str, incarnation: int) -> None:
        self.system.say(topics.PROCESS_EVENT, m.ProcessEvent(
            node, event, 1, incarnation, "R", ""), "supervisor")

    @property
    def report(self) -> m.RecoveryReport:
        return self.reports[-1].message


@asynccontextmanager
async def played() -> AsyncIterator[Case]:
    async with VirtualSystem(topics=(ASK, STATE, CHANGE)) as system:
        case = Case(system)
        await asyncio.sleep(0.05)
        yield case


@within(played)
async def test_a_respawned_node_is_configured_and_activated_and_only_then_the_module_is_done(case):
    await case.die_and_come_back("planner", 1, state=1)
    assert case.report.phase.value == "acting"
    await case.play(1.0)
    assert case.changes == [1, 3]
    assert case.report.phase.value == "done"
    await case.die_and_come_back("planner", 2, state=1)  # once more
    assert case.report.phase.value == "acting"
    await case.play(1.0)
    assert case.changes == [1, 3, 1, 3]
    assert case.report.phase.value == "done"


@within(played)
async def test_a_node_that_activates_itself_or_has_no_life_cycle_is_accepted(case):
    await case.die_and_come_back("guard", 1, state=None)
    assert (case.report.phase.value, case.asks) == ("done", [])
    await case.die_and_come_back("planner", 1, state=ACTIVE)
    await case.play(0.5)
    assert (case.changes, case.report.phase.value) == ([], "done")


@pytest.mark.parametrize(("state", "next_states", "answers", "words"), [
    (1, {}, False, "planner: no step appear within 0.5 s"),
    (None, {}, True, "planner: no step appear within 0.5 s"),  # the service does not answer
    (1, {}, True, "planner: no step configure within 0.6 s"),
    (1, {(1, 1): 2}, True, "planner: no step activate within 0.7 s"),
    (1, {(1, 1): FINALIZED}, True, "planner: finalized")])
@within(played)
async def test_the_step_that_fails_is_named(case, state, next_states, answers, words):
    case.next, case.answers = next_states, answers
    await case.die_and_come_back("planner", 1, state)
    await case.play(1.8)
    assert (case.report.phase.value, case.report.reason) == ("failed", words)
    if answers and state:  # what was refused has been requested again, until it was too late
        case.next = {(1, 1): 2, (2, 3): ACTIVE, (FINALIZED, 1): 2}
        await case.die_and_come_back("planner", 2, state=1)
        await case.play(1.0)
        assert case.report.phase.value == "done"


@within(played)
async def test_a_node_that_dies_while_it_is_configured_is_respawned_again(case):
    case.next = {}
    await case.die_and_come_back("planner", 1, state=1)
    await case.play(0.3)
    case.say_event("planner", "crashed", 2)
    case.command(1, "planner")  # the manager repeats its command
    await case.system.settle()
    assert case.requests[-1].message.failed_incarnation == 2


@pytest.mark.parametrize(("kind", "parameters", "words"), [
    (LogMatch, {"topic": "a", "matches": "(a"}, r"matches = '\(a': not a regular expression"),
    (LogMatch, {"topic": "a", "count": 0}, "count = 0"),
    (ActionResult, {"topic": "a", "results": ["failed"]}, r"results\[0\] = 'failed'"),
    (Diagnostics, {"topic": "a", "status": ""}, "status"),
    (RespawnLifecycle, {**GIVEN, "lifecycle": ["other"]}, "lifecycle.*other: not among nodes"),
    (RespawnLifecycle, {**GIVEN, "ask": []}, "ask.*expected 1 entries"),
    (RespawnLifecycle, {**GIVEN, "state": ["a:b", "c:d"]}, "state.*expected 1 entries"),
    (RespawnLifecycle, {**GIVEN, "change": ["a", "b"]}, "change.*expected 1 entries")])
def test_parameters_that_make_no_sense_are_refused_by_name(kind, parameters, words):
    with pytest.raises(ValueError, match=words) as caught:
        read_parameters(kind.Parameters, parameters, "x.toml", "D.parameters")
    assert "\n" not in str(caught.value)
