"""The bus over Zenoh: a client connects to one router and changes to the other when it dies."""

import asyncio
import contextlib
import multiprocessing
import os
import re
import signal
import socket
import time
from contextlib import asynccontextmanager
from itertools import pairwise
from pathlib import Path

import pytest
import zenoh

from rampart.actors.bus import zenoh_bus
from rampart.actors.bus.board import FileBoard
from rampart.actors.bus.bus import Bus, BusError, shared
from rampart.actors.bus.run_folder import ROUTERS
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.bus.zenoh_session import endpoint, endpoints, open_session
from rampart.actors.ftm import topics as ftm_topics
from rampart.actors.osmosis import topics
from rampart.testing import eventually

FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload([__name__])  # a fresh process without a session
pytestmark = pytest.mark.alone


def be_router(folder: str, name: str, ready) -> None:
    """Run a router in a separate process."""

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
async def client(folder: str, name: str = ""):
    bus = ZenohBus(name, endpoints(folder))
    await bus.open()
    try:
        yield bus
    finally:
        await bus.close()


def hear(bus: Bus) -> list[bytes]:
    heard: list[bytes] = []
    bus.subscribe(topics.POSE.at(), lambda _key, payload: heard.append(payload))
    return heard


async def send_until(bus: ZenohBus, reached, count: int = 1000) -> None:
    """Publish numbers, a hundred a second, until something is so."""
    for number in range(count):
        bus.publish(topics.POSE, topics.POSE.at(), b"%d" % number)
        await asyncio.sleep(0.01)
        if reached():
            return
    raise AssertionError("it did not happen in time")


@pytest.mark.parametrize("stopped", ROUTERS)
async def test_a_stopped_router_is_not_waited_for(routers, sockets, stopped):
    await routers.start(*ROUTERS)
    routers.send(stopped, signal.SIGSTOP)
    async with client(sockets) as one, client(sockets) as other:
        heard = hear(one)
        await send_until(other, lambda: heard)


async def test_without_routers_each_actor_that_shares_the_bus_fails_with_one_line(
        sockets, monkeypatch):
    monkeypatch.setattr(zenoh_bus, "PATIENCE_S", 0.05)
    bus = ZenohBus("observer", endpoints(sockets))
    async with asyncio.timeout(5):
        found = await asyncio.gather(bus.open(), shared(bus).open(), return_exceptions=True)
    assert [type(error) for error in found] == [BusError, BusError]
    assert re.fullmatch(rf"no router at \S+{sockets}/router_a or \S+/router_b \(node observer\)",
                        str(found[0]))


async def test_a_silent_connection_blocks_the_router_only_briefly(routers, sockets):
    await routers.start("router_a")
    with contextlib.ExitStack() as stack:
        for _ in range(120):  # Zenoh has a hundred places for handshakes
            idle = stack.enter_context(socket.socket(socket.AF_UNIX))
            idle.connect(f"{sockets}/router_a")
        async with client(sockets) as one, client(sockets) as other:
            heard = hear(one)
            await send_until(other, lambda: heard)


async def test_a_second_router_of_a_name_is_refused_in_one_line(routers, sockets):
    await routers.start("router_a")
    with pytest.raises(BusError, match=r"^\S+/router_a is in use by another process \(node "):
        await ZenohBus("router_a", [], [endpoint(sockets, "router_a")]).open()


async def test_clients_of_a_dead_router_change_to_the_other_and_messages_stay_in_sequence(
        routers, sockets):
    await routers.start(*ROUTERS)
    async with client(sockets, "node") as writer, client(sockets) as reader:
        heard = hear(reader)
        for killed in ROUTERS:
            asyncio.get_running_loop().call_later(0.2, routers.send, killed, signal.SIGKILL)
            await send_until(writer, lambda: len(heard) > 60)
            assert all(int(one) < int(other) for one, other in pairwise(heard))
            await routers.start(killed)
            heard.clear()


