"""Terminal output of a run."""

from io import StringIO

import msgspec
import pytest

from rampart.actors.ftm import messages as m
from rampart.actors.ftm import topics
from rampart.actors.runtime.actor import Header
from rampart.actors.runtime.run_plan import RunPlan
from rampart.sim.runs.console import Console
from rampart.sim.runs.record import RunRecorder

PLAN = RunPlan("r")
CALM = m.ManagerStatus((), (), (), (), "guarded-repair", 0)


def test_a_module_that_falls_silent_and_is_heard_again_is_told_once_each():
    stream = StringIO()
    console = Console(stream)
    for second, silent in enumerate([(), ("D_FAST",), ("D_FAST",), ()]):
        console.take(topics.MANAGER_STATUS, msgspec.structs.replace(CALM, silent=silent),
                     Header("manager", 1, second, float(second)))
    assert stream.getvalue().splitlines() == [
        "[   1.00 s] D_FAST silent: it counts as active", "[   3.00 s] D_FAST: no longer silent"]


@pytest.mark.parametrize(("mission", "safety", "told"), [
    ("success", "safe", True), ("fail", "unsafe", True), (None, None, False)])
def test_the_verdict_on_a_run_that_was_judged_is_told_also_if_it_is_a_success(
        mission, safety, told):
    stream = StringIO()
    record = RunRecorder(PLAN, "").record(12.0, mission=mission, safety=safety)
    Console(stream).conclusion(record, None)
    assert (stream.getvalue() == f"{mission}, {safety}, 12.0 s simulated.\n") is told
    assert bool(stream.getvalue()) is told
