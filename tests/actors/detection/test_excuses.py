"""A module that could not receive anything blames no node for that, for a short time."""

from __future__ import annotations

import asyncio

import pytest

from rampart.actors.bus.envelope import decode
from rampart.actors.detection.freshness import Freshness
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.machine.absence import GRACE_S
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.runtime.actor import Actor
from rampart.manager.spec.tables import FAILOVER_S
from rampart.testing import Ear, run
from tests.osmosis_system import POSE, System

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
