"""What tests rely on: what fails in an actor, in a monitor or in time, fails the test."""

from __future__ import annotations

import asyncio
import math
from functools import partial

import pytest

from rampart.actors.runtime.actor import Actor, every
from rampart.testing import VirtualSystem, eventually, play, run, virtual_run, wait_until, wake
from tests import CELL


class Failing(Actor):
    """Fails after a second."""

    @every(1.0)
    def fail(self) -> None:
        raise RuntimeError("it failed")


async def living(end=None, error=None):
    async with VirtualSystem() as system:
        system.start("failing", Failing)
        await asyncio.sleep(3.0)
        if end:
            await getattr(system, end)("failing")
        if error:
            raise error


def test_what_an_actor_raised_fails_the_test_unless_it_was_killed_or_the_test_itself_fails():
    for end in (None, "stop"):
        with pytest.raises(RuntimeError, match="it failed"):
            run(partial(living, end))
    run(partial(living, "kill"))
    with pytest.raises(KeyError, match="the test"):
        run(partial(living, error=KeyError("the test")))


def test_a_node_that_no_file_has_is_named():
    async def scenario():
        async with VirtualSystem.load(CELL) as system:
            system.start_node("camera")
            system.start_node("nobody")

    with pytest.raises(LookupError, match="no node 'nobody' in the file"):
        run(scenario)


def test_what_does_not_come_true_in_time_is_told():
    with pytest.raises(AssertionError, match="no such luck"):
        run(lambda: eventually(lambda: False, 60.0, "no such luck"))
    with pytest.raises(AssertionError, match="nor here"):
        wait_until(lambda: False, 0.0, lambda: "nor here")


class Odd:
    """A monitor with whatever is wrong."""

    active, known, reason, nodes, due_s = False, True, "", (), math.inf

    def expire(self, _now_s):
        pass


def test_a_monitor_that_is_due_for_ever_or_gives_no_reason_is_found_out():
    odd = Odd()
    odd.active = True
    with pytest.raises(AssertionError, match="its reason: ''"):
        play(odd, lambda _event, _now_s: None, ".")
    odd.due_s = 0.5
    with pytest.raises(AssertionError, match=r"due again at 0\.5 s"):
        wake(odd, 1.0)


# -- `virtual_run`: a whole system for tests of one's own


def test_a_system_runs_with_its_faults_as_long_as_it_is_told():
    done = virtual_run(CELL, "kill:gripper@1", seconds=3.0, seed=4)
    assert done.record.restarts["gripper"] == 1
    assert done.failures == ()
    assert done.trace == virtual_run(CELL, "kill:gripper@1", seconds=3.0, seed=4).trace


def test_a_system_without_an_end_has_to_be_told_when():
    with pytest.raises(ValueError, match=r"cell\.toml: has no \[end\]"):
        virtual_run(CELL)
