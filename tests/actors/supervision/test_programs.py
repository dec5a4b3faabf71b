"""The end of a command's program, reported by its node's process, which stays."""

from __future__ import annotations

import asyncio
from functools import partial

from rampart.actors.bus.envelope import decode
from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import ProgramEnd
from rampart.testing import eventually
from tests.actors.supervision.test_supervisor import World, running
from tests.virtual_time import within

OWN, ARBITRATED = "of_supervisor", "of_RM4"
"""Restarted by the supervisor itself, and on the request of a recovery module."""

restarted, arbitrated = (partial(running, commands=[one]) for one in ("supervisor", "RM4"))

REASON = "./it ended: exit code 3"


class Node:
    """The process of a command's node, which starts its program when it reads "respawned"."""

    def __init__(self, world: World, name: str) -> None:
        self.world, self.name = world, name
        (self.process,) = world.machine.of(name)
        self.is_deaf = False
        self.starts: list[int] = []
        world.hub.taps.append(self._see)

    def end_program(self) -> None:
        """Report the end of its program."""
        self.world.silent.add(self.process.pid)
        self.world.say(topics.PROGRAM_END, ProgramEnd(self.process.pid, REASON),
                       self.name, incarnation=self.process.incarnation)

    def _see(self, _now_s: float, _source: str, key: str, payload: bytes) -> None:
        if key != topics.PROCESS_EVENT.at() or self.is_deaf:
            return
        event = decode(topics.PROCESS_EVENT, payload)[1]
        if (event.node, event.event, event.pid) == (self.name, "respawned", self.process.pid) \
                and event.incarnation > self.process.incarnation:
            self.process.incarnation = event.incarnation
            self.world.machine.issued[self.name] = event.incarnation
            self.starts.append(event.incarnation)
            self.world.silent.discard(self.process.pid)


@within(restarted)
async def test_a_program_that_ends_is_the_next_incarnation_in_the_same_process_at_once(world):
    node, tables = Node(world, OWN), []
    world.hub.taps.append(lambda _now, _source, key, payload: tables.append(
        decode(topics.NODES, payload)[1]) if key == topics.NODES.at() else None)
    for incarnation in (2, 3):
        world.events.clear()
        node.end_program()
        await eventually(lambda n=incarnation: node.starts[-1:] == [n], 0.01)
        await eventually(lambda n=incarnation: world.row(OWN) == (
            "running", n, node.process.pid))
        assert [event for name, event, _ in world.events if name == OWN] == [
            "crashed", "respawned", "running"]
    assert world.machine.forks == []
    assert not node.process.killed
    rows = {row.name: row for row in tables[-1].nodes}
    assert (rows[OWN].incarnation, rows[OWN].restarts) == (3, 2)


@within(arbitrated)
async def test_a_node_of_a_recovery_module_waits_for_its_request(world):
    node = Node(world, ARBITRATED)
    node.end_program()
    for _ in range(20):  # it repeats that
        await asyncio.sleep(0.1)
        node.end_program()
    assert node.starts == []
    assert world.row(ARBITRATED)[0] == "crashed"
    world.respawn(ARBITRATED, 1)
    await eventually(lambda: world.row(ARBITRATED) == ("running", 2, node.process.pid))
    assert node.starts == [2]
    assert world.machine.forks == []
    assert [event for event in world.events if event[1] == "crashed"] == [
        (ARBITRATED, "crashed", 1)]


@within(arbitrated)
async def test_a_process_that_dies_while_its_program_is_down_is_replaced(world):
    node = Node(world, ARBITRATED)
    node.end_program()
    await asyncio.sleep(0.1)
    world.kill(ARBITRATED)
    await asyncio.sleep(0.1)
    assert world.machine.forks == []
    world.respawn(ARBITRATED, 1)
    await eventually(lambda: world.row(ARBITRATED)[:2] == ("running", 2))
    assert world.machine.forks == [(ARBITRATED, 2)]


@within(restarted)
async def test_a_node_that_has_missed_its_respawn_reads_it_when_it_reports_again(world):
    node = Node(world, OWN)
    node.is_deaf = True
    node.end_program()
    await asyncio.sleep(0.2)
    node.is_deaf = False
    node.end_program()
    await eventually(lambda: world.row(OWN) == ("running", 2, node.process.pid), 0.2)
    assert node.starts == [2]


@within(restarted)
async def test_a_node_that_does_not_start_its_program_is_replaced(world):
    node = Node(world, OWN)
    node.is_deaf = True
    node.end_program()
    await eventually(lambda: world.row(OWN)[:2] == ("running", 3), 10.0)
    assert node.process.killed
    assert world.machine.forks == [(OWN, 3)]


@within(restarted)
async def test_a_new_supervisor_takes_the_end_from_its_repetition(world):
    node = Node(world, OWN)
    await world.replace_supervisor(node.end_program, **{OWN: 1})
    await asyncio.sleep(0.1)
    node.end_program()
    await eventually(lambda: world.row(OWN) == ("running", 2, node.process.pid), 0.2)
    assert world.machine.forks == []


@within(restarted)
async def test_the_end_of_another_process_or_from_a_stranger_is_nothing(world):
    node = Node(world, OWN)
    for pid, source in ((999_999, OWN), (node.process.pid, "tester")):
        world.say(topics.PROGRAM_END, ProgramEnd(pid, REASON), source)
        await asyncio.sleep(0.1)
    assert world.row(OWN) == ("running", 1, node.process.pid)
    assert node.starts == []
