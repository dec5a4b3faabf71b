"""The bus over Zenoh: floods, errors of deliveries, and sessions that cannot be opened."""

from __future__ import annotations

import asyncio
import time
from itertools import pairwise

import pytest
import zenoh

from rampart.actors.bus.bus import BusError
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.bus.zenoh_session import endpoints, open_session
from rampart.actors.ftm import topics
from rampart.testing import eventually

MANY = 1500


async def test_a_flooded_reader_still_runs_its_timers(bus_folder):
    reader = ZenohBus("reader", endpoints(bus_folder))
    await reader.open()
    heard, begun = [], asyncio.Event()

    def slow(_key: str, payload: bytes) -> None:
        heard.append(payload)
        begun.set()
        time.sleep(0.001)  # blocks the loop

    reader.subscribe(topics.DETECTION.at("DM1"), slow)
    with open_session(endpoints(bus_folder)) as member:
        flood = member.declare_publisher(topics.DETECTION.at("DM1"),
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

    key = topics.DETECTION.at("DM1")
    reader.subscribe(key, deliver)
    await asyncio.sleep(0.2)  # the subscription is known
    for number in range(3):
        writer.publish(topics.DETECTION, key, b"%d" % number)
    await eventually(lambda: received == [b"0", b"1", b"2"])
    assert len(errors) == 1
    await reader.close()
    await writer.close()
