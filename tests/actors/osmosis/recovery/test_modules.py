"""RM1 to RM5 as actors: obedience, reports, and what they do to base, pilot and supervisor."""

from __future__ import annotations

import asyncio

import pytest

from rampart.actors.bus.run_folder import EPOCH
from rampart.actors.ftm import messages as fm
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.messages import PilotMode
from rampart.actors.osmosis.recovery.controlled_stop import ControlledStop
from rampart.actors.osmosis.recovery.emergency_stop import EmergencyStop
from rampart.actors.osmosis.recovery.switch_teleoperation import SwitchTeleoperation
from rampart.actors.recovery.module import TRANSITIONS, IllegalTransitionError, RecoveryModule
from rampart.actors.recovery.respawn import Respawn
from rampart.actors.runtime.parameters import read_parameters
from rampart.actors.system.members import Member, heard
from rampart.testing import run
from tests.actors.osmosis.recovery.world import Base, Boss, Node, Pilot, Supervisor, hang
from tests.osmosis_system import System

P = fm.RecoveryPhase


def test_there_is_no_way_to_cut_an_action_off():
    assert P.IDLE not in TRANSITIONS[P.ACTING]
    assert all(P.IDLE in TRANSITIONS[end] for end in (P.DONE, P.DEGRADED, P.FAILED))
    assert TRANSITIONS.keys() == set(P)


def test_an_illegal_transition_names_both_states():
    async def scenario() -> None:
        async with System() as system:
            rm = system.start("RM9", RecoveryModule)
            error = "RM9: no transition from idle to degraded"
            with pytest.raises(IllegalTransitionError, match=error):
                rm.degrade()

    run(scenario)


# ---- RM1 ---------------------------------------------------------------------------------------


def test_the_brake_is_engaged_before_any_time_passes_and_stays_so():
    async def scenario() -> None:
        async with System() as system:
            boss, base = system.start("boss", Boss), system.start("base", Base)
            system.start("RM1", EmergencyStop)
            await system.settle()
            boss.order("RM1")
            await system.settle()
            assert base.engaged
            assert boss.phases == ["idle", "acting"]
            await asyncio.sleep(1.0)
            assert boss.phases == ["idle", "acting", "degraded"]
            assert base.orders.count(True) == pytest.approx(6, abs=1)
            boss.release("RM1")
            await asyncio.sleep(3.0)
            assert not base.engaged
            assert boss.phases == ["idle", "acting", "degraded", "idle"]
            assert base.orders.count(False) == 6

    run(scenario)


def test_a_brake_that_does_not_engage_is_a_failure_at_the_deadline_and_is_tried_further():
    async def scenario() -> None:
        async with System() as system:
            boss, base = system.start("boss", Boss), system.start("base", Base)
            system.start("RM1", EmergencyStop)
            base.deaf = True
            await system.settle()
            boss.order("RM1")
            await asyncio.sleep(1.9)
            assert boss.phases == ["idle", "acting"]
            await asyncio.sleep(0.2)
            assert boss.reports[-1][1].reason == "not done within 2 s"
            base.deaf = False
            await asyncio.sleep(0.4)
            assert boss.phases == ["idle", "acting", "failed", "degraded"]

    run(scenario)


def test_a_release_while_acting_is_obeyed_when_the_brake_is_engaged():
    async def scenario() -> None:
        async with System() as system:
            boss, base = system.start("boss", Boss), system.start("base", Base)
            system.start("RM1", EmergencyStop)
            await system.settle()
            base.deaf = True
            boss.order("RM1")
            await system.settle()
            boss.release("RM1", decision=7)
            await asyncio.sleep(0.5)
            assert boss.phases == ["idle", "acting"]
            assert True in base.orders
            assert False not in base.orders
            base.deaf = False
            await asyncio.sleep(0.5)
            assert boss.phases[-1] == "idle"
            assert boss.reports[-1][1].decision == 7
            assert not base.engaged

    run(scenario)


def test_an_order_while_a_release_waits_cancels_the_release():
    async def scenario() -> None:
        async with System() as system:
            boss, base = system.start("boss", Boss), system.start("base", Base)
            system.start("RM1", EmergencyStop)
            await system.settle()
            base.deaf = True
            boss.order("RM1", decision=1)
            await system.settle()
            boss.release("RM1", decision=2)
            await system.settle()
            boss.order("RM1", decision=3)
            await system.settle()
            base.deaf = False
            await asyncio.sleep(1.0)
            assert boss.phases == ["idle", "acting", "degraded"]
            assert base.engaged
            assert boss.reports[-1][1].decision == 3

    run(scenario)


