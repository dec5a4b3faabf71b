"""The bus over Zenoh: what becomes of a reader that gets more than it can handle."""

from __future__ import annotations

import asyncio
import subprocess
import sys
import time
from functools import partial
from itertools import pairwise

import pytest
import zenoh

from rampart.actors.bus import run_folder
from rampart.actors.bus.bus import BusError
from rampart.actors.bus.zenoh_bus import ZenohBus
from rampart.actors.bus.zenoh_session import endpoints, open_client
from rampart.actors.ftm import topics
from rampart.actors.machine.unix_peer import ProcessId, process_id
from rampart.testing import eventually

MANY = 1500


async def test_who_is_flooded_gets_round_to_its_timers(bus_folder):
    reader = ZenohBus("reader", 1, endpoints(bus_folder))
    await reader.open()
    heard, begun = [], asyncio.Event()

    def slow(_key: str, payload: bytes) -> None:
        heard.append(payload)
        begun.set()
        time.sleep(0.001)  # busy: it is nobody else's turn

    reader.subscribe(topics.DETECTION, topics.DETECTION.at("DM1"), slow)
    with open_client(endpoints(bus_folder)) as member:
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


def _sleeper() -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])


async def test_a_watcher_has_the_end_of_a_process_from_the_kernel(bus_folder):
    """Its liveliness token is still there: as if its router were the last to know."""
    watcher = ZenohBus("watcher", 1, endpoints(bus_folder),
                       process_of=partial(run_folder.process_of, bus_folder))
    await watcher.open()
    seen: list[tuple[int, bool]] = []
    with open_client(endpoints(bus_folder)) as member, _sleeper() as first, _sleeper() as second:
        run_folder.issue(bus_folder, ["worker"], 3, process_id(first.pid))
        watcher.watch("worker", lambda _node, incarnation, alive: seen.append((incarnation, alive)))
        tokens = [member.liveliness().declare_token("rampart/alive/worker/3")]
        await eventually(lambda: seen == [(3, True)])
        first.kill()
        await eventually(lambda: seen == [(3, True), (3, False)], 0.5)
        run_folder.issue(bus_folder, ["worker"], 4, ProcessId(second.pid, 1))  # another's number
        tokens.append(member.liveliness().declare_token("rampart/alive/worker/4"))
        await eventually(lambda: seen[2:] == [(4, True)])
        second.kill()
        await asyncio.sleep(0.2)
        assert seen[3:] == [], "a process was taken for one that had its number before"
        tokens[1].undeclare()
        await eventually(lambda: seen[3:] == [(4, False)])
    await watcher.close()


async def test_what_is_forgotten_is_heard_and_answered_no_more(bus_folder):
    bus = ZenohBus("one", 1, endpoints(bus_folder))
    await bus.open()
    heard: list[bytes] = []
    bus.subscribe(topics.DETECTION, topics.DETECTION.at("DM1"), lambda _key, it: heard.append(it))
    bus.publish(topics.DETECTION, topics.DETECTION.at("DM1"), b"before")
    await eventually(lambda: heard == [b"before"])
    bus.forget()
    with open_client(endpoints(bus_folder)) as member:
        member.put(topics.DETECTION.at("DM1"), b"after")
        answers = [reply.ok for reply in await asyncio.to_thread(
            lambda: list(member.get(topics.DETECTION.at("DM1"), timeout=1.0)))]
    await asyncio.sleep(0.1)
    assert (heard, answers) == ([b"before"], [])
    await bus.close()


async def test_a_session_that_cannot_be_opened_says_why(monkeypatch):
    def fail(*_: object) -> None:
        raise zenoh.ZError("no memory left")

    monkeypatch.setattr(zenoh, "open", fail)
    with pytest.raises(BusError, match=r"\(node one\): no memory left"):
        await ZenohBus("one", 1, []).open()
