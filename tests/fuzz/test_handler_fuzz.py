"""No message that its type allows ends an actor, takes long, or makes it publish a bad one."""

import asyncio

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from rampart.actors.ftm import messages as m
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.runtime.run_plan import SUPERVISOR
from rampart.testing import VirtualSystem, run
from tests.fuzz.handler_fuzz import Machine, cases, fuzz_actor, fuzz_tools, system

pytestmark = pytest.mark.filterwarnings("ignore:Generating overly large repr")

FEW = settings(max_examples=settings.default.max_examples // 5,
               suppress_health_check=list(HealthCheck), phases=set(Phase) - {Phase.explain})


@pytest.mark.parametrize(("of", "name"), cases())
@FEW
@given(st.data())
def test_no_message_that_its_type_allows_ends_an_actor(of, name, data):
    fuzz_actor(system(of), name, data.draw)


@FEW
@given(st.data())
def test_every_tool_shows_any_message_that_its_type_allows(data):
    fuzz_tools(data.draw)


def heard_by_the_supervisor(*bodies):
    """Return the contexts of what a supervisor reports when it is told of changed systems."""
    of = system("paper")

    async def scenario():
        async with VirtualSystem(of.run, of.layout) as living:
            reports = []
            actor = living.start_node(SUPERVISOR, Machine())
            actor.report_diagnostic = lambda *report: reports.append(report)
            await asyncio.sleep(0.1)
            for body in bodies:
                living.say(ftm_topics.ADAPTED_SYSTEM, body, "ftm_manager", stamp_s=0.0)
                await asyncio.sleep(0.1)
            await living.stop(SUPERVISOR)
            return reports

    return run(scenario)


@pytest.mark.parametrize("document", [
    "null", "{", "{}", '{"node": 3}', '{"node": [[]]}',
    "[" * 300_000, '{"a":' * 50_000,
    '{"name": "x", "node": [{"name": "' + "n" * 100_000 + '"}]}'], ids=lambda text: text[:15])
def test_a_changed_system_that_is_no_document_is_reported_and_the_supervisor_goes_on(document):
    reports = heard_by_the_supervisor(m.AdaptedSystem(1, "a change", "somebody", document))
    assert [(context, offender) for context, _, offender in reports] == [("adaptation", "a change")]
