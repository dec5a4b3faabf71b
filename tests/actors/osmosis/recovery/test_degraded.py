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
from tests.actors.osmosis.recovery.world import Base, Boss, Node, Pilot, Supervisor
from tests.osmosis_system import System, in_system


class BoundedPilot(Pilot):
    """A Safety Pilot that reports its speed limit."""

    @property
    def bound_mps(self) -> float:
        return min((o.top_speed_mps for o in self.orders.values() if o.engaged and o.top_speed_mps),
                   default=0.0)

    @every(0.2)
    def status(self) -> None:
        self.publish(topics.PILOT_STATUS, m.PilotStatus(self.mode, False, "", 0, self.bound_mps))


async def braking(system: System) -> tuple[Boss, Base, Supervisor]:
    boss, base = Boss(system), system.start("base", Base)
    supervisor = system.start("supervisor", Supervisor)
    system.start("safety_pilot", Node)
    system.start("RM1", EmergencyStop)
    system.start("RM7", RespawnBraked, nodes=["safety_pilot"])
    await asyncio.sleep(0.5)
    return boss, base, supervisor


@in_system()
async def test_a_pilot_that_lives_but_is_accused_is_respawned_with_the_brake_held(system):
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
    supervisor.answer = "given up"
    boss.order("RM7", decision=2, nodes=("safety_pilot#2",))
    await asyncio.sleep(1.0)
    assert base.engaged, "it stays so while the pilot does not come back, until released"
    boss.release("RM7", decision=3)
    await system.settle()
    assert not base.engaged


@in_system()
async def test_the_brake_of_an_emergency_stop_is_not_released(system):
    """Neither by the end of a respawn, nor by lives of the module that find themselves idle."""
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
    for _ in range(3):
        await system.kill("RM7")
        system.start("RM7", RespawnBraked, nodes=["safety_pilot"])
        for _ in range(20):
            boss.release("RM7")  # as the manager does that finds it idle
            await system.settle()
            assert base.engaged
            await asyncio.sleep(0.01)


@in_system()
async def test_the_farewells_of_an_emergency_stop_leave_the_brake_that_a_respawn_holds(system):
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


@pytest.mark.parametrize("obeys", [True, False])
@in_system()
async def test_the_pilot_is_bounded_until_released_and_one_that_keeps_no_bound_fails(system, obeys):
    boss = Boss(system)
    pilot = system.start("pilot", BoundedPilot if obeys else Pilot)
    system.start("RM8", ReducedSpeed, top_speed_mps=0.6)
    await asyncio.sleep(0.5)
    boss.order("RM8")
    await asyncio.sleep(3.0)
    assert boss.phases == ["idle", "acting", "degraded" if obeys else "failed"]
    assert pilot.mode is m.PilotMode.AUTO
    if obeys:
        assert pilot.bound_mps == 0.6
        boss.release("RM8")
        await system.settle()
        assert pilot.bound_mps == 0.0
