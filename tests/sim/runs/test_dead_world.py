"""Which node tables end a judged run because its world is dead, as timelines."""

from __future__ import annotations

from dataclasses import replace as with_system

import pytest
from msgspec.structs import replace

from rampart import systems
from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import NodeInfo, NodeState, NodeTable
from rampart.actors.runtime.actor import Header
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.run_context import RunContext
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.system.layout import load_run
from rampart.sim.runs.trial import Trial, trial_class

STATES = {"s": NodeState.STARTING, "R": NodeState.RUNNING, "x": NodeState.CRASHED,
          "T": NodeState.STOPPED}


@pytest.fixture(scope="module")
def run() -> RunContext:
    plan = RunPlan(system_file=str(systems.find("paper")), options={"mission": "A"})
    return load_run(plan, load_system(plan))


def ended(trial: Trial, states: str) -> bool:
    """Whether tables at intervals of half a second with these states of the world end a run."""
    for number, state in enumerate(states):
        header = Header("supervisor", 1, number + 1, number / 2)
        table = NodeTable(tuple(NodeInfo(name, "world", 7, STATES[of], 1, 0)
                                for name, of in (("controller", "x"), ("simulator", state))))
        for sink in trial.sinks(Clock(0.0)):
            sink(topics.NODES, table, header)
    return "the world has died" in (trial.ended(len(states) / 2) or "")


@pytest.mark.parametrize(("states", "ends"), [
    ("xxxxsR", False),  # before its first process
    ("sRRxx", True), ("sxx", True),
    ("sRRxRxR", False),  # a new supervisor has not adopted it yet
    ("sRTTTTR", False)])
def test_a_world_that_stays_dead_ends_the_run(run, states, ends):
    assert ended(trial_class(run.system)(run), states) is ends


def test_without_a_judge_or_with_a_recovery_module_that_restarts_it_the_run_goes_on(run):
    assert not ended(Trial(run), "sRRxx")
    nodes = tuple(replace(node, respawn="RM3") if node.name == "simulator" else node
                  for node in run.system.nodes)
    restarted = with_system(run, system=replace(run.system, nodes=nodes))
    assert not ended(trial_class(run.system)(restarted), "sRRxx")
