"""Many nodes that are late at once: what they have in common is the machine."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import pytest

from rampart.actors.bus import messages as bm
from rampart.actors.bus import topics as bus_topics
from rampart.actors.detection.overload import Overload
from rampart.actors.machine.patience import Usage
from rampart.testing import Ear, VirtualSystem, run

NODES = ("a", "b", "c", "d", "e", "f")


def states(script: list[tuple[float, str, float]], *, until_s: float = 6.0,
           waits_until_s: float = 0.0, incarnation: int = 1) -> list[tuple[float, str]]:
    """When DM14 changed its state: heartbeats at a time, from nodes, that were so late.

    Until `waits_until_s` their processes wait for a processor for a fifth of the time.
    """

    async def scenario() -> list[tuple[float, str]]:
        async with VirtualSystem() as system:
            ear = system.start("ear", Ear)
            system.incarnations["D"] = incarnation - 1
            system.start("D", lambda context: Overload(replace(context, scheduled=lambda _: Usage(
                "S", 1.0, 0.2 * min(system.clock.now(), waits_until_s)))),
                watch=list(NODES), late_s=0.15, clear_s=1.0, wait_s=4.0)
            for at_s, nodes, late_s in script:
                await asyncio.sleep(max(0.0, at_s - system.clock.now()))
                for node in nodes:
                    beat = bm.Heartbeat(ord(node), 1, 0.1, 0, 0, late_s)
                    system.say(bus_topics.HEARTBEAT, beat, node)
            await asyncio.sleep(until_s - system.clock.now())
            found: list[tuple[float, str]] = []
            for at_s, report in ear.heard:
                if not found or found[-1][1] != report.state.value:
                    found.append((round(at_s, 1), report.state.value))
            return found

    return run(scenario)


def test_many_that_are_late_at_once_are_an_overload_until_they_have_not_been_for_a_while():
    late_s = 0.2
    script = [(1.0 + 0.2 * i, "abc", late_s) for i in range(5)]
    assert states(script)[1:] == [(1.0, "active"), (3.3, "idle")]


@pytest.mark.parametrize("script", [
    [(1.0 + 0.1 * i, "a", 3.0) for i in range(20)],  # one is a fault of its own
    [(1.0, "a", 0.2), (2.0, "b", 0.2), (3.0, "c", 0.2)],  # not at once
    [(1.0 + 0.1 * i, NODES, 0.05) for i in range(20)],  # not late enough
])
def test_few_or_a_little_late_are_no_overload(script):
    assert {state for _, state in states(script)} == {"idle"}


def test_one_that_was_late_for_long_counts_for_as_long():
    """A loop that turns every 0.9 s reports every 0.9 s; another one reports in between."""
    script = [(1.0 + 0.45 * i, "ab"[i % 2], 0.9) for i in range(8)]
    assert [state for _, state in states(script, until_s=4.0)] == ["idle", "active"]


@pytest.mark.parametrize(("waits_until_s", "idle_s"), [(0.0, 2.5), (3.2, 4.7), (99.0, 6.5)])
def test_it_lasts_while_many_wait_for_a_processor_but_not_for_ever(waits_until_s, idle_s):
    script = [(1.0, "abc", 0.2)]
    ((active_s, active), (found_s, idle)) = states(
        script, until_s=9.0, waits_until_s=waits_until_s)[1:]
    assert (active_s, active, idle) == (1.0, "active", "idle")
    assert found_s == pytest.approx(idle_s, abs=0.4)


def test_a_successor_says_nothing_before_it_knows():
    assert states([], until_s=0.4, incarnation=2) == []
    assert states([], until_s=2.0, incarnation=2) == [(0.5, "idle")]
    assert states([(0.3, "abc", 0.2)], until_s=0.9, incarnation=2) == [(0.3, "active")]
