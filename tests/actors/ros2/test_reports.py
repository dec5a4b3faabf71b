"""Detections of errors that nodes of ROS 2 report: timelines, and from their wire on."""

import asyncio
import re

import msgspec
import pytest

from rampart.actors.detection.finding import Recurrent
from rampart.actors.ftm import topics
from rampart.actors.ros2.reports import ActionResult, Diagnostics, LogMatch, StatusMonitor
from rampart.actors.runtime.parameters import read_parameters
from rampart.testing import play, table
from tests import ROOT
from tests.actors.ros2.test_gateway import SYSTEM, beside, refusal

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


@pytest.mark.parametrize(("kind", "parameters", "words"), [
    (LogMatch, {"matches": "(a"}, "matches = '(a': not a regular expression"),
    (LogMatch, {"count": 0}, "count = 0"),
    (ActionResult, {"results": ["failed"]}, "results[0] = 'failed'"),
    (Diagnostics, {"status": ""}, "status"),
])
def test_parameters_that_make_no_sense_are_refused_by_name(kind, parameters, words):
    with pytest.raises(ValueError, match=r"\A[^\n]+\Z") as caught:
        read_parameters(kind.Parameters, {"topic": "a"} | parameters, "x.toml", "D.parameters")
    assert words in str(caught.value)


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
