"""Recovery modules that a specification alone makes: `Hold`, `Call`, `Respawn`, and its group."""

import asyncio
from contextlib import asynccontextmanager
from functools import partial

import pytest

from rampart import RunContext, parse_specification
from rampart.actors.bus.messages import Heartbeat
from rampart.actors.bus.topics import HEARTBEAT
from rampart.actors.ftm import messages as m
from rampart.actors.ftm import topics
from rampart.actors.recovery.respawn import Respawn, RespawnCore
from rampart.actors.recovery.respawn_group import RespawnGroup
from rampart.actors.recovery.telling import Call, Hold
from rampart.actors.runtime.actor import Actor, Header, on
from rampart.actors.runtime.parameters import read_parameters
from rampart.actors.runtime.run_plan import RunPlan
from rampart.actors.system.layout import Layout
from rampart.testing import VirtualSystem, run
from tests import CELL, TANK
from tests.actors.osmosis.recovery.world import Boss, Node, Supervisor
from tests.osmosis_system import System
from tests.tank import LEVEL, ORDER, TOPICS, VALVE, Valve
from tests.virtual_time import within

SHUT = {"topic": "tank/order", "message": {"shut": True, "opening": 0}}


class Case(Boss):
    """A recovery module and its messages, with a manager that commands it."""

    def __init__(self, system: VirtualSystem, kind: type, **parameters) -> None:
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
async def played(kind: type, **parameters):
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


# -- RM3 and RM4: requests to the supervisor, and when a node counts as back


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
    rm.event("stranger", "crashed", 7, "", 1.0)
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
async def group(**parameters):
    async with System() as system:
        for name in CHAIN:
            system.start(name, Node)
        supervisor, boss = system.start("supervisor", Supervisor), Boss(system)
        system.start("R", RespawnGroup, nodes=CHAIN, **parameters)
        await asyncio.sleep(0.5)
        yield system, supervisor, boss


def asked(supervisor: Supervisor) -> list[str]:
    """The nodes that were asked for, each once."""
    return list(dict.fromkeys(request.node for request in supervisor.requests))


@pytest.mark.parametrize(("named", "others", "restarted"), [
    (["camera"], "later", ["camera", "finder", "planner"]),
    (["finder"], "later", ["finder", "planner"]),
    (["planner"], "later", ["planner"]),
    (["planner", "finder"], "later", ["finder", "planner"]),
    (["planner"], "all", ["camera", "finder", "planner"]),
])
def test_those_that_depend_on_it_go_with_it_in_order(named, others, restarted):
    async def scenario() -> None:
        async with group(others=others) as (system, supervisor, boss):
            for _ in range(20):  # the manager repeats what it wants
                boss.order("R", nodes=tuple(f"{name}#1" for name in named))
                await asyncio.sleep(0.05)
            assert asked(supervisor) == restarted
            assert {name: system.incarnations[name] for name in CHAIN} == {
                name: 2 if name in restarted else 1 for name in CHAIN}
            assert boss.phases[-1] == "done"

    run(scenario)


@within(group)
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


@within(group)
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


@within(group)
async def test_a_node_of_another_group_is_refused(given):
    _, supervisor, boss = given
    boss.order("R", nodes=("gripper",))
    await asyncio.sleep(0.3)
    assert supervisor.requests == []
    assert "gripper: not among the nodes" in boss.reports[-1].message.reason
