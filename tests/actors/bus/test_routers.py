"""Two routers: a client needs one that answers, and goes over to the other when its own is gone."""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import os
import signal
import socket
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from itertools import pairwise
from pathlib import Path

import pytest

from rampart.actors.bus import zenoh_bus
from rampart.actors.bus.bus import BusError, shared
from rampart.actors.bus.run_folder import ROUTERS, socket_path
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.bus.zenoh_session import endpoint, endpoints
from rampart.actors.osmosis import topics
from rampart.testing import eventually

FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload([__name__])  # a process of its own that has no session yet
pytestmark = pytest.mark.alone


def be_router(folder: str, name: str, ready) -> None:
    """Be a router, in a process of its own."""

    async def main() -> None:
        own = endpoint(folder, name)
        bus = ZenohBus(name, [one for one in endpoints(folder) if one != own], [own])
        await bus.open()
        ready.set()
        await asyncio.sleep(1000)

    asyncio.run(main())


class Routers:
    """The routers of a test, by name."""

    def __init__(self, folder: str) -> None:
        self.folder = folder
        self.processes = {}

    async def start(self, *names: str) -> None:
        for name in names:
            ready = FORKS.Event()
            process = FORKS.Process(target=be_router, args=(self.folder, name, ready), daemon=True)
            process.start()
            self.processes[name] = process
            assert await asyncio.to_thread(ready.wait, 20)

    def send(self, name: str, number: signal.Signals) -> None:
        os.kill(self.processes[name].pid, number)


@pytest.fixture
def routers(sockets):
    made = Routers(sockets)
    yield made
    for process in made.processes.values():
        process.kill()
        process.join()


@asynccontextmanager
async def client(folder: str, name: str = "") -> AsyncIterator[ZenohBus]:
    bus = ZenohBus(name, endpoints(folder))
    await bus.open()
    try:
        yield bus
    finally:
        await bus.close()


def hear(bus: ZenohBus) -> list[bytes]:
    heard: list[bytes] = []
    bus.subscribe(topics.POSE, topics.POSE.at(), lambda _key, payload: heard.append(payload))
    return heard


async def send_until(bus: ZenohBus, reached, count: int = 1000) -> None:
    """Publish numbers, a hundred a second, until something is so."""
    for number in range(count):
        bus.publish(topics.POSE, topics.POSE.at(), b"%d" % number)
        await asyncio.sleep(0.01)
        if reached():
            return
    raise AssertionError("it did not happen in time")


async def test_what_is_sent_first_arrives(routers, sockets):
    await routers.start(*ROUTERS)
    async with client(sockets) as reader:
        heard = hear(reader)
        await asyncio.sleep(0.2)
        async with client(sockets, "node") as writer:
            writer.publish(topics.POSE, topics.POSE.at(), b"first")
            await eventually(lambda: heard == [b"first"])


@pytest.mark.parametrize("stopped", ROUTERS)
async def test_a_stopped_router_is_not_waited_for(routers, sockets, stopped):
    await routers.start(*ROUTERS)
    routers.send(stopped, signal.SIGSTOP)
    async with client(sockets) as one, client(sockets) as other:
        heard = hear(one)
        await send_until(other, lambda: heard)


async def test_who_starts_before_the_routers_waits_for_one(routers, sockets):
    async with asyncio.TaskGroup() as group:
        group.create_task(routers.start("router_b"))
        async with client(sockets) as one, client(sockets) as other:
            heard = hear(one)
            await send_until(other, lambda: heard)


async def test_without_routers_it_is_told_in_one_line(sockets, monkeypatch):
    monkeypatch.setattr(zenoh_bus, "PATIENCE_S", 0.05)
    with pytest.raises(BusError, match=rf"^no router at \S+{sockets}/router_a or \S+/router_b "
                                       r"\(node talker\)$"):
        await ZenohBus("talker", endpoints(sockets)).open()


async def test_who_connects_and_says_nothing_holds_no_place_for_long(routers, sockets):
    await routers.start("router_a")
    with contextlib.ExitStack() as stack:
        for _ in range(120):  # Zenoh has a hundred places for handshakes
            idle = stack.enter_context(socket.socket(socket.AF_UNIX))
            idle.connect(socket_path(sockets, "router_a"))
        async with client(sockets) as one, client(sockets) as other:
            heard = hear(one)
            await send_until(other, lambda: heard)


