"""DM2 and DM6: a topic that goes stale, by the stamps of its samples."""

from __future__ import annotations

import asyncio
import math

import pytest

from rampart.actors.detection.freshness import Freshness, FreshnessMonitor
from rampart.actors.ftm import messages as fm
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.testing import Ear, play, table
from tests.osmosis_system import COMMAND, POSE, in_system

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
