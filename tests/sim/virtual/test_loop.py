"""Virtual time and its network: the loop, what runs on it, and that nothing waits."""

from __future__ import annotations

import asyncio
from collections import Counter
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rampart.actors.osmosis import topics
from rampart.actors.runtime.actor import Actor
from rampart.sim.virtual.network import NETWORKS, NetworkModel, SeededNetwork, Timing
from rampart.sim.virtual.virtual_bus import Hub, VirtualBus
from rampart.sim.virtual.virtual_loop import VirtualLoop
from rampart.testing import virtual_run
from tests import CELL


def run(scenario):
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(scenario())


def test_timeouts_threads_and_queues_of_asyncio_work_on_it():
    async def scenario():
        with pytest.raises(TimeoutError):
            async with asyncio.timeout(5):
                await asyncio.Event().wait()
        queue: asyncio.Queue[int] = asyncio.Queue()
        asyncio.get_running_loop().call_later(3, queue.put_nowait, 7)
        assert await asyncio.wait_for(queue.get(), 10) == 7
        assert await asyncio.to_thread(lambda: 42) == 42
        await asyncio.sleep(3600)  # an hour passes at once and to the second
        return asyncio.get_running_loop().time()

    assert run(scenario) == 3608.0


WAYS = st.sampled_from(["posted", "timer", "withdrawn"])


@given(st.lists(st.tuples(st.sampled_from([0.0, 0.5, 1.0, 2.0]) | st.floats(0, 2), WAYS),
                max_size=30))
def test_posted_calls_and_timers_share_one_order_and_what_was_withdrawn_is_not_called(calls):
    """The order is that of time, and of scheduling if at once."""
    async def scenario():
        loop, seen = asyncio.get_running_loop(), []

        def note(when, i):
            assert loop.time() == when
            seen.append((when, i))

        def gone(when, i):
            seen.append("what was withdrawn")

        for i, (when, way) in enumerate(calls):
            (loop.call_at if way == "timer" else loop.post_at)(
                when, gone if way == "withdrawn" else note, when, i)
        loop.withdraw([gone])
        for call in (loop.call_later(50, gone, 0, 0), loop.call_soon(gone, 0, 0)):
            call.cancel()
            assert call.cancelled()
        await asyncio.sleep(3)
        assert loop.time() == 3.0  # what was cancelled costs no time
        return seen

    assert run(scenario) == sorted(
        (when, i) for i, (when, way) in enumerate(calls) if way != "withdrawn")


@pytest.mark.parametrize("posted", [True, False])
def test_a_call_that_raises_is_reported_and_those_due_with_it_are_made(posted):
    async def scenario():
        loop, seen, errors = asyncio.get_running_loop(), [], []
        loop.set_exception_handler(lambda _loop, context: errors.append(context["exception"]))
        call = loop.post_at if posted else loop.call_at
        call(1.0, lambda one, zero: one / zero, 1, 0)
        call(1.0, lambda what, _: seen.append(what), "after", None)
        await asyncio.sleep(2)
        return seen, [type(error) for error in errors]

    assert run(scenario) == (["after"], [ZeroDivisionError])


def test_what_is_on_its_way_to_a_node_that_is_killed_does_not_arrive():
    async def scenario():
        hub, seen = Hub(lambda _source, _reader: lambda now_s: (now_s + 1.0,)), []
        buses = {name: VirtualBus(hub, name) for name in ("talker", "killed", "other")}
        for name, bus in buses.items():
            await bus.open()
            if name != "talker":
                bus.subscribe(topics.POSE.at(),
                              lambda _key, payload, name=name: seen.append((name, payload)))
        buses["talker"].publish(topics.POSE, topics.POSE.at(), b"first")
        await asyncio.sleep(1.5)
        buses["talker"].publish(topics.POSE, topics.POSE.at(), b"second")
        await asyncio.sleep(0.5)
        buses["killed"].cut()
        buses["talker"].publish(topics.POSE, topics.POSE.at(), b"third")
        await asyncio.sleep(2)
        return seen

    assert run(scenario) == [("killed", b"first"), ("other", b"first"),
                             ("other", b"second"), ("other", b"third")]


