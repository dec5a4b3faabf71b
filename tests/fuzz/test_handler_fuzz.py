"""No message that its type allows ends an actor, takes long, or is answered by one that is none."""

from __future__ import annotations

import asyncio

import pytest

from rampart.actors.ftm import messages as m
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import topics
from rampart.actors.runtime.actor import Actor, on
from rampart.actors.runtime.run_plan import SUPERVISOR
from rampart.actors.system.layout import adapted_system
from rampart.testing import VirtualSystem, run
from tests.fuzz import handler_fuzz
from tests.fuzz.handler_fuzz import SYSTEMS, cases, fuzz_actor, fuzz_tools, system


@pytest.mark.parametrize("name", SYSTEMS)
def test_no_actor_of_a_system_ends_of_what_its_types_allow(name):
    found = [fuzz_actor(of, actor, seed=1) for of, actor in cases() if of == name]
    assert len(found) >= 10
    assert [str(finding) for finding in found if finding] == []


def test_no_tool_fails_to_show_what_its_types_allow():
    found = [fuzz_tools(seed) for seed in range(3)]
    assert [str(finding) for finding in found if finding] == []


def test_what_ends_an_actor_is_found_and_comes_again_with_the_seed(monkeypatch):
    class Brittle(Actor):
        @on(topics.POSE)
        def pose(self, message, _header):
            if message.x_m != message.x_m:
                raise ArithmeticError("no number")

    member = system("paper").layout.members["localization"]
    monkeypatch.setattr(system("paper").layout, "members", {
        **system("paper").layout.members,
        "localization": type(member)("localization", Brittle, {})})
    finding = next(filter(None, (fuzz_actor("paper", "localization", seed) for seed in range(9))))
    assert "ArithmeticError: no number" in finding.what
    assert finding.told[-1]
    assert fuzz_actor("paper", "localization", finding.seed) == finding


def heard_by_the_supervisor(*bodies):
    """Return the contexts of what a supervisor reports when it is told of changed systems."""
    of = system("paper")

    async def scenario():
        async with VirtualSystem(of.run, of.layout) as living:
            reports = []
            actor = living.start_node(SUPERVISOR, handler_fuzz.Machine())
            actor.report_diagnostic = lambda *report: reports.append(report)
            await asyncio.sleep(0.1)
            for body in bodies:
                living.say(ftm_topics.ADAPTED_SYSTEM, body, "ftm_manager", stamp_s=0.0)
                await asyncio.sleep(0.1)
            await living.stop(SUPERVISOR)
            return reports

    return run(scenario)


@pytest.mark.parametrize("document", ["[]", "null", "1", "true", "{", "", "[" * 300_000, "{}"])
def test_a_changed_system_that_is_no_document_is_reported_and_the_supervisor_goes_on(document):
    reports = heard_by_the_supervisor(m.AdaptedSystem(1, "a change", "somebody", document))
    assert [(context, offender) for context, _, offender in reports] == [("adaptation", "a change")]


def test_a_document_nested_too_deep_is_a_value_error():
    with pytest.raises(ValueError, match="nested too deep"):
        adapted_system(system("paper").layout, system("paper").run,
                       m.AdaptedSystem(1, "", "", '{"a":' * 50_000))
