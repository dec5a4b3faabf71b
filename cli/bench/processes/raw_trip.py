"""A round trip over Zenoh without actors: the floor of the one between two actors.

    raw_trip.py router OWN OTHER
    raw_trip.py answerer ROUTER ROUTER
    raw_trip.py asker ROUTER ROUTER

As in a system, there are two linked routers, and two clients, each an asyncio loop in a process.
The asker prints how long each round trip took, seconds. All end when their stdin closes.
"""

from __future__ import annotations

import asyncio
import sys
import time
from collections.abc import Callable

import zenoh

from rampart.actors.bus.zenoh_session import session_config
from rampart.cli.bench.actors import PING_HZ
from rampart.cli.bench.processes.observer import joined

_BYTES = 40
"""Of a message, about as many as that of the actors has."""


def _joined(session: zenoh.Session, hears: str, says: str,
            arrived: Callable[[bytes], None]) -> zenoh.Publisher:
    """Have what comes on one key handed to the loop, and return the publisher of the other.

    It is sent as samples of sensors are.
    """
    loop = asyncio.get_running_loop()
    session.declare_subscriber(
        hears, lambda sample: loop.call_soon_threadsafe(arrived, sample.payload.to_bytes()))
    return session.declare_publisher(
        says, priority=zenoh.Priority.DATA, congestion_control=zenoh.CongestionControl.DROP,
        express=True)


async def answer(session: zenoh.Session) -> None:
    """Send back what comes."""
    def arrived(payload: bytes) -> None:
        publisher.put(payload)

    publisher = _joined(session, "raw/ping", "raw/pong", arrived)
    await _closed()


async def ask(session: zenoh.Session) -> None:
    """Ask as often as the actor does, and print how long each answer took."""
    number, asked_s = 0, 0.0

    def arrived(payload: bytes) -> None:
        took_s = time.monotonic() - asked_s
        if payload == number.to_bytes(_BYTES):
            print(took_s, flush=True)

    publisher = _joined(session, "raw/pong", "raw/ping", arrived)
    closed = asyncio.ensure_future(_closed())
    while not closed.done():
        await asyncio.sleep(1 / PING_HZ)
        number += 1
        asked_s = time.monotonic()
        publisher.put(number.to_bytes(_BYTES))


async def _closed() -> None:
    reader = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(
        lambda: asyncio.StreamReaderProtocol(reader), sys.stdin)
    await reader.read()


async def main(role: str, first: str, second: str) -> None:
    """Play a role until stdin closes."""
    with (zenoh.open(session_config([first], [second])) if role == "router"
          else joined([first, second])) as session:
        print("ready", flush=True)
        await {"router": lambda _: _closed(), "answerer": answer, "asker": ask}[role](session)


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
