"""Opening a session: nobody's start waits for a partner that does not answer."""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import os
import signal
import socket
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from rampart.actors.bus.run_folder import socket_path
from rampart.actors.bus.zenoh_bus import ZenohBus, endpoint
from rampart.actors.osmosis import topics
from rampart.testing import eventually

FORK = multiprocessing.get_context("spawn")


def live(folder: str, name: str, ready) -> None:
    """Be a partner, in a process of its own, that sends when it is linked."""

    async def main() -> None:
        bus = ZenohBus(name, 1, endpoint(folder, name), [])
        await bus.open()
        ready.set()
        while True:
            bus.publish(topics.POSE, topics.POSE.at(), name.encode())
            await asyncio.sleep(0.02)

    asyncio.run(main())


@contextmanager
def partners(folder: str, *names: str) -> Iterator[list[int]]:
    """Have partners in processes of their own; yields their pids."""
    processes = []
    try:
        for name in names:
            ready = FORK.Event()
            process = FORK.Process(target=live, args=(folder, name, ready), daemon=True)
            process.start()
            processes.append(process)
            assert ready.wait(20)
        yield [p.pid for p in processes]
    finally:
        for process in processes:
            process.kill()
            process.join()


@contextlib.asynccontextmanager
async def newcomer(folder: str, *dial: str):
    """A session that dials; yields what it hears."""
    bus, heard = ZenohBus("newcomer", 1, endpoint(folder, "newcomer"),
                          [endpoint(folder, name) for name in dial]), []
    await bus.open()
    bus.subscribe(topics.POSE, topics.POSE.at(), lambda _key, payload: heard.append(payload))
    try:
        yield heard
    finally:
        await bus.close()


async def hears(heard: list[bytes], name: bytes) -> None:
    await eventually(lambda: name in heard, 20, f"{name!r} was not heard")


async def test_a_stopped_partner_is_not_waited_for_and_linked_when_it_goes_on(sockets):
    with partners(sockets, "stopped", "running") as (pid, _):
        os.kill(pid, signal.SIGSTOP)
        async with newcomer(sockets, "stopped", "running") as heard:
            await hears(heard, b"running")
            assert b"stopped" not in heard  # so `open` came back before that answered
            os.kill(pid, signal.SIGCONT)
            await hears(heard, b"stopped")


async def test_a_partner_that_is_not_there_is_linked_when_it_comes(sockets):
    async with newcomer(sockets, "late") as heard:
        with partners(sockets, "late"):  # it dials nobody: a newcomer goes on trying
            await hears(heard, b"late")


async def test_who_connects_and_says_nothing_holds_no_place_for_long(sockets):
    with partners(sockets, "flooded"), contextlib.ExitStack() as stack:
        for _ in range(120):  # Zenoh has a hundred places for handshakes
            idle = stack.enter_context(socket.socket(socket.AF_UNIX))
            idle.connect(socket_path(sockets, "flooded"))
        async with newcomer(sockets, "flooded") as heard:
            await hears(heard, b"flooded")


@pytest.mark.parametrize("count", [0, 3])
async def test_who_is_there_is_linked_when_the_session_is_open(sockets, count):
    names = [f"partner{i}" for i in range(count)]
    with partners(sockets, *names):
        bus = ZenohBus("newcomer", 1, endpoint(sockets, "newcomer"),
                       [endpoint(sockets, name) for name in (*names, "absent")])
        await bus.open()
        linked = len(bus._require().info.peers_zid())
        await bus.close()
    assert linked == count