async def test_a_client_notices_a_change_of_router_once_posts_nothing_without_one_and_returns(
        routers, sockets, tmp_path):
    """Without one it is deaf; what it posted would show others that it is well."""
    await routers.start(*ROUTERS)
    async with client(sockets, "node") as writer, client(sockets) as reader:
        writer.take_name("node", None, FileBoard(str(tmp_path)))
        heard = hear(reader)
        await send_until(writer, lambda: heard)
        assert writer.post("a", b"1")
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
        await eventually(lambda: not writer.post("a", b"2"))
        await routers.start(*ROUTERS)
        heard.clear()
        await send_until(writer, lambda: heard)
        await eventually(lambda: writer.post("a", b"3"))
        assert writer.posted("a") == b"3"


async def test_an_actor_that_shares_a_bus_waits_until_that_is_open(routers, sockets):
    bus = ZenohBus("", endpoints(sockets))
    second = shared(bus)
    async with asyncio.TaskGroup() as group:
        opening = group.create_task(second.open())
        group.create_task(bus.open())
        await asyncio.sleep(0.1)
        assert not opening.done()
        await routers.start("router_a")
    heard = hear(second)
    async with client(sockets) as writer:
        await send_until(writer, lambda: heard)
    await bus.close()


def be_client(folder: str, ready) -> None:
    """Publish one message, subscribe to two topics, and then hang."""

    async def main() -> None:
        async with client(folder, "hung") as bus:
            for topic in (topics.POSE, topics.MISSION_ORDER):
                bus.subscribe(topic.at(), lambda _key, _payload: None)
            bus.publish(topics.GOAL, topics.GOAL.at(), b"from the hung client")
            await asyncio.sleep(0.2)
            ready.set()
            time.sleep(1000)

    asyncio.run(main())


@asynccontextmanager
async def hung_client(folder: str):
    """Have a client that hangs; yields the id of its process."""
    ready = FORKS.Event()
    hung = FORKS.Process(target=be_client, args=(folder, ready), daemon=True)
    hung.start()
    assert await asyncio.to_thread(ready.wait, 20)
    try:
        yield hung.pid
    finally:
        hung.kill()
        hung.join()


def ask(bus: ZenohBus) -> list[bytes]:
    answers: list[bytes] = []
    bus.latest(topics.GOAL.at(), lambda _key, payload: answers.append(payload), lambda: None)
    return answers


async def test_a_hung_client_answers_a_query_and_a_stopped_one_does_not_delay_it(
        routers, sockets):
    await routers.start(*ROUTERS)
    async with (hung_client(sockets) as hung, client(sockets, "node") as writer,
                client(sockets) as reader):
        writer.publish(topics.GOAL, topics.GOAL.at(), b"from the working client")
        await asyncio.sleep(0.2)  # until the router knows that it can be asked
        answers = ask(reader)
        both = {b"from the hung client", b"from the working client"}
        await eventually(lambda: set(answers) == both)
        os.kill(hung, signal.SIGSTOP)
        await eventually(lambda: all(  # it stops thread by thread, and a running thread answers
            thread.read_text().rpartition(") ")[2].startswith("T")
            for thread in Path(f"/proc/{hung}/task").glob("*/stat")))
        later, over = list[bytes](), list[bool]()
        reader.latest(topics.GOAL.at(), lambda _key, payload: later.append(payload),
                      lambda: over.append(True))
        await eventually(lambda: later)
        assert (later, over) == ([b"from the working client"], [])
        assert ask(writer) == [], "a client does not query itself"


async def test_a_stopped_reader_delays_no_other_reader(routers, sockets):
    await routers.start(*ROUTERS)
    async with (hung_client(sockets) as hung, client(sockets, "node") as writer,
                client(sockets) as reader):
        heard, order = list[float](), topics.MISSION_ORDER
        reader.subscribe(topics.POSE.at(), lambda *_: heard.append(time.monotonic()))
        os.kill(hung, signal.SIGSTOP)
        for _ in range(600):  # 6 MB: more than all sockets and queues between them hold
            writer.publish(topics.POSE, topics.POSE.at(), b"x" * 10_000)
            writer.publish(order, order.at(), b"may not be left out")
            await asyncio.sleep(0.005)
        await asyncio.sleep(0.2)
        assert len(heard) > 500
        assert max(later - earlier for earlier, later in pairwise(heard)) < 1.0


