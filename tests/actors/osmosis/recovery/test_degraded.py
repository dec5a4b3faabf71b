"""RM7 and RM8: respawn the Safety Pilot under brakes, and go on slowly."""

from __future__ import annotations

import asyncio

import pytest

from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.recovery.emergency_stop import EmergencyStop
from rampart.actors.osmosis.recovery.reduced_speed import ReducedSpeed
from rampart.actors.osmosis.recovery.respawn_braked import RespawnBraked
from rampart.actors.runtime.actor import every
from rampart.testing import run
from tests.actors.osmosis.recovery.world import Base, Boss, Node, Pilot, Supervisor
from tests.osmosis_system import System


class BoundedPilot(Pilot):
    """A Safety Pilot that says which bound it keeps."""

    @property
    def bound_mps(self) -> float:
        return min((o.top_speed_mps for o in self.orders.values() if o.engaged and o.top_speed_mps),
                   default=0.0)

    @every(0.2)
    def status(self) -> None:
        self.publish(topics.PILOT_STATUS, m.PilotStatus(self.mode, False, "", 0, self.bound_mps))


async def braking(system: System) -> tuple[Boss, Base, Supervisor]:
    boss, base = system.start("boss", Boss), system.start("base", Base)
    supervisor = system.start("supervisor", Supervisor)
    system.start("safety_pilot", Node)
    system.start("RM1", EmergencyStop)
    system.start("RM7", RespawnBraked, nodes=["safety_pilot"])
    await asyncio.sleep(0.5)
    return boss, base, supervisor


def test_a_pilot_that_lives_but_is_accused_is_respawned_with_the_brake_held_meanwhile():
    async def scenario() -> None:
        async with System() as system:
            boss, base, supervisor = await braking(system)
            boss.order("RM7", nodes=("safety_pilot#1",))
            await system.settle()
            assert base.engaged
            assert [r.failed_incarnation for _, r in supervisor.requests] == [1]
            await asyncio.sleep(0.5)
            assert system.incarnations["safety_pilot"] == 2
            assert not base.engaged
            boss.order("RM7", nodes=("safety_pilot#1",))
            await asyncio.sleep(0.5)
            assert system.incarnations["safety_pilot"] == 2
            assert base.orders == [True, False]

    run(scenario)


def test_while_the_pilot_does_not_come_back_the_brake_stays_and_the_release_lets_it_go():
    async def scenario() -> None:
        async with System() as system:
            boss, base, supervisor = await braking(system)
            supervisor.answer = "given up"
            boss.order("RM7", nodes=("safety_pilot#1",))
            await asyncio.sleep(1.0)
            assert base.engaged
            boss.release("RM7")
            await system.settle()
            assert not base.engaged

    run(scenario)


def test_the_brake_of_an_emergency_stop_is_not_released():
    async def scenario() -> None:
        async with System() as system:
            boss, base, supervisor = await braking(system)
            supervisor.delay_s = 0.5
            boss.order("RM7", nodes=("safety_pilot#1",))
            await system.settle()
            boss.order("RM1")
            await asyncio.sleep(1.5)
            assert system.incarnations["safety_pilot"] == 2
            boss.release("RM7")
            await asyncio.sleep(0.5)
            assert base.holders == {"RM1"}

    run(scenario)


def test_a_module_that_is_respawned_during_an_emergency_stop_lets_go_of_its_own_brake_only():
    async def scenario() -> None:
        async with System() as system:
            boss, base, _ = await braking(system)
            boss.order("RM1")
            await system.settle()
            for _ in range(3):
                await system.kill("RM7")
                system.start("RM7", RespawnBraked, nodes=["safety_pilot"])
                for _ in range(20):
                    boss.release("RM7")  # as the manager does that finds it idle
                    await system.settle()
                    assert base.engaged
                    await asyncio.sleep(0.01)

    run(scenario)


def test_the_farewells_of_an_emergency_stop_leave_the_brake_that_a_respawn_holds():
    async def scenario() -> None:
        async with System() as system:
            boss, base, supervisor = await braking(system)
            supervisor.delay_s = 0.9
            boss.order("RM1")
            await asyncio.sleep(0.3)
            boss.release("RM1")
            await asyncio.sleep(0.1)
            boss.order("RM7", nodes=("safety_pilot#1",))
            await system.settle()
            while system.incarnations["safety_pilot"] == 1:
                assert base.engaged
                await asyncio.sleep(0.02)

    run(scenario)


def test_a_respawned_module_that_is_not_wanted_any_more_releases_what_its_earlier_life_held():
    async def scenario() -> None:
        async with System() as system:
            boss, base, supervisor = await braking(system)
            supervisor.answer = "nothing"
            boss.order("RM7", nodes=("safety_pilot#1",))
            await system.settle()
            await system.kill("RM7")
            boss.release("RM7")
            await asyncio.sleep(0.5)
            assert base.engaged
            system.start("RM7", RespawnBraked, nodes=["safety_pilot"])
            await asyncio.sleep(0.5)
            assert not base.engaged

    run(scenario)


def test_the_pilot_is_bounded_until_released():
    async def scenario() -> None:
        async with System() as system:
            boss, pilot = system.start("boss", Boss), system.start("pilot", BoundedPilot)
            system.start("RM8", ReducedSpeed, top_speed_mps=0.6)
            await asyncio.sleep(0.5)
            boss.order("RM8")
            await system.settle()
            assert pilot.bound_mps == 0.6
            assert pilot.mode is m.PilotMode.AUTO
            assert boss.phases == ["idle", "acting", "degraded"]
            boss.release("RM8")
            await system.settle()
            assert pilot.bound_mps == 0.0

    run(scenario)


def test_a_pilot_that_keeps_no_bound_is_a_failure_at_the_deadline():
    async def scenario() -> None:
        async with System() as system:
            boss = system.start("boss", Boss)
            system.start("pilot", Pilot)
            system.start("RM8", ReducedSpeed)
            await asyncio.sleep(0.5)
            boss.order("RM8")
            await asyncio.sleep(3.0)
            assert boss.phases == ["idle", "acting", "failed"]

    run(scenario)


@pytest.mark.parametrize("bad", [0, -1.0, "fast", True])
def test_a_bound_that_is_none_is_refused_by_name(bad):
    async def scenario() -> None:
        async with System() as system:
            with pytest.raises(ValueError, match=r"parameters\.top_speed_mps = "):
                system.start("RM8", ReducedSpeed, top_speed_mps=bad)

    run(scenario)
