"""`rampart mission` against a living Mission Manager over Zenoh, and which orders it offers."""

from __future__ import annotations

import asyncio
import itertools
import json

import pytest

from rampart.actors.bus.run_info import RunInfo
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.bus.zenoh_session import endpoints
from rampart.actors.ftm import messages as fm
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.osmosis.control.mission import mission_state
from rampart.actors.osmosis.control.mission.mission_manager import MissionManager
from rampart.actors.osmosis.control.mission.mission_state import MissionState, obey, status
from rampart.actors.osmosis.messages import MissionAction, MissionPhase
from rampart.actors.runtime.actor import Actor, Context
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.run_context import RunContext
from rampart.cli import systems
from rampart.cli.main import main
from tests.cli.test_verbs_live import RATE, Run

GOALS = (m.Goal(1.0, 2.0, m.Mode.TAXI), m.Goal(3.0, 4.0, m.Mode.TAXI))
REQUEST = m.MissionRequest("r1/first", "AB", GOALS)


class Planner(Actor):
    """Stands for the rest: it tells the first route, so that home is known."""

    outputs = (topics.MISSION_REQUEST, topics.ROUTE, ftm_topics.MANAGER_STATUS)


@pytest.fixture
async def run(monkeypatch, bus_folder):
    loop = asyncio.get_running_loop()
    clock = Clock(loop.time(), RATE, loop.time)
    names = ("mission_manager", "planner")
    info = RunInfo(1, 7450, RATE, clock.source_time(0.0), str(systems.DEFAULT), bus_folder, names,
                   "r1", 0, "test run")
    monkeypatch.setattr("rampart.cli.session.find_run", lambda _port: info)
    nodes, tasks = [], []
    for name, cls, parameters in (
            ("mission_manager", MissionManager, {"held_by": ["RM2"]}), ("planner", Planner, {})):
        bus = ZenohBus(name, endpoints(bus_folder))
        node = cls(Context(name, 1, clock, bus, parameters,
                           run=RunContext(application=Osmosis.on_map(load_airport("vallombre")))))
        tasks.append(asyncio.create_task(node.run()))
        nodes.append((node, bus))
    await asyncio.sleep(0.1)
    yield Run(*nodes[0], info)
    for node, _ in nodes:
        node.stop()
    for task in tasks:
        await asyncio.wait_for(task, 5)


def begin(run: Run) -> None:
    """Have the Mission Manager under way, with a home to return to."""
    run.node.request(REQUEST, None)
    run.node.route(m.Route("r1/first", 0, m.Mode.TAXI, True, ((0.0, 0.0), (1.0, 2.0)), ""), None)


async def test_a_mission_is_paused_with_a_reason_resumed_and_cancelled(run, capsys):
    begin(run)
    code, out, err = await run.call(
        capsys, "mission", "pause", "--reason", "runway in use")
    assert (code, err) == (0, "")
    assert out == ("pause obeyed; mission AB is paused, step 1 of 2: operator: runway in use\n")
    assert run.node.state.phase is MissionPhase.PAUSED
    code, out, _ = await run.call(capsys, "mission", "resume")
    assert (code, out) == (0, "resume obeyed; mission AB is running, step 1 of 2\n")
    code, out, _ = await run.call(capsys, "mission", "cancel", "--reason", "fog")
    assert (code, out) == (0, "cancel obeyed; mission AB is cancelled: operator: fog\n")


async def test_replan_skip_and_home_reach_the_mission_once(run, capsys):
    begin(run)
    code, out, _ = await run.call(capsys, "mission", "replan", "--json")
    assert (code, json.loads(out)["plan"]) == (0, 1)
    code, out, _ = await run.call(capsys, "mission", "skip", "--reason", "closed")
    assert (code, out) == (0, "skip obeyed; mission AB is running, step 2 of 2\n")
    code, out, _ = await run.call(capsys, "mission", "home", "--json")
    told = json.loads(out)
    assert (code, told["accepted"]) == (0, True)
    assert told["mission"] == {
        "mission_id": "r1/first", "name": "AB", "phase": "returning home", "step": 1, "goals": 2,
        "reason": "operator: no reason given"}
    assert (run.node.state.plan, len(run.node.state.skipped)) == (1, 1)


async def test_an_order_that_makes_no_sense_is_refused_with_the_reason_and_exit_code_1(run, capsys):
    code, out, err = await run.call(capsys, "mission", "pause")
    assert (code, out) == (1, "")
    assert err == "rampart: pause refused: no mission is under way\n"
    begin(run)
    code, out, err = await run.call(capsys, "mission", "resume", "--json")
    told = json.loads(out)
    assert (code, told["accepted"]) == (1, False)
    assert told["reason"] == "the mission is not paused but running"
    assert told["mission"]["phase"] == "running"
    assert err == "rampart: resume refused: the mission is not paused but running\n"


async def test_a_robot_that_a_recovery_holds_is_not_released_by_an_order(run, capsys):
    begin(run)
    run.node.manager(fm.ManagerStatus((), (), ("RM2",), (), "safety-first", 1), None)
    code, _, err = await run.call(capsys, "mission", "resume")
    assert code == 1
    assert err == ("rampart: resume refused: held by RM2; it continues when the robot is "
                   "released\n")


async def test_without_an_answer_the_verb_says_so(run, capsys, monkeypatch):
    monkeypatch.setattr(MissionManager, "publish", lambda *_: None)
    monkeypatch.setattr("rampart.cli.osmosis.mission_verb._ANSWER_S", 0.5)
    code, out, err = await run.call(capsys, "mission", "pause")
    assert (code, out) == (1, "")
    assert err == "rampart: no effect: the Mission Manager did not answer within 0.5 s\n"


@pytest.mark.parametrize("reason", ["", "  ", "x" * 201, "two\nlines", "bell\a"])
def test_a_reason_that_is_none_is_bad_usage(reason, capsys):
    assert main(["mission", "pause", "--reason", reason]) == 2
    assert "must be one line of 1 to 200 printable characters" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["mission"], ["mission", "stop"], ["mission", "pause", "x"]])
def test_an_order_that_there_is_not_is_bad_usage(arguments, capsys):
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2
    assert "usage: rampart" in capsys.readouterr().err


def test_the_status_offers_exactly_the_orders_that_are_then_obeyed():
    """Breadth first: every state that four events can lead to, each order tried in each."""
    orders = [lambda s, i=i, a=a: obey(s, m.MissionOrder(f"o{i}{a}", a, "why", "operator"), 1.0)[0]
              for i, a in itertools.product(range(2), MissionAction)]
    events = [
        *orders,
        lambda s: mission_state.accept(s, REQUEST, 0.0),
        lambda s: mission_state.hold(s, "held by RM2"),
        lambda s: mission_state.hold(s, ""),
        lambda s: mission_state.routed(s, m.Route(
            s.mission_id, s.step, m.Mode.TAXI, True, ((0.0, 0.0),), "")),
    ]
    states = {MissionState(): None}
    for _ in range(4):
        states |= {event(state): None for state in states for event in events}
    offered = set()
    for state in states:
        obeyed = tuple(
            action for action in MissionAction
            if obey(state, m.MissionOrder("new", action, "why", "operator"), 1.0)[1].accepted)
        assert set(status(state).orders) == set(obeyed)
        offered.add((state.phase, bool(state.held), obeyed))
    assert len(offered) > 10
    assert {phase for phase, _, obeyed in offered if not obeyed} == {
        MissionPhase.IDLE, MissionPhase.FAILED, MissionPhase.CANCELLED}
