"""`rampart mission` against a living Mission Manager over Zenoh."""

from __future__ import annotations

import json

import pytest

from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import messages as m
from rampart.actors.osmosis import topics
from rampart.actors.osmosis.airport.formats import load_airport
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.osmosis.control.mission.mission_manager import MissionManager
from rampart.actors.osmosis.messages import MissionPhase
from rampart.actors.runtime.actor import Actor
from rampart.actors.runtime.run_context import RunContext
from tests.cli.test_verbs_live import Run, running

GOALS = (m.Goal(1.0, 2.0, m.Mode.TAXI), m.Goal(3.0, 4.0, m.Mode.TAXI))
REQUEST = m.MissionRequest("r1/first", "AB", GOALS)


class Planner(Actor):
    """Stands for the rest: it tells the first route, so that home is known."""

    outputs = (topics.MISSION_REQUEST, topics.ROUTE, ftm_topics.MANAGER_STATUS)


@pytest.fixture
async def run(monkeypatch, capsys, bus_folder):
    on_map = RunContext(application=Osmosis.on_map(load_airport("vallombre")))
    async with running(monkeypatch, capsys, bus_folder,
                       ("mission_manager", MissionManager,
                        {"parameters": {"held_by": ["RM2"]}, "run": on_map}),
                       ("planner", Planner, {"run": on_map})) as made:
        yield made


def begin(run: Run) -> None:
    """Have the Mission Manager under way, with a home to return to."""
    run.node.request(REQUEST, None)
    run.node.route(m.Route("r1/first", 0, m.Mode.TAXI, True, ((0.0, 0.0), (1.0, 2.0)), ""), None)


async def test_an_order_reaches_the_mission_once_with_its_reason(run):
    begin(run)
    told = json.loads(await run.out("mission", "replan", "--json"))
    assert (told["accepted"], told["plan"], run.node.state.plan) == (True, 1, 1)
    assert told["mission"].items() >= {"mission_id": "r1/first", "name": "AB", "phase": "running",
                                       "goals": 2}.items()
    out = await run.out("mission", "pause", "--reason", "runway in use")
    assert out == ("pause obeyed; mission AB paused, step 1 of 2, 0 lights measured: "
                   "operator: runway in use\n")
    assert run.node.state.phase is MissionPhase.PAUSED


async def test_an_order_that_makes_no_sense_is_refused_with_the_reason_and_exit_code_1(run):
    error = await run.err(1, "mission", "pause")
    assert error == "rampart: pause refused: no mission is under way\n"
    begin(run)
    code, out, _ = await run.call("mission", "resume", "--json")
    told = json.loads(out)
    assert (code, told["accepted"]) == (1, False)
    assert told["reason"] == "the mission is not paused but running"


async def test_without_an_answer_the_verb_says_so(run, monkeypatch):
    monkeypatch.setattr(MissionManager, "publish", lambda *_: None)
    monkeypatch.setattr("rampart.cli.osmosis.mission_verb._ANSWER_S", 0.5)
    code, out, err = await run.call("mission", "pause")
    assert (code, out) == (1, "")
    assert err == "rampart: no effect: the Mission Manager did not answer within 0.5 s\n"