def test_files_are_served_while_time_stands_still():
    async def scenario():
        async def serve(_reader, writer):
            writer.write(b"hello")
            writer.close()

        server = await asyncio.start_server(serve, "127.0.0.1", 0)
        reader, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
        text = await reader.read()
        writer.close()
        server.close()
        await server.wait_closed()
        return text

    assert run(scenario) == b"hello"


def test_what_a_call_posts_for_now_waits_for_those_that_are_ready():
    async def scenario():
        loop, seen = asyncio.get_running_loop(), []

        def first(what, _):
            seen.append(what)
            loop.post_at(loop.time(), note, "posted", None)
            loop.call_soon(seen.append, "soon")

        def note(what, _):
            seen.append(what)

        loop.post_at(1.0, first, "first", None)
        loop.post_at(1.0, note, "second", None)
        await asyncio.sleep(2)
        return seen

    assert run(scenario) == ["first", "second", "soon", "posted"]


def test_a_stopped_loop_does_not_wait():
    loop = VirtualLoop()
    loop.stop()
    loop.run_forever()
    loop.close()


# -- The processes of a virtual run, as faults see them --


def test_a_slow_node_is_slow_after_a_restart_too_until_the_fault_ends(monkeypatch):
    paces: list[float] = []
    slow_down = Actor.slow_down

    def noted(self: Actor, pace_s: float) -> None:
        paces.append(pace_s)
        slow_down(self, pace_s)

    monkeypatch.setattr(Actor, "slow_down", noted)
    done = virtual_run(CELL, "slow:gripper:0.02@1+3", "kill:gripper@2", seconds=5.0)
    assert done.record.restarts["gripper"] == 1
    assert paces == [0.02, 0.02, 0.0]


# -- The network of a virtual run: seeded, measured, and with the faults of its model --


def ways(network: SeededNetwork, count: int = 4000, step_s: float = 0.001):
    link = network.link("a", "b")
    return [(i * step_s, link(i * step_s)) for i in range(count)]


def test_the_same_seed_gives_the_same_arrivals_and_another_seed_others():
    model = NETWORKS["lossy"]
    assert ways(SeededNetwork(model, 1)) == ways(SeededNetwork(model, 1))
    assert ways(SeededNetwork(model, 1)) != ways(SeededNetwork(model, 2))


def test_over_one_link_nothing_is_lost_nothing_comes_twice_and_nothing_overtakes():
    for name in ("measured", "jittery"):
        arrivals = [at for _, at in ways(SeededNetwork(NETWORKS[name], 3))]
        assert all(len(at) == 1 for at in arrivals)
        times = [at[0] for at in arrivals]
        assert times == sorted(times)
    for model in NETWORKS.values():
        assert all(at >= sent for sent, found in ways(SeededNetwork(model, 4)) for at in found)


def test_delays_are_drawn_from_the_measured_distribution():
    quantiles = (1.0, 2.0, 10.0)
    link = SeededNetwork(NETWORKS["measured"], 5, Timing(quantiles, *[(1.0, 1.0)] * 4)
                         ).link("a", "b")
    delays = [(link(i)[0] - i) * 1e3 for i in range(4000)]
    for value in (1.5, 2.0, 6.0):
        below = sum(delay < value for delay in delays) / len(delays)
        assert below == pytest.approx(np.interp(value, quantiles, (0.0, 0.5, 1.0)), abs=0.03)
    assert min(delays) + 1e-6 >= 1.0
    assert 9.9 < max(delays) <= 10.0 + 1e-6


def test_loss_duplication_and_overtaking_come_as_often_as_said():
    network = SeededNetwork(NetworkModel(
        "x", "", extra_s=0.05, loss=0.1, duplication=0.2, reordering=1.0), 6)
    found = [at for _, at in ways(network, 10_000)]
    copies = Counter(map(len, found))
    assert copies[0] / 10_000 == pytest.approx(0.1, abs=0.01)
    assert copies[2] / 10_000 == pytest.approx(0.9 * 0.2, abs=0.015)
    times = [at[0] for at in found if at]
    assert sum(later < earlier for earlier, later in pairwise(times)) > 1000


def test_the_observer_receives_messages_at_once_on_any_network():
    network = SeededNetwork(NetworkModel("x", "", loss=1.0), 1, local=("observer",))
    assert network.link("a", "observer") is None
    assert network.link("observer", "a") is None
    assert network.link("a", "b")(5.0) == ()