def test_a_status_from_before_the_order_confirms_nothing():
    async def scenario() -> None:
        async with System() as system:
            boss, base = system.start("boss", Boss), system.start("base", Base)
            system.start("RM1", EmergencyStop)
            base.deaf = True
            await asyncio.sleep(0.55)
            boss.order("RM1")
            await system.settle()
            status = m.BaseStatus(True, False, 0.0, (0.0,) * 4)
            base.publish(topics.BASE_STATUS, status, stamp=0.5)
            await system.settle()
            assert boss.phases == ["idle", "acting"]
            base.publish(topics.BASE_STATUS, status, stamp=0.55)
            await system.settle()
            assert boss.phases == ["idle", "acting", "degraded"]

    run(scenario)


def test_a_base_that_is_respawned_gets_the_brake_engaged_again():
    async def scenario() -> None:
        async with System() as system:
            boss, base = system.start("boss", Boss), system.start("base", Base)
            system.start("RM1", EmergencyStop)
            await system.settle()
            boss.order("RM1")
            await asyncio.sleep(0.5)
            base.holders.clear()  # it has forgotten
            await asyncio.sleep(0.35)
            assert base.engaged
            assert boss.phases == ["idle", "acting", "degraded"]

    run(scenario)


def test_a_respawned_emergency_stop_that_finds_the_brake_engaged_says_activated_first():
    async def scenario() -> None:
        async with System() as system:
            boss, base = system.start("boss", Boss), system.start("base", Base)
            system.start("RM1", EmergencyStop)
            await system.settle()
            boss.order("RM1")
            await asyncio.sleep(0.5)
            await system.kill("RM1")
            boss.reports.clear()
            system.start("RM1", EmergencyStop)
            await asyncio.sleep(1.0)
            assert "idle" not in boss.phases
            assert boss.phases[-1] == "degraded"
            assert base.engaged
            boss.release("RM1")
            await asyncio.sleep(0.3)
            assert not base.engaged

    run(scenario)


def test_a_respawned_emergency_stop_that_finds_the_brake_released_is_idle():
    async def scenario() -> None:
        async with System() as system:
            boss, base = system.start("boss", Boss), system.start("base", Base)
            system.start("RM1", EmergencyStop)
            await asyncio.sleep(0.5)
            await system.kill("RM1")
            boss.reports.clear()
            system.start("RM1", EmergencyStop)
            await asyncio.sleep(1.0)
            assert boss.phases == ["idle"]
            assert base.orders == []

    run(scenario)


# ---- RM2, RM5 ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("cls", "mode"), [
    (ControlledStop, PilotMode.STOP), (SwitchTeleoperation, PilotMode.TELEOPERATION)])
def test_the_pilot_is_ordered_until_released(cls, mode):
    async def scenario() -> None:
        async with System() as system:
            boss, pilot = system.start("boss", Boss), system.start("pilot", Pilot)
            system.start("RM", cls)
            await asyncio.sleep(1.0)
            assert pilot.heard == 0
            boss.order("RM", reason="DM2: command not updated")
            await system.settle()
            assert pilot.mode is mode
            assert pilot.orders["RM"].reason == "DM2: command not updated"
            assert boss.phases == ["idle", "acting", "degraded"]
            await asyncio.sleep(1.0)
            assert pilot.heard == pytest.approx(6, abs=1)
            boss.release("RM")
            await system.settle()
            assert pilot.mode is PilotMode.AUTO
            await asyncio.sleep(3.0)
            assert boss.phases == ["idle", "acting", "degraded", "idle"]
            assert pilot.heard == pytest.approx(12, abs=1)

    run(scenario)


def test_the_same_decision_again_is_one_and_a_new_one_is_acknowledged():
    async def scenario() -> None:
        async with System() as system:
            boss, pilot = system.start("boss", Boss), system.start("pilot", Pilot)
            system.start("RM2", ControlledStop)
            await system.settle()
            for _ in range(5):
                boss.order("RM2", decision=1)
                await system.settle()
            assert boss.phases == ["idle", "acting", "degraded"]
            assert pilot.heard == 1
            boss.order("RM2", decision=2)
            await system.settle()
            assert boss.reports[-1][1] == fm.RecoveryReport(
                fm.RecoveryState.ACTIVATED, P.DEGRADED, 2, "safety pilot in mode stop")

    run(scenario)


def test_a_stop_fulfils_the_order_to_switch_to_teleoperation_but_not_the_other_way_round():
    async def scenario() -> None:
        async with System() as system:
            boss = system.start("boss", Boss)
            system.start("pilot", Pilot)
            rm2 = system.start("RM2", ControlledStop)
            rm5 = system.start("RM5", SwitchTeleoperation)
            await system.settle()
            rm5_only = {"RM5": P.DEGRADED, "RM2": P.IDLE}
            boss.order("RM5")
            await system.settle()
            assert {"RM5": rm5.phase, "RM2": rm2.phase} == rm5_only
            boss.order("RM2")
            await asyncio.sleep(0.5)
            assert rm5.phase is P.DEGRADED
            assert rm2.phase is P.DEGRADED

    run(scenario)


