"""Calls on the virtual loop that nobody takes back, beside those that can be taken back."""

from __future__ import annotations

import asyncio

from hypothesis import given, settings
from hypothesis import strategies as st

from actors.runtime.virtual_loop import VirtualLoop


def run(scenario):
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(scenario())


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.sampled_from([0.0, 0.5, 1.0, 2.0]), st.booleans()), max_size=30))
def test_posted_calls_and_timers_share_one_order(calls):
    async def scenario():
        loop, seen = asyncio.get_running_loop(), []
        for i, (when, posted) in enumerate(calls):
            (loop.post_at if posted else loop.call_at)(when, seen.append, (when, i))
        await asyncio.sleep(3)
        return seen

    assert run(scenario) == sorted((when, i) for i, (when, _) in enumerate(calls))


def test_what_a_call_posts_for_now_waits_for_those_that_are_ready():
    async def scenario():
        loop, seen = asyncio.get_running_loop(), []

        def first():
            seen.append("first")
            loop.post_at(loop.time(), seen.append, "posted")
            loop.call_soon(seen.append, "soon")

        loop.post_at(1.0, first)
        loop.post_at(1.0, seen.append, "second")
        await asyncio.sleep(2)
        return seen

    assert run(scenario) == ["first", "second", "soon", "posted"]


def test_a_posted_call_that_raises_is_reported_and_those_due_with_it_are_made():
    async def scenario():
        loop, seen, errors = asyncio.get_running_loop(), [], []
        loop.set_exception_handler(lambda _loop, context: errors.append(context["exception"]))
        loop.post_at(1.0, lambda: 1 / 0)
        loop.post_at(1.0, seen.append, "after")
        await asyncio.sleep(2)
        return seen, [type(error) for error in errors]

    assert run(scenario) == (["after"], [ZeroDivisionError])


def test_a_call_from_another_thread_wakes_a_loop_that_has_nothing_to_do():
    async def scenario():
        return await asyncio.to_thread(lambda: "from the thread"), asyncio.get_running_loop().time()

    assert run(scenario) == ("from the thread", 0.0)


def test_a_loop_that_was_told_to_stop_does_not_wait():
    loop = VirtualLoop()
    loop.stop()
    loop.run_forever()
    loop.close()
