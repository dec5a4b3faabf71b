"""Planned faults: how they are written, what they become, and what is refused."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.osmosis import topics
from rampart.cli import systems
from rampart.sim.campaign.plan import fault_groups
from rampart.sim.faults.injector import can_be_hit
from rampart.sim.faults.scenario import OnProcess, PlannedFault, ScenarioError, parse_fault
from rampart.sim.faults.scenario import action_of as action_in
from rampart.sim.faults.topic_faults import UnknownFaultError
from rampart.sim.osmosis.trial.faults import OsmosisFaults, SuddenObstacle

SYSTEM = systems.load(None)
NODES = can_be_hit(SYSTEM)


def action_of(planned: PlannedFault, injection: str = "f1") -> object:
    return action_in(planned, injection, NODES, topics.ALL, OsmosisFaults())


@pytest.mark.parametrize(("text", "planned"), [
    ("gps-bias+5", PlannedFault("gps-bias", 10.0, duration_s=5.0)),
    ("laser-stuck@goal2:5+3", PlannedFault("laser-stuck", 5.0, 2, 3.0)),
    ("weak-wheel:rear-left:0.3@7", PlannedFault("weak-wheel:rear-left:0.3", 7.0)),
])
def test_what_is_typed_is_what_is_meant(text, planned):
    assert parse_fault(text) == planned


@pytest.mark.parametrize(("text", "words"), [
    ("@3", "must be FAULT"), ("x@-1", "WHEN '-1'"), ("x@inf", "WHEN 'inf'"), ("x@nan", "WHEN"),
    ("x@3+long", "DURATION 'long'"), ("x+", "DURATION ''"), ("x@goal0", "goals are counted from 1"),
    ("x@goalx", "goalx"), ("x@goal1:z", "WHEN 'z'"),
])
def test_what_makes_no_sense_is_refused_in_one_line(text, words):
    with pytest.raises(ScenarioError, match=words) as caught:
        parse_fault(text)
    assert "\n" not in str(caught.value)


@given(st.sampled_from(["gps-bias", "kill:DM1", "drop:control/command"]),
       st.floats(0, 1e3).map(lambda x: round(x, 2)), st.integers(0, 5),
       st.none() | st.floats(0, 100).map(lambda x: round(x, 2)) | st.just(math.inf))
def test_text_and_plan_say_the_same(fault, at_s, goal, duration_s):
    planned = PlannedFault(fault, at_s, goal, duration_s)
    assert parse_fault(planned.text()) == planned


def test_every_fault_of_the_catalogue_becomes_an_action():
    groups = fault_groups(SYSTEM)
    kinds = {"paper": tuple, "sensor": tuple, "topic": tuple, "reading": tuple,
             "frozen": tuple, "process": OnProcess, "actuator": tuple, "world": SuddenObstacle}
    assert set(groups) == set(kinds)
    for group, names in groups.items():
        assert len(names) == len(set(names)) > 0
        for name in names:
            assert isinstance(action_of(PlannedFault(name)), kinds[group]), name


def test_faults_of_topics_carry_pattern_seed_and_duration():
    action = action_of(PlannedFault("gps-noise", 3.0, duration_s=math.inf, share=0.5, on_s=1.0,
                                    off_s=2.0, seed=9), "f7")
    order = action[0].message
    assert (order.injection, order.duration_s, order.share) == ("f7", math.inf, 0.5)
    assert (order.on_s, order.off_s, order.seed) == (1.0, 2.0, 9)


def test_all_processes_are_slow_at_once_and_none_is_killed_by_a_name_that_means_all():
    assert action_of(PlannedFault("slow:all:0.03", duration_s=5.0)) == OnProcess(
        "slow", "", 0.03, 5.0)
    assert action_of(PlannedFault("stop:all", duration_s=5.0)) == OnProcess("stop", "", 0.0, 5.0)
    with pytest.raises(ScenarioError, match="no node 'all'"):
        action_of(PlannedFault("kill:all"))


@pytest.mark.parametrize(("fault", "words"), [
    ("kill:nobody", "no node 'nobody' that a fault can hit; there are: supervisor, "),
    ("kill:simulator", "not the world"), ("slow:DM1:x", "must be one number between 0 and 60"),
    ("stuck-wheel:fifth", "unknown wheel 'fifth'; known: front-left"),
    ("brake-failure:0.1:2", "must be one number"), ("obstacle-ahead:far", "must be one number"),
])
def test_an_impossible_detail_is_refused(fault, words):
    with pytest.raises(ScenarioError, match=words):
        action_of(PlannedFault(fault))
    with pytest.raises(UnknownFaultError):
        action_of(PlannedFault("gremlins"))
