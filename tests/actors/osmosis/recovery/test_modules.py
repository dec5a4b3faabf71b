"""RM1 to RM8 as actors: what they do to base, pilot, supervisor and Mission Manager."""

from __future__ import annotations

import asyncio

import pytest

from rampart.actors.bus.run_folder import EPOCH
from rampart.actors.ftm import messages as fm
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.control.mission.mission_manager import MissionManager
from rampart.actors.osmosis.messages import Mode, PilotMode
from rampart.actors.osmosis.recovery.controlled_stop import ControlledStop
from rampart.actors.osmosis.recovery.emergency_stop import EmergencyStop
from rampart.actors.osmosis.recovery.reduced_speed import ReducedSpeed
from rampart.actors.osmosis.recovery.replan import Replan
from rampart.actors.osmosis.recovery.respawn_braked import RespawnBraked
from rampart.actors.osmosis.recovery.switch_teleoperation import SwitchTeleoperation
from rampart.actors.recovery.respawn import Respawn
from rampart.actors.runtime.actor import Actor, on
from tests.actors.osmosis.recovery.world import Base, Boss, Node, Pilot, Supervisor
from tests.osmosis_system import System, in_system

# ---- RM1 ---------------------------------------------------------------------------------------


async def stopping(system: System, *, deaf: bool = False) -> tuple[Boss, Base]:
    """Start RM1, who commands it, and the base that it brakes."""
    boss, base = Boss(system), system.start("base", Base)
    system.start("RM1", EmergencyStop)
    base.deaf = deaf
    await system.settle()
    return boss, base


@in_system()
async def test_the_brake_is_engaged_before_any_time_passes_and_stays_so(system):
    boss, base = await stopping(system)
    boss.order("RM1")
    await system.settle()
    assert base.engaged
    assert boss.phases == ["idle", "acting"]
    await asyncio.sleep(1.0)
    assert boss.phases == ["idle", "acting", "degraded"]
    assert base.orders.count(True) == pytest.approx(6, abs=1)
    base.holders.clear()  # a new life of the base, which has forgotten
    await asyncio.sleep(0.35)
    assert base.engaged
    boss.release("RM1")
    await asyncio.sleep(3.0)
    assert not base.engaged
    assert boss.phases == ["idle", "acting", "degraded", "idle"]
    assert base.orders.count(False) == 6


@pytest.mark.parametrize("ordered_again", [False, True])
@in_system()
async def test_a_release_waits_for_the_brake_and_a_new_order_cancels_it(system, ordered_again):
    boss, base = await stopping(system, deaf=True)
    boss.order("RM1", decision=1)
    await system.settle()
    boss.release("RM1", decision=7)
    await asyncio.sleep(0.5)
    assert boss.phases == ["idle", "acting"]
    assert False not in base.orders
    if ordered_again:
        boss.order("RM1", decision=8)
        await system.settle()
    base.deaf = False
    await asyncio.sleep(1.0)
    assert base.engaged is ordered_again
    assert boss.phases[-1] == ("degraded" if ordered_again else "idle")
    assert boss.reports[-1].message.decision == (8 if ordered_again else 7)


@pytest.mark.parametrize("engaged", [True, False])
@in_system()
async def test_a_respawned_emergency_stop_takes_up_what_it_finds_at_the_brake(system, engaged):
    boss, base = await stopping(system)
    if engaged:
        boss.order("RM1")
    await asyncio.sleep(0.5)
    await system.kill("RM1")
    boss.reports.clear()
    system.start("RM1", EmergencyStop)
    await asyncio.sleep(1.0)
    assert boss.phases[0] == ("acting" if engaged else "idle")
    assert boss.phases[-1] == ("degraded" if engaged else "idle")
    assert base.engaged is engaged
    boss.release("RM1")
    await asyncio.sleep(0.3)
    assert not base.engaged


@in_system()
async def test_a_module_that_was_itself_stopped_reads_its_mail_before_it_reports_failure(system):
    boss, base = await stopping(system, deaf=True)
    boss.order("RM1")
    await system.settle()
    base.holders.add("somebody")
    asyncio.get_running_loop().jump(5.0)  # type: ignore[attr-defined]
    await asyncio.sleep(0.5)
    assert boss.phases == ["idle", "acting", "degraded"]


# ---- RM2, RM5 ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("cls", "mode"), [
    (ControlledStop, PilotMode.STOP), (SwitchTeleoperation, PilotMode.TELEOPERATION)])
@in_system()
async def test_the_pilot_is_ordered_until_released(system, cls, mode):
    boss, pilot = Boss(system), system.start("pilot", Pilot)
    system.start("RM", cls)
    await asyncio.sleep(1.0)
    assert pilot.heard == 0
    for _ in range(3):  # the same decision again is one
        boss.order("RM", reason="DM2: command not updated")
        await system.settle()
    assert pilot.heard == 1
    assert pilot.gate.mode is mode
    assert pilot.gate.orders["RM"].reason == "DM2: command not updated"
    boss.order("RM", decision=2)
    await system.settle()
    assert boss.phases == ["idle", "acting", "degraded"]
    acknowledged = boss.reports[-1].message
    assert (acknowledged.state, acknowledged.decision) == (fm.RecoveryState.ACTIVATED, 2)
    await asyncio.sleep(1.0)
    assert pilot.heard == pytest.approx(7, abs=1)
    boss.release("RM")
    await system.settle()
    assert pilot.gate.mode is PilotMode.AUTO
    await asyncio.sleep(3.0)
    assert boss.phases == ["idle", "acting", "degraded", "idle"]
    assert pilot.heard == pytest.approx(13, abs=1)


