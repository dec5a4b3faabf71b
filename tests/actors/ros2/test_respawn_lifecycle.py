"""`RespawnLifecycle`: a lifecycle node is back when it is active, not when its process is."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.messages import Heartbeat, Message
from rampart.actors.bus.topic import Qos, Topic
from rampart.actors.ftm import messages as m
from rampart.actors.ftm import topics
from rampart.actors.ros2.respawn_lifecycle import RespawnLifecycle
from rampart.actors.runtime.parameters import read_parameters
from rampart.testing import VirtualSystem
from tests.virtual_time import within


class Ask(Message, frozen=True):
    """A request without fields."""


class Transition(Message, frozen=True):
    """Of lifecycle_msgs."""

    id: int
    label: str


class Change(Message, frozen=True):
    """A request of a transition."""

    transition: Transition


class State(Message, frozen=True):
    """An answer; None if there is none."""

    id: int | None = None


ASK = Topic("planner/ask", Ask, Qos.COMMAND, 0, "", "GetState.")
STATE = Topic("planner/state", State, Qos.COMMAND, 0, "", "Its answer.")
CHANGE = Topic("planner/change", Change, Qos.COMMAND, 0, "", "ChangeState.")
GIVEN = {"nodes": ["planner", "guard"], "lifecycle": ["planner"], "ask": ["planner/ask"],
         "state": ["planner/state:id"], "change": ["planner/change"],
         "appear_s": 0.5, "configure_s": 0.6, "activate_s": 0.7}
ACTIVE, FINALIZED = 3, 4


class Case:
    """The recovery, a manager that commands it, a supervisor, and a lifecycle node `planner`."""

    def __init__(self, system: VirtualSystem) -> None:
        self.system = system
        self.state: int | None = ACTIVE
        self.next = {(1, 1): 2, (2, 3): ACTIVE}
        self.changes: list[int] = []
        self.answers = True
        self.requests = system.hear(topics.RESPAWN)
        self.reports = system.hear(topics.RECOVERY)
        self.asks, self.orders = system.hear(ASK), system.hear(CHANGE)
        self.seen = 0, 0
        system.start("R", RespawnLifecycle, **GIVEN)

    async def play(self, for_s: float) -> None:
        for _ in range(round(for_s / 0.01)):
            await asyncio.sleep(0.01)
            for heard in self.orders[self.seen[1]:]:
                self.changes.append(heard.message.transition.id)
                self.state = self.next.get((self.state, self.changes[-1]), self.state)
            if len(self.asks) > self.seen[0] and self.answers:
                self.system.say(STATE, State(self.state), "gateway")
            self.seen = len(self.asks), len(self.orders)

    def command(self, decision: int, *nodes: str) -> None:
        self.system.say(topics.RECOVERY_COMMAND, m.RecoveryCommand(
            True, decision, nodes, "why"), "manager", member="R")

    async def die_and_come_back(self, node: str, incarnation: int, state: int | None) -> None:
        self.say_event(node, "crashed", incarnation)
        self.command(incarnation, node)
        await self.system.settle()
        assert self.requests[-1].message.node == node
        self.state = state
        self.say_event(node, "respawned", incarnation + 1)
        await asyncio.sleep(0.01)
        self.system.say(bus_topics.HEARTBEAT, Heartbeat(1, 0, 0.1, 0, 0), node,
                        incarnation=incarnation + 1, member=node)
        await self.system.settle()

    def say_event(self, node: str, event: str, incarnation: int) -> None:
        self.system.say(topics.PROCESS_EVENT, m.ProcessEvent(
            node, event, 1, incarnation, "R", ""), "supervisor")

    @property
    def report(self) -> m.RecoveryReport:
        return self.reports[-1].message


@asynccontextmanager
async def played() -> AsyncIterator[Case]:
    async with VirtualSystem(topics=(ASK, STATE, CHANGE)) as system:
        case = Case(system)
        await asyncio.sleep(0.05)
        yield case


@within(played)
async def test_a_respawned_node_is_configured_and_activated_and_only_then_the_module_is_done(case):
    await case.die_and_come_back("planner", 1, state=1)
    assert case.report.phase.value == "acting"
    await case.play(1.0)
    assert case.changes == [1, 3]
    assert case.report.phase.value == "done"
    await case.die_and_come_back("planner", 2, state=1)  # once more
    assert case.report.phase.value == "acting"
    await case.play(1.0)
    assert case.changes == [1, 3, 1, 3]
    assert case.report.phase.value == "done"


@within(played)
async def test_a_node_that_activates_itself_or_has_no_life_cycle_is_accepted(case):
    await case.die_and_come_back("guard", 1, state=None)
    assert (case.report.phase.value, case.asks) == ("done", [])
    await case.die_and_come_back("planner", 1, state=ACTIVE)
    await case.play(0.5)
    assert (case.changes, case.report.phase.value) == ([], "done")


@pytest.mark.parametrize(("state", "next_states", "answers", "words"), [
    (1, {}, False, "planner: no step appear within 0.5 s"),
    (None, {}, True, "planner: no step appear within 0.5 s"),  # the service does not answer
    (1, {}, True, "planner: no step configure within 0.6 s"),
    (1, {(1, 1): 2}, True, "planner: no step activate within 0.7 s"),
    (1, {(1, 1): FINALIZED}, True, "planner: finalized")])
@within(played)
async def test_the_step_that_fails_is_named(case, state, next_states, answers, words):
    case.next, case.answers = next_states, answers
    await case.die_and_come_back("planner", 1, state)
    await case.play(1.8)
    assert (case.report.phase.value, case.report.reason) == ("failed", words)
    if answers and state:  # what was refused has been requested again, until it was too late
        case.next = {(1, 1): 2, (2, 3): ACTIVE, (FINALIZED, 1): 2}
        await case.die_and_come_back("planner", 2, state=1)
        await case.play(1.0)
        assert case.report.phase.value == "done"


@within(played)
async def test_a_node_that_dies_while_it_is_configured_is_respawned_again(case):
    case.next = {}
    await case.die_and_come_back("planner", 1, state=1)
    await case.play(0.3)
    case.say_event("planner", "crashed", 2)
    case.command(1, "planner")  # the manager repeats its command
    await case.system.settle()
    assert case.requests[-1].message.failed_incarnation == 2


@pytest.mark.parametrize(("change", "words"), [
    ({"lifecycle": ["other"]}, "lifecycle.*other: not among nodes"),
    ({"ask": []}, "ask.*expected 1 entries"),
    ({"state": ["a:b", "c:d"]}, "state.*expected 1 entries"),
    ({"change": ["a", "b"]}, "change.*expected 1 entries")])
def test_a_node_without_its_topics_is_refused(change, words):
    with pytest.raises(ValueError, match=words):
        read_parameters(RespawnLifecycle.Parameters, {**GIVEN, **change}, "x.toml", "R")