def test_a_pilot_that_does_not_obey_is_a_failure_and_one_that_comes_round_is_not():
    async def scenario() -> None:
        async with System() as system:
            boss, pilot = system.start("boss", Boss), system.start("pilot", Pilot)
            system.start("RM2", ControlledStop)
            pilot.deaf = True
            await system.settle()
            boss.order("RM2")
            await asyncio.sleep(2.1)
            assert boss.phases == ["idle", "acting", "failed"]
            boss.order("RM2", decision=2)
            await system.settle()
            assert boss.phases == ["idle", "acting", "failed", "acting"]
            pilot.deaf = False
            await asyncio.sleep(0.3)
            assert boss.phases[-1] == "degraded"
            pilot.orders.clear()
            pilot.deaf = True  # respawned, and never listens again
            await asyncio.sleep(1.9)
            assert boss.phases[-1] == "degraded"
            await asyncio.sleep(0.8)
            assert boss.phases[-1] == "failed"

    run(scenario)


def test_a_respawned_module_ends_the_order_its_earlier_life_left_only_when_told():
    async def scenario() -> None:
        async with System() as system:
            boss, pilot = system.start("boss", Boss), system.start("pilot", Pilot)
            system.start("RM2", ControlledStop)
            await system.settle()
            boss.order("RM2")
            await system.settle()
            await system.kill("RM2")
            system.start("RM2", ControlledStop)
            await asyncio.sleep(1.0)
            assert pilot.mode is PilotMode.STOP
            boss.release("RM2")
            await system.settle()
            assert pilot.mode is PilotMode.AUTO

    run(scenario)


def test_a_module_that_was_itself_stopped_reads_its_mail_before_it_reports_failure():
    async def scenario() -> None:
        async with System() as system:
            boss, base = system.start("boss", Boss), system.start("base", Base)
            system.start("RM1", EmergencyStop)
            await system.settle()
            base.deaf = True
            boss.order("RM1")
            await system.settle()
            base.holders.add("somebody")
            asyncio.get_running_loop().jump(5.0)  # type: ignore[attr-defined]
            await asyncio.sleep(0.5)
            assert boss.phases == ["idle", "acting", "degraded"]

    run(scenario)


# ---- RM3, RM4 ----------------------------------------------------------------------------------


async def respawning(system: System) -> tuple[Boss, Supervisor]:
    boss, supervisor = system.start("boss", Boss), system.start("supervisor", Supervisor)
    for name in ("a", "b"):
        system.start(name, Node)
    system.start("RM3", Respawn, nodes=["a", "b"])
    await asyncio.sleep(0.5)
    return boss, supervisor


def test_a_module_that_was_taken_over_many_thousand_times_still_respawns():
    async def scenario() -> None:
        async with System() as system:
            system.incarnations["RM3"] = 20_000 * EPOCH
            boss, supervisor = await respawning(system)
            await system.kill("a")
            boss.order("RM3", nodes=("a",))
            await asyncio.sleep(0.1)
            assert [r.node for _, r in supervisor.requests] == ["a"]
            assert boss.phases == ["idle", "acting", "done"]

    run(scenario)


def test_a_dead_node_is_asked_for_at_once_and_done_when_it_is_heard():
    async def scenario() -> None:
        async with System() as system:
            boss, supervisor = await respawning(system)
            await system.kill("a")
            boss.order("RM3", nodes=("a",))
            await system.settle()
            assert [(r.node, r.failed_incarnation, r.by) for _, r in supervisor.requests] == [
                ("a", 1, "RM3")]
            assert boss.phases == ["idle", "acting"]
            await asyncio.sleep(0.1)
            assert boss.phases == ["idle", "acting", "done"]
            assert boss.reports[-1][1].reason == "a back"
            assert system.incarnations["a"] == 2

    run(scenario)


def test_a_hanging_node_is_killed_and_respawned():
    async def scenario() -> None:
        async with System() as system:
            boss, _ = await respawning(system)
            await system.kill("a")
            hanging = system.start("a", Node)
            await asyncio.sleep(0.2)
            hang(hanging)
            await asyncio.sleep(0.4)
            boss.order("RM3", nodes=("a",))
            await asyncio.sleep(0.2)
            assert boss.phases == ["idle", "acting", "done"]
            assert system.incarnations["a"] == 3

    run(scenario)