async def test_a_newcomer_is_answered_after_all_routers_were_replaced(routers, sockets):
    await routers.start(*ROUTERS)
    async with client(sockets, "node") as writer:
        writer.publish(topics.GOAL, topics.GOAL.at(), b"long ago")
        for name in ROUTERS:
            routers.send(name, signal.SIGKILL)
            await asyncio.sleep(0.1)
            await routers.start(name)
        async with client(sockets) as reader:
            answers: list[list[bytes]] = []

            def asked() -> bool:
                answers.append(ask(reader))
                return [b"long ago"] in answers

            await eventually(asked, 5)


async def test_a_flood_of_questions_is_answered_in_part(routers, sockets):
    await routers.start("router_a")
    async with client(sockets, "node") as writer, client(sockets) as reader:
        writer.publish(topics.GOAL, topics.GOAL.at(), b"x")
        await asyncio.sleep(0.2)
        answers = [ask(reader) for _ in range(3 * zenoh_bus._ANSWERS_PER_S)]
        await asyncio.sleep(0.5)
        assert 0 < sum(map(len, answers)) <= 2 * zenoh_bus._ANSWERS_PER_S


# -- the bus over Zenoh: floods, errors of deliveries, and sessions that cannot be opened


MANY = 1500


async def test_a_flooded_reader_still_runs_its_timers(bus_folder):
    reader = ZenohBus("reader", endpoints(bus_folder))
    await reader.open()
    heard, begun = [], asyncio.Event()

    def slow(_key: str, payload: bytes) -> None:
        heard.append(payload)
        begun.set()
        time.sleep(0.001)  # blocks the loop

    reader.subscribe(ftm_topics.DETECTION.at("DM1"), slow)
    with open_session(endpoints(bus_folder)) as member:
        flood = member.declare_publisher(ftm_topics.DETECTION.at("DM1"),
                                         congestion_control=zenoh.CongestionControl.BLOCK)

        def say() -> None:
            for _ in range(MANY):
                flood.put(b"x")

        await asyncio.sleep(0.1)  # the subscription is known
        saying = asyncio.create_task(asyncio.to_thread(say))
        await begun.wait()
        turns = []
        while len(heard) < MANY and len(turns) < 10_000:
            turns.append(len(heard))
            await asyncio.sleep(0.001)
        await saying
    await reader.close()
    assert max(later - one for one, later in pairwise([*turns, MANY])) <= MANY / 2


async def test_a_session_that_cannot_be_opened_reports_the_reason(monkeypatch):
    def fail(*_: object) -> None:
        raise zenoh.ZError("no memory left")

    monkeypatch.setattr(zenoh, "open", fail)
    with pytest.raises(BusError, match=r"\(node one\): no memory left"):
        await ZenohBus("one", []).open()


async def test_a_delivery_that_raises_keeps_no_other_message_back(bus_folder):
    errors, received = [], []
    asyncio.get_running_loop().set_exception_handler(lambda _loop, told: errors.append(told))
    reader, writer = (ZenohBus(name, endpoints(bus_folder)) for name in ("reader", "writer"))
    await reader.open()
    await writer.open()

    def deliver(_key: str, payload: bytes) -> None:
        received.append(payload)
        time.sleep(0.1)  # the others arrive meanwhile
        if payload == b"0":
            raise ZeroDivisionError

    key = ftm_topics.DETECTION.at("DM1")
    reader.subscribe(key, deliver)
    await asyncio.sleep(0.2)  # the subscription is known
    for number in range(3):
        writer.publish(ftm_topics.DETECTION, key, b"%d" % number)
    await eventually(lambda: received == [b"0", b"1", b"2"])
    assert len(errors) == 1
    await reader.close()
    await writer.close()
