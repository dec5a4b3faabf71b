"""What a run tells on the terminal."""

from __future__ import annotations

from io import StringIO

import msgspec
import pytest

from rampart.actors.ftm import messages as m
from rampart.actors.ftm import topics
from rampart.actors.runtime.actor import Header
from rampart.actors.runtime.run_plan import RunPlan
from rampart.manager.spec.specification import parse_specification
from rampart.sim.osmosis.trial.mission_trial import MissionConsole
from rampart.sim.runs.console import Console
from rampart.sim.runs.record import RunRecorder
from tests import system_file

PLAN = RunPlan("r")
CALM = m.ManagerStatus((), (), (), (), "guarded-repair", 0)


def system(name: str):
    return parse_specification(system_file(name).read_text("utf-8"), name)


def test_a_module_that_falls_silent_and_is_heard_again_is_told_once_each():
    stream = StringIO()
    console = Console(stream)
    for second, silent in enumerate([(), ("D_FAST",), ("D_FAST",), ()]):
        console.take(topics.MANAGER_STATUS, msgspec.structs.replace(CALM, silent=silent),
                     Header("manager", 1, second, float(second)))
    assert stream.getvalue().splitlines() == [
        "[   1.00 s] D_FAST silent: it counts as active", "[   3.00 s] D_FAST: no longer silent"]


@pytest.mark.parametrize(("name", "node"), [
    ("paper", "osmosis_control"), ("osmosis", "osmosis_control"), ("cell", "camera")])
def test_the_banner_offers_to_kill_a_node_that_the_system_has(name, node):
    stream = StringIO()
    MissionConsole(stream).banner("a mission", PLAN, system(name))
    assert stream.getvalue().endswith(f"Try from another shell: kill-node {node}\n")


def test_where_no_recovery_brings_a_node_back_none_is_offered():
    stream = StringIO()
    alone = msgspec.structs.replace(system("cell"), nodes=())
    Console(stream).banner("a mission", PLAN, alone)
    assert "kill-node" not in stream.getvalue()


@pytest.mark.parametrize(("mission", "safety", "told"), [
    ("success", "safe", True), ("fail", "unsafe", True), (None, None, False)])
def test_the_verdict_on_a_run_that_was_judged_is_told_also_if_it_is_a_success(
        mission, safety, told):
    stream = StringIO()
    record = RunRecorder(PLAN, "").record(12.0, mission=mission, safety=safety)
    Console(stream).conclusion(record, None)
    assert (stream.getvalue() == f"{mission}, {safety}, 12.0 s simulated.\n") is told
    assert bool(stream.getvalue()) is told
