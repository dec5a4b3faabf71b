"""Virtual time itself: the loop, what runs on it, and that nothing waits."""

from __future__ import annotations

import asyncio
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.runtime.virtual_loop import VirtualLoop


def run(scenario):
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(scenario())


def test_an_hour_passes_at_once_and_to_the_second():
    async def scenario():
        await asyncio.sleep(3600)
        return asyncio.get_running_loop().time()

    started = time.monotonic()
    assert run(scenario) == 3600.0
    assert time.monotonic() - started < 3600


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(0, 100), max_size=30))
def test_calls_come_in_order_of_time_and_of_scheduling_if_at_once(delays):
    async def scenario():
        loop, seen = asyncio.get_running_loop(), []
        for i, delay in enumerate(delays):
            loop.call_later(delay, lambda i=i: seen.append((loop.time(), i)))
        await asyncio.sleep(101)
        return seen

    seen = run(scenario)
    assert seen == sorted((delay, i) for i, delay in enumerate(delays))


def test_what_is_cancelled_is_not_called_and_costs_no_time():
    async def scenario():
        loop, seen = asyncio.get_running_loop(), []
        for call in (loop.call_later(50, seen.append, "late"), loop.call_soon(seen.append, "now")):
            call.cancel()
            assert call.cancelled()
        await asyncio.sleep(1)
        return seen, loop.time()

    assert run(scenario) == ([], 1.0)


def test_a_callback_that_raises_is_reported_and_the_rest_goes_on():
    async def scenario():
        loop, seen, errors = asyncio.get_running_loop(), [], []
        loop.set_exception_handler(lambda _loop, context: errors.append(context["exception"]))
        loop.call_later(1, lambda: 1 / 0)
        loop.call_later(1, seen.append, "after")
        await asyncio.sleep(2)
        return seen, [type(e) for e in errors]

    assert run(scenario) == (["after"], [ZeroDivisionError])


def test_timeouts_threads_and_queues_of_asyncio_work_on_it():
    async def scenario():
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(5):
                await asyncio.Event().wait()
        queue: asyncio.Queue[int] = asyncio.Queue()
        asyncio.get_running_loop().call_later(3, queue.put_nowait, 7)
        assert await asyncio.wait_for(queue.get(), 10) == 7
        assert await asyncio.to_thread(lambda: 42) == 42
        return asyncio.get_running_loop().time()

    assert run(scenario) == 8.0


def test_files_are_served_while_time_stands_still():
    async def scenario():
        served = asyncio.Event()

        async def serve(_reader, writer):
            writer.write(b"hello")
            writer.close()
            served.set()

        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        reader, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
        text = await reader.read()
        writer.close()
        server.close()
        await server.wait_closed()
        return text

    assert run(scenario) == b"hello"


def test_the_context_of_a_task_stays_its_own():
    import contextvars

    variable: contextvars.ContextVar[str] = contextvars.ContextVar("variable", default="-")

    async def one(name):
        variable.set(name)
        await asyncio.sleep(1)
        return variable.get()

    async def scenario():
        return await asyncio.gather(one("a"), one("b")), variable.get()

    assert run(scenario) == (["a", "b"], "-")
