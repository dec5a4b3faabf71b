"""No message that its type allows ends an actor, takes long, or is answered by one that is none."""

from __future__ import annotations

import asyncio

import pytest

from rampart.actors.bus.envelope import Header, encode
from rampart.actors.ftm import messages as m
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.layout.layout import adapted_system
from rampart.actors.osmosis import topics
from rampart.actors.run.run_plan import SUPERVISOR
from rampart.actors.runtime.actor import Actor, Context, on
from rampart.sim.virtual.virtual_bus import Hub, VirtualBus
from rampart.sim.virtual.virtual_loop import VirtualClock, VirtualLoop
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


def test_what_takes_too_long_is_found(monkeypatch):
    class Slow(Actor):
        @on(topics.POSE)
        def pose(self, _message, _header):
            while True:
                pass

    monkeypatch.setattr(handler_fuzz, "PATIENCE_S", 0.05)
    member = system("paper").layout.members["localization"]
    monkeypatch.setattr(system("paper").layout, "members", {
        **system("paper").layout.members, "localization": type(member)("localization", Slow, {})})
    assert "SlowError" in fuzz_actor("paper", "localization", 1).what


def heard_by_the_supervisor(*bodies):
    """Return the contexts of what a supervisor reports when it is told of changed systems."""
    of = system("paper")

    async def run():
        hub, loop = Hub(), asyncio.get_running_loop()
        reports = []
        member = of.layout.members[SUPERVISOR]
        actor = member.actor(Context(
            SUPERVISOR, 1, VirtualClock(loop, 0.0), VirtualBus(hub, SUPERVISOR), member.parameters,
            of.run, pid=1), handler_fuzz.Machine())
        actor.report_diagnostic = lambda *report: reports.append(report)
        task = asyncio.create_task(actor.run())
        stranger = VirtualBus(hub, "stranger")
        await stranger.open()
        await asyncio.sleep(0.1)
        for number, body in enumerate(bodies, start=1):
            stranger.publish(ftm_topics.ADAPTED_SYSTEM, ftm_topics.ADAPTED_SYSTEM.at(), encode(
                Header("ftm_manager", 1, number, 0.0), body))
            await asyncio.sleep(0.1)
        actor.stop()
        await task
        return reports

    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(run())


@pytest.mark.parametrize("document", ["[]", "null", "1", "true", "{", "", "[" * 300_000, "{}"])
def test_a_changed_system_that_is_no_document_is_reported_and_the_supervisor_goes_on(document):
    reports = heard_by_the_supervisor(m.AdaptedSystem(1, "a change", "somebody", document))
    assert [(context, offender) for context, _, offender in reports] == [("adaptation", "a change")]


def test_a_document_nested_too_deep_is_a_value_error():
    with pytest.raises(ValueError, match="nested too deep"):
        adapted_system(system("paper").layout, {}, m.AdaptedSystem(1, "", "", '{"a":' * 50_000))
