"""The FTM Manager among modules on one virtual bus; nothing here takes real time."""

import asyncio

from rampart.actors.detection.stub import StubDetection
from rampart.actors.machine.absence import GRACE_S
from rampart.sim.virtual.virtual_loop import VirtualLoop
from tests.manager.bench import Managed
from tests.virtual_time import within


@within(Managed)
async def test_an_emergency_stop_comes_with_the_report_and_stays_until_it_is_reset(system):
    system.detect("DM1")
    await system.settle()
    assert system.taken == [(("FTM1",), 1, ("RM1",))]
    await system.reset("RM1")
    told, = (one.message for one in system.problems)
    assert (told.context, told.reason) == ("reset refused", "the cause persists: FTM1 active")
    system.detect()
    await asyncio.sleep(5.0)
    assert (system.status.activated, system.status.latched) == (("RM1",), ("RM1",))
    await system.reset("RM1")
    assert (system.status.activated, system.status.latched) == ((), ())


@within(Managed)
async def test_a_detection_module_that_lives_and_is_not_heard_is_replaced_once(system):
    timeout_s = system.run.system.timing.detection_silence_timeout_s
    hung_s = system.clock.now()
    system.actors["DM3"].hold(True)
    await asyncio.sleep(3.0)
    asked, = system.respawns
    assert 0.4 * timeout_s < asked.time_s - hung_s < 0.75 * timeout_s
    assert (asked.message.node, asked.message.failed_incarnation, asked.message.by) == (
        "DM3", 1, "ftm_manager")
    assert system.status.silent == ("DM3",)
    await system.kill("DM3")
    again = system.start("DM3", StubDetection)
    await asyncio.sleep(2.0)
    assert system.status.silent == ()
    again.hold(True)
    await asyncio.sleep(2.0)
    assert [(r.message.request, r.message.node, r.message.failed_incarnation)
            for r in system.respawns] == [(1, "DM3", 1), (2, "DM3", 2)]


@within(Managed)
async def test_a_respawned_manager_adopts_a_latched_emergency_stop(system):
    system.detect("DM1")
    await asyncio.sleep(0.5)
    await system.kill("ftm_manager")
    system.detect()
    await asyncio.sleep(2.0)
    system.start_manager()
    for _ in range(100):
        await asyncio.sleep(0.05)
        assert system.actors["RM1"].activated
    assert system.status.latched == ("RM1",)
    await system.reset("RM1")
    assert not system.actors["RM1"].activated


@within(Managed)
async def test_a_manager_that_was_stopped_takes_nobodys_unread_mail_for_silence(system):
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    for pause_s in (0.31, 0.4, 0.5, 0.7, 1.1, 5.0):
        loop.jump(pause_s)
        await asyncio.sleep(2.0)
    assert not any(status.message.silent for status in system.statuses)
    assert system.decisions == []


@within(Managed)
async def test_a_manager_that_was_stopped_waits_for_modules_that_go_on_after_it(system):
    for actor in system.actors.values():
        actor.hold(True)
    await asyncio.sleep(5.0)
    system.actors["ftm_manager"].hold(False)
    await asyncio.sleep(0.8 * GRACE_S)
    for actor in system.actors.values():
        actor.hold(False)
    await asyncio.sleep(2.0)
    assert system.decisions == []
    assert system.respawns == []
    system.actors["DM6"].hold(True)
    await asyncio.sleep(2.0)
    assert "DM6" in system.status.silent