def test_a_second_node_that_fails_while_the_first_is_on_its_way_is_respawned_too():
    async def scenario() -> None:
        async with System() as system:
            boss, supervisor = await respawning(system)
            supervisor.delay_s = 0.3
            await system.kill("a")
            boss.order("RM3", nodes=("a",))
            await asyncio.sleep(0.1)
            await system.kill("b")
            boss.order("RM3", nodes=("a", "b"))
            await asyncio.sleep(0.25)
            assert boss.phases == ["idle", "acting"]
            await asyncio.sleep(0.3)
            assert boss.phases == ["idle", "acting", "done"]
            assert boss.reports[-1][1].reason == "a, b back"
            assert [r.node for _, r in supervisor.requests if r.failed_incarnation == 1].count(
                "b") >= 1

    run(scenario)


def test_further_orders_respawn_what_failed_since_and_leave_alone_who_is_well():
    async def scenario() -> None:
        async with System() as system:
            boss, _ = await respawning(system)
            await system.kill("a")
            boss.order("RM3", decision=1, nodes=("a",))
            await asyncio.sleep(0.2)
            await system.kill("b")
            boss.order("RM3", decision=2, nodes=("a", "b"))
            await asyncio.sleep(0.2)
            assert boss.phases == ["idle", "acting", "done", "acting", "done"]
            assert (system.incarnations["a"], system.incarnations["b"]) == (2, 2)

    run(scenario)


def test_an_order_that_names_nobody_is_done_at_once():
    async def scenario() -> None:
        async with System() as system:
            boss, supervisor = await respawning(system)
            boss.order("RM3")
            await system.settle()
            assert boss.phases == ["idle", "done"]
            assert supervisor.requests == []

    run(scenario)


@pytest.mark.parametrize(("answer", "reason"), [
    ("refused", "a: refused"), ("given up", "a: given up")])
def test_what_the_supervisor_will_not_do_is_a_failure(answer, reason):
    async def scenario() -> None:
        async with System() as system:
            boss, supervisor = await respawning(system)
            supervisor.answer = answer
            await system.kill("a")
            boss.order("RM3", nodes=("a",))
            await system.settle()
            assert boss.phases == ["idle", "acting", "failed"]
            assert boss.reports[-1][1].reason == reason

    run(scenario)


def test_a_supervisor_that_is_away_is_asked_until_the_deadline():
    async def scenario() -> None:
        async with System() as system:
            boss, supervisor = await respawning(system)
            supervisor.answer = "nothing"
            await system.kill("a")
            boss.order("RM3", nodes=("a",))
            await asyncio.sleep(1.9)
            assert len({r.request for _, r in supervisor.requests}) == 1
            assert len(supervisor.requests) == pytest.approx(10, abs=1)
            await asyncio.sleep(0.2)
            assert boss.reports[-1][1].reason == "not done within 2 s: a"
            supervisor.answer = "respawned"
            await asyncio.sleep(0.5)
            assert boss.phases == ["idle", "acting", "failed", "done"]

    run(scenario)


def test_a_release_while_acting_is_obeyed_when_the_node_is_back():
    async def scenario() -> None:
        async with System() as system:
            boss, _ = await respawning(system)
            await system.kill("a")
            boss.order("RM3", nodes=("a",))
            await system.settle()
            boss.release("RM3")
            await system.settle()
            assert boss.phases == ["idle", "acting"]
            await asyncio.sleep(0.2)
            assert boss.phases[-1] == "idle"
            assert system.incarnations["a"] == 2

    run(scenario)


def test_a_respawned_module_that_is_commanded_again_does_not_kill_who_is_well():
    async def scenario() -> None:
        async with System() as system:
            boss, supervisor = await respawning(system)
            await system.kill("a")
            boss.order("RM3", nodes=("a",))
            await asyncio.sleep(0.3)
            await system.kill("RM3")
            await system.settle()
            boss.reports.clear()
            system.start("RM3", Respawn, nodes=["a", "b"])
            await system.settle()
            boss.order("RM3", nodes=("a",))
            await asyncio.sleep(0.3)
            assert boss.phases == ["idle", "acting", "done"]
            assert system.incarnations["a"] == 2
            assert len({r.request for _, r in supervisor.requests}) == 2

    run(scenario)


def test_it_hears_the_heartbeats_of_its_nodes_and_its_own_commands_only():
    member = Member("RM3", Respawn, Respawn.Parameters(nodes=("a", "b")))
    assert heard(member) == {
        "recovery/{name}/command": ("RM3",), "heartbeat/{name}": ("a", "b"),
        "supervisor/event": None}


@pytest.mark.parametrize("nodes", ["a", [], [1], [""]])
def test_a_list_of_nodes_that_is_none_is_refused_by_name(nodes):
    with pytest.raises(ValueError, match=r"RM3: x\.nodes.* = .*: expected a "):
        read_parameters(Respawn.Parameters, {"nodes": nodes}, "RM3", "x")
