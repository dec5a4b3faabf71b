"""RM3 and RM4: requests to the supervisor, and when a node counts as back."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import pytest

from rampart.actors.bus.messages import Heartbeat
from rampart.actors.bus.topics import HEARTBEAT
from rampart.actors.ftm import messages as m
from rampart.actors.ftm import topics
from rampart.actors.recovery.respawn import Respawn, RespawnCore
from rampart.actors.recovery.respawn_group import RespawnGroup
from rampart.actors.runtime.run_context import RunContext
from rampart.manager.spec.specification import parse_specification
from rampart.testing import VirtualSystem, run
from tests import CELL
from tests.actors.osmosis.recovery.world import Boss, Node, Supervisor
from tests.osmosis_system import System
from tests.virtual_time import within


def core(*nodes: str) -> RespawnCore:
    return RespawnCore("RM", nodes or ("a",), first_request=100, start_s=0.0)


def request(number: int, node: str, failed: int) -> m.RespawnRequest:
    return m.RespawnRequest(number, node, failed, "RM")


def seen(core: RespawnCore, node: str = "a", incarnation: int = 1, now_s: float = 1.0) -> None:
    core.event(node, "started", incarnation, "", 0.0)
    core.beat(node, incarnation, now_s, now_s)


@pytest.mark.parametrize(("heard", "died", "at_s", "failed"), [
    (True, True, 1.06, 3),  # it is dead
    (True, False, 1.4, 3),  # its heartbeat is overdue
    (True, False, 1.05, 2),  # its heartbeat is recent: the incarnation before is named
    (False, False, 0.0, 0)])  # it is unknown
def test_a_node_is_asked_for_once_with_the_incarnation_that_failed(heard, died, at_s, failed):
    rm = core()
    if heard:
        seen(rm, incarnation=3)
    if died:
        rm.event("a", "crashed", 3, "", 1.05)
    assert rm.order(["a"], at_s, renewed=False)
    first = rm.take_requests()
    assert first == [request(100, "a", failed)]
    assert rm.pending == ("a",)
    assert not rm.order(["a"], at_s + 0.1, renewed=True)
    assert rm.take_requests() == []
    rm.retry(at_s + 0.3)
    assert rm.take_requests() == first, "it was not answered"
    rm.event("a", "respawned", 4, "", at_s + 0.4)
    rm.retry(at_s + 0.5)
    assert rm.take_requests() == []
    rm.release()
    assert (rm.take_requests(), rm.pending, rm.back, rm.problem) == ([], (), (), "")
    rm.event("a", "crashed", 5, "", at_s + 0.6)
    assert rm.take_requests() == []


FAST = parse_specification(CELL.read_text(encoding="utf-8").replace(
    "heartbeat_timeout_s = 0.3", "heartbeat_timeout_s = 0.18\nheartbeat_period_s = 0.06"), "fast")


@within(lambda: VirtualSystem(RunContext(system=FAST)))
async def test_in_a_fast_system_a_heartbeat_is_overdue_before_the_watchdog_reports_it(system):
    rm = system.start("RM", Respawn, nodes=["a"])
    asked = system.hear(topics.RESPAWN)
    await system.settle()
    system.say(HEARTBEAT, Heartbeat(1, 1, 0.06, 0, 0), "a", incarnation=3)
    await asyncio.sleep(0.18)
    Boss(system).order("RM", nodes=("a",))
    await system.settle()
    assert asked[-1].message.failed_incarnation == 3
    assert rm.activated


# what comes between the request for node a, whose life 3 died at 1 s, and the end
STORIES = {
    "respawned, then its heartbeat": (["respawned 4", "beat 4"], "back"),
    "its heartbeat, then the answer": (["beat 4", "respawned 4"], "back"),
    "the answer is lost": (["beat 4"], "back"),
    "a process is not enough": (["respawned 4", "adopted 4"], "pending"),
    "a heartbeat of the dead life": (["respawned 4", "beat 3"], "pending"),
    "a heartbeat that was under way": (["beat 3"], "pending"),
    "an answer about an old life that lives": (["respawned 3", "beat 3"], "pending"),
    "the supervisor refuses": (["refused"], "failed"),
    "the supervisor gives up": (["respawned 4", "crashed 4", "given up"], "failed"),
    "given up, and yet it comes": (["given up", "beat 4"], "back"),
    "events of no interest": (["running", "resumed"], "pending"),
}


@pytest.mark.parametrize(("events", "end"), STORIES.values(), ids=STORIES.keys())
def test_a_node_counts_as_back_when_its_new_life_is_heard(events, end):
    rm = core()
    seen(rm, incarnation=3)
    rm.event("a", "crashed", 3, "", 1.05)
    rm.order(["a"], 1.06, renewed=False)
    for step, text in enumerate(events):
        now_s = 1.1 + step / 10
        word, _, number = text.partition(" ")
        if word == "beat":
            rm.beat("a", int(number), now_s if number != "3" else 1.04, now_s)
        elif number.isdigit():
            rm.event("a", word, int(number), "", now_s)
        else:
            rm.event("a", text, 3, "", now_s)
    assert (rm.back == ("a",), rm.pending == ("a",), rm.problem != "") == (
        end == "back", end == "pending", end == "failed")


def test_a_heartbeat_sent_before_the_order_proves_nothing_one_sent_after_it_does():
    rm = core()
    seen(rm, incarnation=3)
    rm.order(["a"], 1.05, renewed=False)  # its death is not known here yet
    rm.beat("a", 3, 1.04, 1.06)
    assert rm.pending == ("a",)
    rm.beat("a", 3, 1.14, 1.15)  # it was continued just in time
    assert rm.back == ("a",)


@pytest.mark.parametrize("dies", [True, False])
def test_a_new_life_that_dies_or_is_not_heard_is_asked_for_again(dies):
    rm = core()
    rm.event("a", "crashed", 3, "", 1.0)
    rm.order(["a", "z"], 1.0, renewed=False)
    assert rm.problem.startswith("z: not among the nodes")
    rm.event("a", "respawned", 4, "", 1.1)
    assert [ask.node for ask in rm.take_requests()] == ["a"]
    if dies:
        rm.event("a", "crashed", 4, "", 1.2)
    else:
        rm.retry(2.0)
        assert rm.take_requests() == []
        rm.retry(2.1)
    assert rm.take_requests() == [request(101, "a", 4)]


def test_a_wedged_life_that_the_supervisor_takes_for_well_is_named_in_the_next_request():
    rm = core()
    rm.event("a", "adopted", 3, "", 0.0)  # no heartbeat yet
    rm.order(["a"], 0.01, renewed=False)
    assert rm.take_requests() == [request(100, "a", 2)]
    rm.event("a", "respawned", 3, "already", 0.02)
    rm.retry(1.1)
    assert rm.take_requests() == [request(101, "a", 3)]


def test_a_repeated_order_respawns_a_node_that_came_back_and_died_again_but_no_other():
    rm = core("a", "b")
    rm.event("a", "crashed", 1, "", 1.0)
    rm.event("b", "crashed", 1, "", 1.0)
    rm.order(["a", "b"], 1.0, renewed=False)
    for node in ("a", "b"):
        rm.beat(node, 2, 1.1, 1.1)
    rm.take_requests()
    assert not rm.order(["a", "b"], 1.15, renewed=True)
    rm.event("b", "crashed", 2, "", 1.2)
    assert rm.order(["a", "b"], 1.21, renewed=True)
    assert rm.take_requests() == [request(102, "b", 2)]


def test_what_was_given_up_is_tried_again_on_a_new_order_only():
    rm = core()
    rm.order(["a"], 0.0, renewed=False)
    rm.event("a", "given up", 1, "30 restarts in 60 s", 0.1)
    assert rm.problem == "a: given up, 30 restarts in 60 s"
    rm.take_requests()
    assert not rm.order(["a"], 0.2, renewed=False)
    assert rm.order(["a"], 0.3, renewed=True)
    assert rm.problem == ""


# -- a node and its dependents, respawned in order


CHAIN = ["camera", "finder", "planner"]


@asynccontextmanager
async def played(**parameters: Any) -> AsyncIterator[tuple[System, Supervisor, Boss]]:
    async with System() as system:
        for name in CHAIN:
            system.start(name, Node)
        supervisor, boss = system.start("supervisor", Supervisor), Boss(system)
        system.start("R", RespawnGroup, nodes=CHAIN, **parameters)
        await asyncio.sleep(0.5)
        yield system, supervisor, boss


def asked(supervisor: Supervisor) -> list[str]:
    """The nodes that were asked for, each once."""
    return list(dict.fromkeys(request.node for _, request in supervisor.requests))


@pytest.mark.parametrize(("named", "others", "restarted"), [
    (["camera"], "later", ["camera", "finder", "planner"]),
    (["finder"], "later", ["finder", "planner"]),
    (["planner"], "later", ["planner"]),
    (["planner", "finder"], "later", ["finder", "planner"]),
    (["planner"], "all", ["camera", "finder", "planner"]),
])
def test_those_that_depend_on_it_go_with_it_in_order(named, others, restarted):
    async def scenario() -> None:
        async with played(others=others) as (system, supervisor, boss):
            for _ in range(20):  # the manager repeats what it wants
                boss.order("R", nodes=tuple(f"{name}#1" for name in named))
                await asyncio.sleep(0.05)
            assert asked(supervisor) == restarted
            assert {name: system.incarnations[name] for name in CHAIN} == {
                name: 2 if name in restarted else 1 for name in CHAIN}
            assert boss.phases[-1] == "done"

    run(scenario)


@within(played)
async def test_one_that_does_not_come_back_fails_it_and_those_after_it_are_left_alone(given):
    system, supervisor, boss = given
    boss.order("R", nodes=("camera#1",))
    await asyncio.sleep(0.5 * supervisor.delay_s)
    supervisor.delay_s = 60.0  # from the next one on
    await asyncio.sleep(3.0)
    assert asked(supervisor) == ["camera", "finder"]
    assert boss.phases[-1] == "failed"
    assert system.incarnations["planner"] == 1
    assert "finder, planner" in boss.reports[-1].message.reason


@within(played)
async def test_a_new_order_restarts_them_again_and_a_release_ends_it(given):
    system, _, boss = given
    for decision in (1, 2):
        boss.order("R", decision, (f"finder#{decision}",))
        await asyncio.sleep(1.0)
        assert (boss.phases[-1], system.incarnations["planner"]) == ("done", decision + 1)
    boss.release("R", 3)
    await asyncio.sleep(0.5)
    assert boss.phases[-1] == "idle"
    assert system.incarnations == {**system.incarnations, "camera": 1, "finder": 3}


@within(played)
async def test_a_node_of_another_group_is_refused(given):
    _, supervisor, boss = given
    boss.order("R", nodes=("gripper",))
    await asyncio.sleep(0.3)
    assert supervisor.requests == []
    assert "gripper: not among the nodes" in boss.reports[-1].message.reason