async def test_a_second_router_of_a_name_is_refused_in_one_line(routers, sockets):
    await routers.start("router_a")
    with pytest.raises(BusError, match=r"^\S+/router_a is in use by another process \(node "):
        await ZenohBus("router_a", [], [endpoint(sockets, "router_a")]).open()


async def test_when_a_router_dies_all_go_over_to_the_other(routers, sockets):
    await routers.start(*ROUTERS)
    async with client(sockets, "node") as writer, client(sockets) as reader:
        heard = hear(reader)
        for killed in (*ROUTERS, *ROUTERS):
            await send_until(writer, lambda: len(heard) > 20)
            routers.send(killed, signal.SIGKILL)
            await asyncio.sleep(0)
            before = len(heard)
            await send_until(writer, lambda: len(heard) > before + 20)  # noqa: B023 called here
            await routers.start(killed)
            heard.clear()


async def test_who_has_gone_over_to_another_router_knows_it_once(routers, sockets):
    await routers.start(*ROUTERS)
    async with client(sockets, "node") as writer, client(sockets) as reader:
        heard = hear(reader)
        await send_until(writer, lambda: heard)
        assert not reader.moved()
        routers.send("router_a", signal.SIGKILL)
        await eventually(reader.moved)
        heard.clear()
        await send_until(writer, lambda: heard)
        reader.moved()
        assert not reader.moved()
        assert not shared(reader).moved()
        routers.send("router_b", signal.SIGKILL)
        await eventually(reader.moved)
        await asyncio.sleep(0.1)
        assert reader.moved()  # as long as there is none


async def test_when_both_die_all_come_back_to_the_next_ones(routers, sockets):
    await routers.start(*ROUTERS)
    async with client(sockets, "node") as writer, client(sockets) as reader:
        heard = hear(reader)
        await send_until(writer, lambda: heard)
        for name in ROUTERS:
            routers.send(name, signal.SIGKILL)
        await eventually(reader.moved)
        await routers.start(*ROUTERS)
        heard.clear()
        await send_until(writer, lambda: heard)


async def test_numbers_of_one_client_arrive_in_their_sequence_over_a_change(routers, sockets):
    await routers.start(*ROUTERS)
    async with client(sockets) as writer, client(sockets) as reader:
        heard = hear(reader)
        await send_until(writer, lambda: heard)
        heard.clear()
        asyncio.get_running_loop().call_later(
            0.3, routers.send, "router_a", signal.SIGKILL)
        await send_until(writer, lambda: len(heard) > 80)
        assert all(int(one) < int(other) for one, other in pairwise(heard))


async def test_an_actor_that_shares_a_bus_waits_until_that_is_open(routers, sockets):
    bus = ZenohBus("", endpoints(sockets))
    second = shared(bus)
    async with asyncio.TaskGroup() as group:
        opening = group.create_task(second.open())
        group.create_task(bus.open())
        await asyncio.sleep(0.1)
        assert not opening.done()
        await routers.start("router_a")
    heard: list[bytes] = []
    second.subscribe(topics.POSE, topics.POSE.at(), lambda _key, payload: heard.append(payload))
    async with client(sockets) as writer:
        await send_until(writer, lambda: heard)
    await bus.close()


def be_writer(folder: str, ready) -> None:
    """Say one thing, and then hang."""

    async def main() -> None:
        async with client(folder, "hung") as bus:
            bus.publish(topics.GOAL, topics.GOAL.at(), b"of one that hangs")
            await asyncio.sleep(0.2)
            ready.set()
            time.sleep(1000)

    asyncio.run(main())


def ask(bus: ZenohBus) -> list[bytes]:
    answers: list[bytes] = []
    bus.latest(topics.GOAL.at(), lambda _key, payload: answers.append(payload), lambda: None)
    return answers


async def test_who_hangs_tells_what_it_said_last_and_who_is_stopped_is_not_waited_for(
        routers, sockets):
    await routers.start(*ROUTERS)
    ready = FORKS.Event()
    hung = FORKS.Process(target=be_writer, args=(sockets, ready), daemon=True)
    hung.start()
    assert await asyncio.to_thread(ready.wait, 20)
    try:
        async with client(sockets, "node") as writer, client(sockets) as reader:
            writer.publish(topics.GOAL, topics.GOAL.at(), b"of one that works")
            await asyncio.sleep(0.2)  # until the router knows that it can be asked
            answers = ask(reader)
            await eventually(lambda: set(answers) == {b"of one that hangs", b"of one that works"})
            os.kill(hung.pid, signal.SIGSTOP)
            later = ask(reader)
            await eventually(lambda: later == [b"of one that works"], 0.5)
    finally:
        hung.kill()
        hung.join()
    async with client(sockets) as reader:
        last = ask(reader)
        await asyncio.sleep(0.2)
        assert last == []