@in_system()
async def test_a_stop_fulfils_the_order_to_switch_to_teleoperation(system):
    boss = Boss(system)
    system.start("pilot", Pilot)
    rm2, rm5 = system.start("RM2", ControlledStop), system.start("RM5", SwitchTeleoperation)
    await system.settle()
    for ordered, rm2_phase in (("RM5", fm.RecoveryPhase.IDLE), ("RM2", fm.RecoveryPhase.DEGRADED)):
        boss.order(ordered)
        await asyncio.sleep(0.5)
        assert (rm2.phase, rm5.phase) == (rm2_phase, fm.RecoveryPhase.DEGRADED)


# ---- RM3, RM4 ----------------------------------------------------------------------------------


async def respawning(system: System) -> tuple[Boss, Supervisor]:
    boss, supervisor = Boss(system), system.start("supervisor", Supervisor)
    for name in ("a", "b"):
        system.start(name, Node)
    system.start("RM3", Respawn, nodes=["a", "b"])
    await asyncio.sleep(0.5)
    return boss, supervisor


@pytest.mark.parametrize("takeovers", [0, 20_000])
@in_system()
async def test_a_dead_node_is_asked_for_at_once_and_done_when_it_is_heard(system, takeovers):
    if takeovers:
        system.incarnations["RM3"] = takeovers * EPOCH
    boss, supervisor = await respawning(system)
    await system.kill("a")
    boss.order("RM3", nodes=("a",))
    await system.settle()
    assert [(r.node, r.failed_incarnation, r.by) for r in supervisor.requests] == [
        ("a", 1, "RM3")]
    assert boss.phases == ["idle", "acting"]
    await asyncio.sleep(0.1)
    assert boss.phases == ["idle", "acting", "done"]
    assert boss.reports[-1].message.reason == "a back"
    assert system.incarnations["a"] == 2


@in_system()
async def test_a_supervisor_that_is_away_is_asked_until_the_deadline(system):
    boss, supervisor = await respawning(system)
    supervisor.answer = "nothing"
    await system.kill("a")
    boss.order("RM3", nodes=("a",))
    await asyncio.sleep(1.9)
    assert len({r.request for r in supervisor.requests}) == 1
    assert len(supervisor.requests) == pytest.approx(10, abs=1)
    await asyncio.sleep(0.2)
    assert boss.reports[-1].message.reason == "not done within 2 s: a"
    supervisor.answer = "respawned"
    await asyncio.sleep(0.5)
    assert boss.phases == ["idle", "acting", "failed", "done"]


# ---- RM7, RM8 ----------------------------------------------------------------------------------


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
    assert [r.failed_incarnation for r in supervisor.requests] == [1]
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
    pilot = system.start("pilot", Pilot)
    pilot.tells_bound = obeys
    system.start("RM8", ReducedSpeed, top_speed_mps=0.6)
    await asyncio.sleep(0.5)
    boss.order("RM8")
    await asyncio.sleep(3.0)
    assert boss.phases == ["idle", "acting", "degraded" if obeys else "failed"]
    assert pilot.gate.mode is PilotMode.AUTO
    if obeys:
        assert pilot.gate.top_speed_mps == 0.6
        boss.release("RM8")
        await system.settle()
        assert pilot.gate.top_speed_mps == 0.0


# ---- RM6 -----------------------------------------------------------------------------------------

DOWN = m.Goal(-29.5, -3.0, Mode.TAXI)


class Planner(Actor):
    """Answers each goal with a route, unless it is set to be silent."""

    outputs = (topics.ROUTE,)
    way = ((0.0, 0.0), (1.0, 0.0))
    dumb = False

    @on(topics.GOAL)
    def goal(self, message, header):
        if not self.dumb:
            self.publish(topics.ROUTE, m.Route(
                message.mission_id, message.step, message.goal.mode, message.active,
                self.way if message.active else (), "" if self.way else "no way", message.plan))


async def replanning(system, *, mission=True):
    """Start RM6, who commands it, the planner, and a Mission Manager with a mission."""
    boss, planner = Boss(system), system.start("planner", Planner)
    manager = system.start("mission_manager", MissionManager)
    system.start("RM6", Replan)
    await system.settle()
    if mission:
        system.say(topics.MISSION_REQUEST, m.MissionRequest("m1", "A", (DOWN,)))
    await asyncio.sleep(0.5)
    return boss, planner, manager


@in_system(airport=load_airport("vallombre"))
async def test_a_replan_is_done_when_the_new_route_is_there(system):
    boss, _, manager = await replanning(system)
    for decision, plan in ((1, 1), (1, 1), (2, 2)):  # the same command is the same order
        boss.order("RM6", decision)
        await asyncio.sleep(0.5)
        assert manager.state.plan == plan
    boss.release("RM6", decision=3)
    await asyncio.sleep(0.1)
    assert boss.phases == ["idle", "acting", "done", "acting", "done", "idle"]


@pytest.mark.parametrize(("mission", "way", "dumb", "reason"), [
    (False, ((0.0, 0.0),), False, "refused: no mission is under way"),
    (True, (), False, "no route: no way"),
    (True, ((0.0, 0.0),), True, "not done within 2 s: no new route")])
@in_system(airport=load_airport("vallombre"))
async def test_a_replan_without_a_new_route_fails_with_the_reason(
        system, mission, way, dumb, reason):
    boss, planner, _ = await replanning(system, mission=mission)
    planner.way, planner.dumb = way, dumb
    boss.order("RM6")
    await asyncio.sleep(2.2)
    assert boss.phases == ["idle", "acting", "failed"]
    assert boss.reports[-1].message.reason == reason
