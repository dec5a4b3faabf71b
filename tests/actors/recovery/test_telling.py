"""Recovery modules that a specification alone makes: `Hold` and `Call`."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from typing import Any

import pytest

from rampart.actors.recovery.telling import Call, Hold
from rampart.actors.runtime.actor import Actor, Header, on
from rampart.actors.runtime.parameters import read_parameters
from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.system.layout import Layout
from rampart.manager.spec.specification import parse_specification
from rampart.testing import VirtualSystem
from tests import TANK
from tests.actors.osmosis.recovery.world import Boss
from tests.tank import LEVEL, ORDER, TOPICS, VALVE, Valve
from tests.virtual_time import within

SHUT = {"topic": "tank/order", "message": {"shut": True, "opening": 0}}


class Case(Boss):
    """A recovery module and its messages, with a manager that commands it."""

    def __init__(self, system: VirtualSystem, kind: type, **parameters: Any) -> None:
        super().__init__(system)
        self.start = partial(system.start, "R", kind, **parameters)
        self.said = system.hear(ORDER)
        self.start()

    def command(self, decision: int, activate: bool = True) -> None:
        (self.order if activate else self.release)("R", decision)

    @property
    def orders(self) -> list[Valve]:
        return [heard.message for heard in self.said]


@asynccontextmanager
async def played(kind: type, **parameters: Any) -> AsyncIterator[tuple[VirtualSystem, Case]]:
    async with VirtualSystem(topics=TOPICS) as system:
        case = Case(system, kind, **parameters)
        await asyncio.sleep(0.05)
        yield system, case


@within(partial(played, Hold, **SHUT, repeat_s=0.2, back={"shut": False}))
async def test_a_message_is_held_for_as_long_as_the_recovery_is_in_force(given):
    system, case = given
    case.command(1)
    await system.settle()
    assert case.orders == [Valve(True, 0.0)], "before any time has passed"
    assert case.phases[-1] == "degraded"
    await asyncio.sleep(1.05)
    assert case.orders == [Valve(True, 0.0)] * 6
    case.command(1)  # the same again is one command
    await asyncio.sleep(0.4)
    assert len(case.orders) == 8
    case.command(2, activate=False)
    await asyncio.sleep(5.0)
    assert case.orders[8:] == [Valve(False)] * 6, "the end is repeated for a second"
    assert case.phases[-1] == "idle"


@pytest.mark.parametrize("idle_s", [0.0, 0.41])
@within(partial(played, Hold, **SHUT, repeat_s=0.1, back={"shut": False},
                confirm="tank/valve:shut", equals=True))
async def test_what_is_confirmed_is_repeated_nevertheless_however_long_it_was_idle(given, idle_s):
    system, case = given
    await asyncio.sleep(idle_s)
    case.command(1)
    await system.settle()
    system.say(VALVE, Valve(True))
    await system.settle()
    assert case.phases[-1] == "degraded"
    before = len(case.orders)
    for _ in range(25):
        await asyncio.sleep(0.2)
        case.command(1)  # the manager repeats it
    assert len(case.orders) - before == pytest.approx(50, abs=1)


@within(partial(played, Hold, **SHUT, repeat_s=0.1, back={"shut": False}))
async def test_it_is_not_repeated_more_often_for_being_given_and_released_again_and_again(given):
    _, case = given
    for decision in range(1, 18):
        case.command(decision, activate=decision % 2 == 1)
        await asyncio.sleep(0.02)
    before = len(case.orders)
    await asyncio.sleep(1.0)
    assert len(case.orders) - before == pytest.approx(10, abs=1)


CONFIRMED = {**SHUT, "confirm": "tank/valve:shut", "equals": True}


@within(partial(played, Hold, **CONFIRMED, back={"shut": False}))
async def test_a_mode_is_reached_when_the_node_says_so_and_lost_when_it_no_longer_does(given):
    system, case = given
    system.say(VALVE, Valve(True))  # before the order: does not count
    case.command(1)
    await asyncio.sleep(0.1)
    assert case.phases[-1] == "acting"
    system.say(VALVE, Valve(True))
    await system.settle()
    assert case.phases[-1] == "degraded"
    for _ in range(30):
        system.say(VALVE, Valve(False))
        await asyncio.sleep(0.1)
    assert case.phases[-1] == "failed"
    assert "tank/valve:shut is False" in case.reports[-1].message.reason
    case.command(2, activate=False)
    await system.settle()
    assert case.orders[-1] == Valve(False)


@within(partial(played, Hold, **CONFIRMED))
async def test_what_is_never_confirmed_fails_at_its_deadline_and_without_an_end_nothing_is_said(
        given):
    _, case = given
    case.command(1)
    await asyncio.sleep(2.1)
    assert case.phases[-1] == "failed"
    case.said.clear()
    case.command(2, activate=False)
    await asyncio.sleep(2.0)
    assert case.orders == []


@within(partial(played, Hold, **SHUT, back={"shut": False}))
async def test_a_respawned_hold_takes_back_what_its_predecessor_left(given):
    system, case = given
    case.command(1)
    await asyncio.sleep(0.1)
    await system.kill("R")
    case.start()
    await asyncio.sleep(0.1)
    case.said.clear()
    case.command(2, activate=False)
    await system.settle()
    assert case.orders[-1] == Valve(False)
    await asyncio.sleep(1.0)
    assert case.orders[-1] == Valve(False)


ANSWER = {"answer": "tank/valve:shut", "equals": True}
ONE = {"topic": "tank/order", "messages": [{"shut": True}], **ANSWER}


@within(partial(played, Call, **ONE))
async def test_a_call_is_repeated_until_it_is_answered_and_then_never_again(given):
    system, case = given
    system.say(VALVE, Valve(True))  # before the command: no answer to it
    case.command(1)
    await asyncio.sleep(1.1)
    assert (len(case.orders), case.phases[-1]) == (3, "acting")
    system.say(VALVE, Valve(False))
    await system.settle()
    assert case.phases[-1] == "acting"
    system.say(VALVE, Valve(True))
    await system.settle()
    assert case.phases[-1] == "done"
    case.command(1)
    await asyncio.sleep(2.0)
    assert len(case.orders) == 3
    case.command(2)  # the cause has come back: a new order
    await system.settle()
    assert (len(case.orders), case.phases[-1]) == (4, "acting")


STEPS = {"topic": "tank/order", "messages": [{"shut": True}, {"shut": False}, {"shut": True}],
         **ANSWER}


@within(partial(played, Call, **STEPS))
async def test_each_call_waits_for_the_answer_of_the_one_before(given):
    system, case = given
    case.command(1)
    await system.settle()
    for count in (1, 2, 3):
        assert (len(case.orders), case.phases[-1]) == (count, "acting")
        await asyncio.sleep(0.1)
        system.say(VALVE, Valve(True))
        await system.settle()
    assert [order.shut for order in case.orders] == [True, False, True]
    assert case.phases[-1] == "done"


@within(partial(played, Call, **STEPS, repeat_s=0, that_may_fail=[0]))
async def test_a_refused_call_is_a_failure_unless_it_may_be_refused(given):
    system, case = given
    case.command(1)
    await asyncio.sleep(0.1)
    system.say(VALVE, Valve(False))  # the first may fail
    await system.settle()
    assert (len(case.orders), case.phases[-1]) == (2, "acting")
    await asyncio.sleep(0.1)
    system.say(VALVE, Valve(False))
    await system.settle()
    assert case.phases[-1] == "failed"
    assert "command 2 of 3 on tank/order: tank/valve:shut is False" in (
        case.reports[-1].message.reason)


@within(partial(played, Call, **ONE, repeat_s=0))
async def test_a_call_that_is_not_answered_fails_and_names_the_answer(given):
    _, case = given
    case.command(1)
    await asyncio.sleep(2.2)
    assert (len(case.orders), case.phases[-1]) == (1, "failed")
    assert "tank/valve:shut is not True" in case.reports[-1].message.reason


@pytest.mark.parametrize(("kind", "parameters", "words"), [
    (Hold, {"message": {}}, "required field 'topic' is missing"),
    (Hold, {**SHUT, "confirm": "a:b"}, "equals: missing"),
    (Hold, {**SHUT, "equals": 1}, "confirm"),
    (Call, {"topic": "a", "messages": [{}]}, "required field 'answer' is missing"),
])
def test_parameters_that_make_no_sense_are_refused_by_name(kind, parameters, words):
    with pytest.raises(ValueError, match=r".") as caught:
        read_parameters(kind.Parameters, parameters, "x.toml", "R.parameters")
    assert "\n" not in str(caught.value)
    assert words in str(caught.value)


# -- in a specification ------------------------------------------------------------------------


class Gauge(Actor):
    """Publishes the level and receives orders."""

    outputs = (LEVEL, VALVE)

    @on(ORDER)
    def order(self, message: Valve, _header: Header) -> None:
        """Obey."""


SYSTEM = TANK.replace(
    "rampart.actors.runtime.stub_node:StubNode", f"{__name__}:Gauge").replace(
    'rampart.actors.detection.stub:StubDetection"',
    'rampart.actors.detection.threshold:Threshold"\n'
    'parameters = { value = "VALUE", above = 2.0 }').replace(
    'rampart.actors.recovery.stub:StubRecovery"',
    'rampart.actors.recovery.telling:Hold"\n'
    'parameters = { topic = "TOPIC", message = { MESSAGE } }')
FITTING = {"VALUE": "tank/level:height_m", "TOPIC": "tank/order", "MESSAGE": "shut = true"}


def layout(**changes: str) -> Layout:
    text = SYSTEM
    for name, value in {**FITTING, **changes}.items():
        text = text.replace(name, value)
    return Layout(RunPlan(system_file="tank.toml"), parse_specification(text, "tank.toml"))


@pytest.mark.parametrize(("changes", "line"), [
    ({"VALUE": "tank/levle:height_m"}, "D_LEVEL: parameters.value: no actor has a topic 'tank/le"),
    ({"VALUE": "tank/level:hieght_m"}, "D_LEVEL: parameters.value: topic tank/level: hieght_m: "),
    ({"MESSAGE": "shut = true, colour = 3"}, "R_SHUT: parameters.message: topic tank/order: Ob"),
])
def test_what_a_specification_names_wrongly_is_refused_before_anything_runs(changes, line):
    with pytest.raises(ValueError, match=r".") as caught:
        layout(**changes)
    assert str(caught.value).startswith(f"tank.toml: {line}")
