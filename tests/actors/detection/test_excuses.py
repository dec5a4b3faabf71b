"""A module that could not have heard anything blames nobody for it, and not for long."""

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


async def active_after_s(system: System, disturb) -> float | None:
    """Return how long after the last pose DM6 becomes active, if something happens to it."""
    ear, source = system.start("ear", Ear), system.start("localization", Source)
    module = system.start("DM6", Freshness, **POSE, timeout_s=TIMEOUT_S)
    await asyncio.sleep(2.0)
    for _ in range(20):
        source.publish(topics.POSE, m.Pose(0.0, 0.0, 0.0))
        await asyncio.sleep(0.05)
    last_s = system.clock.now() - 0.05
    ear.heard.clear()
    disturb(module)
    await asyncio.sleep(1.5)
    return next((at_s - last_s for at_s, report in ear.heard if report.reason), None)


def found(disturb) -> float | None:
    result: list[float | None] = []

    async def scenario() -> None:
        async with System() as system:
            result.append(await active_after_s(system, disturb))

    run(scenario)
    return result[0]


def hold(module: Actor, from_s: float, until_s: float) -> None:
    loop = asyncio.get_running_loop()
    loop.call_later(from_s, module.hold, True)
    loop.call_later(until_s, module.hold, False)


def test_silence_counts_as_soon_as_it_lasts():
    assert found(lambda _: None) == pytest.approx(TIMEOUT_S, abs=1e-3)


def test_one_that_was_stopped_does_not_blame_those_that_go_on_a_little_later():
    async def scenario() -> None:
        async with System() as system:
            ear, source = system.start("ear", Ear), system.start("localization", Source)
            module = system.start("DM6", Freshness, **POSE, timeout_s=TIMEOUT_S)
            for _ in range(40):
                source.publish(topics.POSE, m.Pose(0.0, 0.0, 0.0))
                await asyncio.sleep(0.05)
            module.hold(True)
            await asyncio.sleep(5.0)
            module.hold(False)
            await asyncio.sleep(0.4)
            for _ in range(40):
                source.publish(topics.POSE, m.Pose(0.0, 0.0, 0.0))
                await asyncio.sleep(0.05)
            assert not [report for _, report in ear.heard if report.reason]
            await asyncio.sleep(1.0)
            assert [report for _, report in ear.heard if report.reason], "then it is stale"

    run(scenario)


def test_one_that_concludes_nothing_yet_is_not_silent():
    async def scenario() -> None:
        async with System() as system:
            ear, source = system.start("ear", Ear), system.start("localization", Source)
            module = system.start("DM6", Freshness, **POSE, timeout_s=TIMEOUT_S)
            source.publish(topics.POSE, m.Pose(0.0, 0.0, 0.0))
            await asyncio.sleep(0.1)
            module.hold(True)
            await asyncio.sleep(5.0)
            ear.heard.clear()
            module.hold(False)
            source.publish(topics.POSE, m.Pose(0.0, 0.0, 0.0), stamp=system.clock.now() - 4.0)
            await asyncio.sleep(0.9 * GRACE_S)
            posted = system.hub.board.read(ftm_topics.DETECTION.at("DM6"))
            assert posted is not None
            report, _ = decode(ftm_topics.DETECTION, posted)
            assert system.clock.now() - report.stamp <= 0.2
            assert not [report for _, report in ear.heard if report.reason]

    run(scenario)


class Earlier(Freshness):
    """Has a deadline that comes to lie earlier, as a watchdog's may; counts its timers."""

    waiting = 0

    def follow(self) -> None:
        super().follow()
        self._sleep_until(self.clock.now() + 0.02)
        type(self).waiting = max(self.waiting, len(self._timers))


def test_a_deadline_that_comes_to_lie_earlier_leaves_no_timer_behind():
    async def scenario() -> None:
        async with System() as system:
            source = system.start("localization", Source)
            system.start("DM6", Earlier, **POSE, timeout_s=TIMEOUT_S)
            for _ in range(40):
                source.publish(topics.POSE, m.Pose(0.0, 0.0, 0.0))
                await asyncio.sleep(0.05)

    run(scenario)
    assert Earlier.waiting == 1


@pytest.mark.parametrize("late_s", [0.04, 0.08])
def test_a_module_that_was_late_reads_its_mail_for_as_long_before_it_judges(late_s):
    end_s = TIMEOUT_S - 0.05 + late_s
    after_s = found(lambda module: hold(module, 0.2, end_s))
    assert after_s == pytest.approx(TIMEOUT_S + 2 * late_s, abs=2e-3)


def test_a_timer_that_is_hardly_late_excuses_nothing():
    assert found(lambda module: hold(module, 0.2, 0.26)) == pytest.approx(0.31, abs=2e-3)


def test_when_its_router_has_died_it_waits_until_the_bus_has_gone_over():
    def disturb(module: Actor) -> None:
        answers = iter([True])
        module._bus.moved = lambda: next(answers, False)

    # It asks with its next report, within 0.2 s.
    assert TIMEOUT_S < found(disturb) <= 0.2 + FAILOVER_S + 1e-3


def test_routers_that_die_again_and_again_do_not_excuse_for_ever():
    def disturb(module: Actor) -> None:
        module._bus.moved = lambda: True

    assert found(disturb) <= 0.2 + FAILOVER_S + 1e-3