def be_reader(folder: str, ready) -> None:
    """Hear everything."""

    async def main() -> None:
        async with client(folder) as bus:
            for topic in (topics.POSE, topics.MISSION_ORDER):
                bus.subscribe(topic, topic.at(), lambda _key, _payload: None)
            ready.set()
            await asyncio.sleep(1000)

    asyncio.run(main())


async def test_who_is_stopped_and_reads_no_more_keeps_nobody_else_waiting(routers, sockets):
    await routers.start(*ROUTERS)
    ready = FORKS.Event()
    stopped = FORKS.Process(target=be_reader, args=(sockets, ready), daemon=True)
    stopped.start()
    assert await asyncio.to_thread(ready.wait, 20)
    try:
        async with client(sockets, "node") as writer, client(sockets) as reader:
            heard, order = list[float](), topics.MISSION_ORDER
            reader.subscribe(topics.POSE, topics.POSE.at(), lambda *_: heard.append(
                time.monotonic()))
            os.kill(stopped.pid, signal.SIGSTOP)
            for _ in range(600):  # 6 MB: more than all sockets and queues between them hold
                writer.publish(topics.POSE, topics.POSE.at(), b"x" * 10_000)
                writer.publish(order, order.at(), b"may not be left out")
                await asyncio.sleep(0.005)
            await asyncio.sleep(0.2)
            pauses = [later - earlier for earlier, later in pairwise(heard)]
            assert len(heard) > 500
            assert max(pauses) < 1.0
    finally:
        stopped.kill()
        stopped.join()


async def test_a_newcomer_is_answered_after_all_routers_were_replaced(routers, sockets):
    await routers.start(*ROUTERS)
    async with client(sockets, "node") as writer:
        writer.publish(topics.GOAL, topics.GOAL.at(), b"long ago")
        for name in ROUTERS:
            routers.send(name, signal.SIGKILL)
            await asyncio.sleep(0.1)
            await routers.start(name)
        async with client(sockets) as reader:
            answers: list[bytes] = []

            def asked() -> bool:
                reader.latest(topics.GOAL.at(),
                              lambda _key, payload: answers.append(payload), lambda: None)
                return bool(answers)

            await eventually(asked, 5)
            assert set(answers) == {b"long ago"}
            assert ask(writer) == [], "nobody asks itself"


async def test_a_flood_of_questions_is_answered_in_part(routers, sockets):
    await routers.start("router_a")
    async with client(sockets, "node") as writer, client(sockets) as reader:
        writer.publish(topics.GOAL, topics.GOAL.at(), b"x")
        await asyncio.sleep(0.2)
        answers: list[bytes] = []
        for _ in range(3 * zenoh_bus._ANSWERS_PER_S):
            reader.latest(topics.GOAL.at(),
                          lambda _key, payload: answers.append(payload), lambda: None)
        await asyncio.sleep(0.5)
        assert 0 < len(answers) <= 2 * zenoh_bus._ANSWERS_PER_S


def names_of_threads() -> set[str]:
    return {(task / "comm").read_text().split("-")[0].strip()
            for task in Path("/proc/self/task").iterdir()}


def tell_threads(folder: str, told) -> None:
    """Open a client and tell of its threads, which name themselves a moment after they began."""

    async def main() -> None:
        async with client(folder):
            with contextlib.suppress(AssertionError):
                await eventually(lambda: {"app", "tx"} <= names_of_threads())
            told.put((names_of_threads(), "ZENOH_RUNTIME" in os.environ))

    asyncio.run(main())


async def test_a_client_reads_on_one_thread_and_writes_on_another_and_no_command_inherits_that(
        routers):
    await routers.start("router_a")
    told = FORKS.SimpleQueue()
    process = FORKS.Process(target=tell_threads, args=(routers.folder, told), daemon=True)
    process.start()

    threads, is_inherited = await asyncio.to_thread(told.get)
    await asyncio.to_thread(process.join, 20)

    assert {"app", "tx"} <= threads
    assert threads.isdisjoint({"rx", "net", "acc"})
    assert not is_inherited
