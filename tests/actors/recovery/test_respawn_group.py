"""A node and its dependents, respawned in order."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from typing import Any

import pytest

from rampart.actors.ftm import messages as m
from rampart.actors.ftm import topics
from rampart.actors.recovery.respawn_group import RespawnGroup
from rampart.actors.runtime.actor import Actor, Context, Header, on
from rampart.testing import VirtualSystem, run
from tests.virtual_time import within

CHAIN = ["camera", "finder", "planner"]


class Node(Actor):
    """A node that does nothing but beat."""


class FakeSupervisor(Actor):
    """Respawns a requested node, if the running incarnation is the failed one."""

    outputs = (topics.PROCESS_EVENT,)

    def __init__(self, context: Context, system: VirtualSystem, broken: set[str]) -> None:
        super().__init__(context)
        self.system, self.broken = system, broken
        self.done: list[tuple[str, int]] = []
        self.asked: list[str] = []

    @on(topics.RESPAWN)
    def respawn(self, request: m.RespawnRequest, _header: Header) -> None:
        """Do it, 100 ms later."""
        node, now = request.node, self.system.incarnations[request.node]
        self.asked.append(node)
        if request.failed_incarnation < now or (node, now) in self.done:
            return
        self.done.append((node, now))
        self.system.tasks[node].cancel()
        del self.system.tasks[node]
        if node not in self.broken:
            self.call_later(0.1, lambda: self._start(node))

    def _start(self, node: str) -> None:
        self.system.start(node, Node)
        self.publish(topics.PROCESS_EVENT, m.ProcessEvent(
            node, "respawned", 1, self.system.incarnations[node], "R", ""))


@asynccontextmanager
async def played(broken: set[str] = frozenset(), **parameters: Any) -> AsyncIterator[Any]:
    async with VirtualSystem() as system:
        for name in CHAIN:
            system.start(name, Node)
        supervisor = system.start("supervisor", FakeSupervisor, system, broken)
        reports = system.hear(topics.RECOVERY)
        system.start("R", RespawnGroup, nodes=CHAIN, **parameters)
        await asyncio.sleep(0.5)

        def command(decision: int, *nodes: str, activate: bool = True) -> None:
            system.say(topics.RECOVERY_COMMAND, m.RecoveryCommand(
                activate, decision, nodes, "why"), "manager", member="R")

        yield system, supervisor, command, reports


def phase(reports: Any) -> str:
    return reports[-1].message.phase.value


@pytest.mark.parametrize(("named", "others", "restarted"), [
    (["camera"], "later", ["camera", "finder", "planner"]),
    (["finder"], "later", ["finder", "planner"]),
    (["planner"], "later", ["planner"]),
    (["planner", "finder"], "later", ["finder", "planner"]),
    (["planner"], "all", ["camera", "finder", "planner"]),
])
def test_those_that_depend_on_it_go_with_it_in_order(named, others, restarted):
    async def scenario() -> None:
        async with played(others=others) as (system, supervisor, command, reports):
            for _ in range(20):  # the manager repeats what it wants
                command(1, *(f"{name}#1" for name in named))
                await asyncio.sleep(0.05)
            assert [node for node, _ in supervisor.done] == restarted
            assert {name: system.incarnations[name] for name in CHAIN} == {
                name: 2 if name in restarted else 1 for name in CHAIN}
            assert list(dict.fromkeys(supervisor.asked)) == restarted
            assert phase(reports) == "done"

    run(scenario)


@within(partial(played, broken={"finder"}))
async def test_one_that_does_not_come_back_fails_it_and_those_after_it_are_left_alone(given):
    system, supervisor, command, reports = given
    command(1, "camera#1")
    await asyncio.sleep(3.0)
    assert [node for node, _ in supervisor.done] == ["camera", "finder"]
    assert phase(reports) == "failed"
    assert system.incarnations["planner"] == 1
    assert "finder, planner" in reports[-1].message.reason


@within(played)
async def test_a_new_order_restarts_them_again_and_a_release_ends_it(given):
    system, _, command, reports = given
    command(1, "finder#1")
    await asyncio.sleep(1.0)
    assert phase(reports) == "done"
    command(2, "finder#2")
    await asyncio.sleep(1.0)
    assert (phase(reports), system.incarnations["planner"]) == ("done", 3)
    command(3, activate=False)
    await asyncio.sleep(0.5)
    assert phase(reports) == "idle"
    assert system.incarnations == {**system.incarnations, "camera": 1, "finder": 3}


@within(played)
async def test_a_node_of_another_group_is_refused(given):
    _, supervisor, command, reports = given
    command(1, "gripper")
    await asyncio.sleep(0.3)
    assert supervisor.done == []
    assert "gripper: not among the nodes" in reports[-1].message.reason
