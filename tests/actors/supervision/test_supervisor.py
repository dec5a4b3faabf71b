"""The supervisor's decisions, on a machine that is played: what happens when is exact here."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import json
import os
import sys
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise

import msgspec
import pytest

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.envelope import decode
from rampart.actors.bus.messages import Heartbeat
from rampart.actors.ftm import messages as m
from rampart.actors.ftm import topics
from rampart.actors.machine.patience import AT_LEISURE, Patience, Usage
from rampart.actors.osmosis.control.pilot.safety_pilot import SafetyPilot
from rampart.actors.runtime.actor import Actor
from rampart.actors.runtime.run_context import RunContext
from rampart.actors.runtime.run_plan import SUPERVISOR, RunPlan, load_document, load_system
from rampart.actors.supervision.processes import Answer, ProcessHandle, RunProcess
from rampart.actors.supervision.supervised_process import (
    MOST_EXCUSED_S,
    START_TIMEOUT_S,
    STATUS,
    Event,
    Lives,
    RestartPolicy,
    State,
    SupervisedProcess,
)
from rampart.actors.system.layout import Layout, Unit, adapted_system
from rampart.manager.spec.adaptation import Action, Change, adapt
from rampart.manager.spec.nodes import Kind, NodeSpec, RestartLimits
from rampart.manager.spec.tables import Supervision
from rampart.sim.campaign.job import Job, run_virtually
from rampart.sim.faults.scenario import parse_fault
from rampart.testing import VirtualSystem, eventually, turns
from tests import ROOT
from tests.two_hosts import two_hosts
from tests.virtual_time import within
from tests.whole.missions import write_mission

PLAN = RunPlan("r", 20000, system_file=str(ROOT / "systems" / "paper.toml"))
USUAL = Supervision()


@dataclass
class Process:
    """One process; without its port it never says anything and soon ends."""

    names: tuple[str, ...]
    incarnation: int
    pid: int
    bound: bool
    killed: bool = False
    gone: bool = False
    holders: list[Callable[[], None]] = field(default_factory=list)


class Handle(ProcessHandle):
    def __init__(self, machine: Machine, process: Process, ended: Callable[[], None]) -> None:
        self._machine, self._process, self._ended = machine, process, ended
        process.holders.append(ended)

    def kill(self) -> None:
        self._machine.kill(self._process)

    def gone(self) -> bool:
        self._machine.questions += 1
        return self._process.gone

    def usage(self) -> Usage:
        return self._machine.usage(self._process)

    def ignore(self) -> None:
        if self._ended in self._process.holders:
            self._process.holders.remove(self._ended)

    close = ignore


class Machine:
    """`Processes` on which forks and holds fail when a test says so."""

    has_routers = False

    def __init__(self) -> None:
        self.processes: dict[int, Process] = {}
        self.forks: list[tuple[str, int]] = []
        self.issued: dict[str, int] = {}
        self.fork_error: Exception | str | None = None
        self.is_slow = False
        self.waiting: list[Callable[[], None]] = []
        self.hold_error: Exception | None = None
        self.sick: set[str] = set()  # a new process of these is never heard, and ends
        self.starves_from_s: dict[str, float] = {}
        self.turning = False
        self.questions = 0
        self.ends_after_s = 0.005  # from a SIGKILL until the last thread has let go of the port

    def usage(self, process: Process) -> Usage:
        now_s = asyncio.get_running_loop().time()
        return Usage("S", 1.0 + now_s / 100 if self.turning else 1.0,
                     now_s - self.starves_from_s.get(process.names[0], now_s))

    def add(self, names: tuple[str, ...], incarnation: int, *, bound: bool = False) -> Process:
        self.issued |= dict.fromkeys(names, incarnation)
        bound = not self.sick.intersection(names) and (bound or not any(
            p.names == names and not p.gone for p in self.processes.values()))
        pid = 1000 + len(self.processes)
        process = self.processes[pid] = Process(names, incarnation, pid, bound)
        if not bound:
            asyncio.get_running_loop().call_later(0.03, self.kill, process)
        return process

    def of(self, name: str) -> list[Process]:
        return [p for p in self.processes.values() if name in p.names and not p.killed]

    def kill(self, process: Process) -> None:
        if not process.killed:
            process.killed = True
            asyncio.get_running_loop().call_later(self.ends_after_s, self._exited, process)

    def _exited(self, process: Process) -> None:
        process.gone = True
        for ended in list(process.holders):
            ended()

    def living(self) -> list[RunProcess]:
        return [RunProcess(p.pid, 0, 0, p.names, p.incarnation)
                for p in self.processes.values() if not p.killed]

    def fork(self, names: tuple[str, ...], incarnation: int, answer: Answer) -> None:
        if self.is_slow:
            self.waiting.append(lambda: self.fork(names, incarnation, answer))
            return
        if isinstance(self.fork_error, str):
            answer(0, self.fork_error)
            return
        if self.fork_error:
            raise self.fork_error
        self.forks.append((names[0], incarnation))
        answer(self.add(names, incarnation).pid, "")

    def hold(self, pid: int, ended: Callable[[], None]) -> Handle:
        if self.hold_error:
            raise self.hold_error
        process = self.processes.get(pid)
        if process is None or process.gone:
            raise ProcessLookupError(pid)
        return Handle(self, process, ended)

    def adapt(self, adapted: m.AdaptedSystem) -> None:
        pass


class World:
    """A supervisor, its machine, and the bus between them."""

    def __init__(self, supervision: Supervision, commands: Sequence[str] = ()) -> None:
        spec = load_system(PLAN)
        self.spec = msgspec.structs.replace(spec, supervision=supervision, nodes=(
            *spec.nodes, *(NodeSpec(f"of_{respawn}", Kind.NON_CONTROL, respawn=respawn,
                                    command=("true",)) for respawn in commands)))
        self.system = VirtualSystem(RunContext(PLAN, self.spec), Layout(PLAN, self.spec))
        self.machine = Machine()
        self.system.register = self.machine.issued.get
        self.clock, self.hub, self.say = self.system.clock, self.system.hub, self.system.say
        self.events: list[tuple[str, str, int]] = []
        self.silent: set[int] = set()
        self.failing: set[str] = set()
        self.hub.taps.append(self.see)
        self.start()

    def start(self, **known: int) -> None:
        """Start the supervisor, or its replacement, which knows incarnations of nodes."""
        self.system.run = RunContext(PLAN, self.spec, known_incarnations=known)
        self.supervisor = self.system.start_node(SUPERVISOR, self.machine)

    async def replace_supervisor(self, meanwhile: Callable[[], object], **known: int) -> None:
        """End the supervisor, and start another one after something has happened."""
        task = self.system.tasks.pop(SUPERVISOR)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        meanwhile()
        self.start(**known)

    def see(self, _now_s: float, _source: str, key: str, payload: bytes) -> None:
        if key == topics.PROCESS_EVENT.at():
            event = decode(topics.PROCESS_EVENT, payload)[1]
            self.events.append((event.node, event.event, event.incarnation))
        elif key == topics.NODES.at():
            self.failing = {row.name for row in decode(topics.NODES, payload)[1].nodes
                            if row.failing}

    def beat(self, process: Process) -> None:
        for name in process.names:
            self.say(bus_topics.HEARTBEAT, Heartbeat(process.pid, 0, 0.1, 0, 0), name,
                     incarnation=process.incarnation)

    async def beats(self) -> None:
        while True:
            for process in self.machine.processes.values():
                if process.bound and not process.killed and process.pid not in self.silent:
                    self.beat(process)
            await asyncio.sleep(0.1)

    def row(self, name: str) -> tuple[str, int, int]:
        process = self.supervisor._processes[name]
        return process.shown.value, process.incarnation, process.pid

    def all_run(self) -> bool:
        return all(p.shown is m.NodeState.RUNNING for p in self.supervisor._processes.values())

    def kill(self, name: str) -> Process:
        (process,) = self.machine.of(name)
        self.machine.kill(process)
        return process

    def respawn(self, name: str, failed: int) -> None:
        self.say(topics.RESPAWN, m.RespawnRequest(1, name, failed, "RM7"))


@asynccontextmanager
async def running(supervision: Supervision = USUAL,
                  commands: Sequence[str] = ()) -> AsyncIterator[World]:
    world = World(supervision, commands)
    async with world.system:
        beats = asyncio.create_task(world.beats())
        await eventually(world.all_run)
        world.machine.forks.clear()
        yield world
        beats.cancel()


@pytest.mark.parametrize("mute", [False, True])
@within(running)
async def test_a_supervisor_that_fails_ends_nobody_and_its_next_life_adopts_all(world, mute):
    before = set(world.machine.processes)
    killed = world.kill("DM1")
    world.machine.fork_error = RuntimeError("a defect")
    if mute:  # it cannot say that it failed, either
        def publish(*_: object) -> None:
            raise RuntimeError("no bus")
        world.supervisor.context.bus.publish = publish
    with contextlib.suppress(RuntimeError):
        await world.system.tasks[SUPERVISOR]
    assert set(world.machine.processes) - {killed.pid} == {
        p.pid for p in world.machine.processes.values() if not p.killed}
    world.machine.fork_error = None
    world.start()
    await eventually(world.all_run)
    after = {p.pid for p in world.machine.processes.values() if not p.killed}
    assert (len(after), before - after) == (len(before), {killed.pid})


@pytest.mark.parametrize("way", ["silent", "repeats old news"])
@within(running)
async def test_a_manager_that_beats_and_whose_status_is_not_heard_is_replaced(world, way):
    _, life, pid = world.row("ftm_manager")
    for _ in range(20):
        status(world, life)
        await asyncio.sleep(0.1)
    assert world.row("ftm_manager") == ("running", life, pid)
    heard_s = world.clock.now()
    for _ in range(10):
        if way == "repeats old news":
            status(world, life, heard_s)
        await asyncio.sleep(0.1)
    assert world.row("ftm_manager")[:2] == ("running", life + 1)
    assert ("ftm_manager", "wedged", life) in world.events
    status(world, life)  # nor does its old life speak for the next, which is given time
    await asyncio.sleep(2.0)
    assert world.row("ftm_manager")[:2] == ("running", life + 1)


@within(running)
async def test_who_waits_for_a_processor_is_not_taken_for_wedged_who_waits_for_nothing_is(world):
    (starved,), (wedged,) = world.machine.of("DM1"), world.machine.of("DM2")
    world.machine.starves_from_s["DM1"] = asyncio.get_running_loop().time()
    world.silent |= {starved.pid, wedged.pid}
    await eventually(lambda: wedged.killed, 0.8)
    await asyncio.sleep(3.0)
    assert not starved.killed
    assert world.row("DM1") == ("running", 1, starved.pid)
    world.machine.starves_from_s.clear()  # it has a processor, and says nothing all the same
    await eventually(lambda: starved.killed, 0.8)


@pytest.mark.parametrize(("silent", "turning", "until_s"), [
    (1, True, 1.5), (5, True, MOST_EXCUSED_S + 1.0), (5, False, MOST_EXCUSED_S + 1.0)])
@within(running)
async def test_where_many_are_silent_at_once_who_runs_is_blamed_late(
        world, silent, turning, until_s):
    world.machine.turning = turning
    processes = [world.machine.of(f"DM{i + 1}")[0] for i in range(silent)]
    world.silent |= {process.pid for process in processes}
    await asyncio.sleep(1.5)
    if turning:
        assert [process.killed for process in processes] == [silent == 1] * silent
    await eventually(lambda: all(p.killed for p in processes), until_s - 1.5)


@within(running)
async def test_what_is_not_heard_because_a_router_died_is_no_fault_of_any_process(world):
    answers = iter([False, True])
    world.supervisor._bus.moved = lambda: next(answers, False)
    process = world.machine.of("DM1")[0]
    world.silent.add(process.pid)
    timeout_s = world.spec.timing.heartbeat_timeout_s
    await asyncio.sleep(timeout_s + 0.1)
    assert not process.killed
    await eventually(lambda: process.killed, 0.3 + 0.2)


def status(world: World, life: int, stamp_s: float | None = None) -> None:
    world.say(topics.MANAGER_STATUS, m.ManagerStatus((), (), (), (), "safety-first", 0),
              "ftm_manager", incarnation=life, stamp_s=stamp_s)


NO_DESCRIPTOR = OSError(errno.EMFILE, os.strerror(errno.EMFILE))


@pytest.mark.parametrize("asked", [False, True])
@within(running)
async def test_a_process_that_no_descriptor_is_left_for_is_missed_and_replaced_when_it_is_gone(
        world, asked):
    world.machine.fork_error = world.machine.hold_error = NO_DESCRIPTOR
    world.kill("DM1")
    await asyncio.sleep(0.3)
    assert world.machine.forks == []
    world.machine.fork_error = None  # a fork that failed is tried again
    await eventually(lambda: world.row("DM1")[:2] == ("running", 2))
    world.events.clear()
    if asked:
        world.respawn("DM1", 2)
        await asyncio.sleep(1.0)
        assert world.machine.forks == [("DM1", 2)], "a second one beside it"
    world.kill("DM1")
    world.machine.hold_error = None
    await eventually(lambda: world.row("DM1")[:2] == ("running", 3))
    assert world.machine.forks == [("DM1", 2), ("DM1", 3)]
    assert world.events == [*([] if asked else [("DM1", "crashed", 2)]),
                            ("DM1", "respawned", 3), ("DM1", "running", 3)]


@within(running)
async def test_what_a_process_said_before_it_was_killed_does_not_make_it_run(world):
    world.machine.fork_error = "none"
    (victim,) = world.machine.of("DM1")
    world.silent.add(victim.pid)
    await eventually(lambda: victim.killed)
    world.beat(victim)
    await turns()
    assert world.row("DM1")[0] == "wedged"
    world.machine.fork_error = None
    await eventually(lambda: world.row("DM1")[:2] == ("running", 2))


@pytest.mark.parametrize("outage_s", [0.3, 6.0])
@within(running)
async def test_a_living_process_is_replaced_once_however_long_nobody_can_fork(world, outage_s):
    world.machine.fork_error = "none"
    for _ in range(3):  # it is asked for again while nobody answers
        world.respawn("safety_pilot", 1)
        await asyncio.sleep(0.01)
    await asyncio.sleep(outage_s)
    assert world.row("safety_pilot")[0] == "crashed"
    world.machine.fork_error = None
    await asyncio.sleep(1.0)
    assert world.machine.forks == [("safety_pilot", 2)]
    assert world.row("safety_pilot")[:2] == ("running", 2)


@within(running)
async def test_nothing_is_asked_for_again_before_it_is_answered(world):
    world.machine.is_slow = True
    world.kill("DM1")
    world.kill("osmosis_control")
    for _ in range(5):
        world.respawn("osmosis_control", 1)
        await asyncio.sleep(1.0)
    world.machine.is_slow = False
    assert len(world.machine.waiting) == 2
    for answer in world.machine.waiting:
        answer()
    await eventually(world.all_run)
    assert sorted(world.machine.forks) == [("DM1", 2), ("osmosis_control", 2)]


@pytest.mark.parametrize("outage_s", [0.2, 0.24])  # whichever of two chains would go on first
@within(running)
async def test_a_process_that_is_adapted_while_it_is_replaced_is_replaced_once(world, outage_s):
    document = load_document(PLAN)
    row = next(r for r in document["detection"] if r["name"] == "DM2")
    row["parameters"] = {**row.get("parameters", {}), "hold_s": 0.9}
    world.machine.fork_error = "none"
    world.kill("DM2")
    await asyncio.sleep(0.02)
    world.say(topics.ADAPTED_SYSTEM, m.AdaptedSystem(
        1, "retune DM2", "tester", msgspec.json.encode(document).decode()))
    await asyncio.sleep(outage_s)
    world.machine.fork_error = None
    await eventually(lambda: world.row("DM2")[:2] == ("running", 2))
    world.machine.questions = 0
    await asyncio.sleep(1.0)
    assert world.machine.forks == [("DM2", 2)]
    assert world.machine.questions == 0  # nobody waits for its end any more


@pytest.mark.parametrize("life", [2, 2 ** 53])
@within(running)
async def test_a_heartbeat_that_names_a_process_of_somebody_elses_has_nobody_adopted_or_killed(
        world, life):
    (own,) = world.machine.of("DM1")
    stranger = world.machine.add(("editor",), 1)
    world.machine.kill(own)
    for _ in range(20):
        world.say(bus_topics.HEARTBEAT, Heartbeat(stranger.pid, 0, 0.1, 0, 0), "DM1",
                  incarnation=life)
        await asyncio.sleep(0.05)
    assert not stranger.killed
    assert world.row("DM1")[0] == "running"
    assert world.row("DM1")[2] not in {stranger.pid, own.pid}


@pytest.mark.parametrize("numbers", [(3, 7), (7, 3)])
@within(running)
async def test_of_two_lives_of_one_node_a_new_supervisor_adopts_the_higher_and_ends_the_other(
        world, numbers):
    names = world.kill("DM2").names
    two: list[Process] = []
    await world.replace_supervisor(lambda: two.extend(
        world.machine.add(names, number, bound=True) for number in numbers), DM2=7)
    await turns()
    higher = max(two, key=lambda p: p.incarnation)
    assert world.row("DM2") == ("running", 7, higher.pid)
    assert world.machine.of("DM2") == [higher]


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
        self.world.say(topics.PROGRAM_END, m.ProgramEnd(self.process.pid, REASON),
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
    node = Node(world, OWN)
    for incarnation in (2, 3):
        world.events.clear()
        node.end_program()
        await eventually(lambda n=incarnation: node.starts[-1:] == [n], 0.01)
        await eventually(lambda n=incarnation: world.row(OWN) == ("running", n, node.process.pid))
        assert [event for name, event, _ in world.events if name == OWN] == [
            "crashed", "respawned", "running"]
    assert world.machine.forks == []
    assert not node.process.killed
    assert [(row.incarnation, row.restarts) for row in world.supervisor.rows()
            if row.name == OWN] == [(3, 2)]


@within(arbitrated)
async def test_a_node_of_a_recovery_module_waits_for_its_request_its_process_dead_or_not(world):
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
    node.end_program()
    await asyncio.sleep(0.1)
    world.kill(ARBITRATED)  # while its program is down
    await asyncio.sleep(0.1)
    assert world.machine.forks == []
    world.respawn(ARBITRATED, 2)
    await eventually(lambda: world.row(ARBITRATED)[:2] == ("running", 3))
    assert world.machine.forks == [(ARBITRATED, 3)]


@pytest.mark.parametrize("reports", [2, 1])
@within(restarted)
async def test_a_node_that_has_missed_its_respawn_reads_it_when_it_reports_again_or_is_replaced(
        world, reports):
    node = Node(world, OWN)
    node.is_deaf = True
    node.end_program()
    await asyncio.sleep(0.2)
    if reports == 2:
        node.is_deaf = False
        node.end_program()
    await eventually(lambda: world.row(OWN)[:2] == ("running", 4 - reports), 10.0)
    assert (node.starts, world.machine.forks) == (([2], []) if reports == 2 else ([], [(OWN, 3)]))


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
        world.say(topics.PROGRAM_END, m.ProgramEnd(pid, REASON), source)
        await asyncio.sleep(0.1)
    assert world.row(OWN) == ("running", 1, node.process.pid)
    assert node.starts == []


SICK_S = (14.0, 40.0)
"""Simulated seconds, far longer than it takes to be given up."""

SOON = Supervision(intensity=8, period_s=6.0, backoff_max_s=0.2, attempt_s=1.0, attempt_max_s=4.0)
"""A supervisor that gives up sooner than the usual one."""


class Sick(Actor):
    """Fails whenever it starts, for a while, and is well after it."""

    def on_start(self) -> None:
        if SICK_S[0] <= self.clock.now() < SICK_S[1]:
            raise RuntimeError("sick")
        super().on_start()


class SickPilot(Sick, SafetyPilot):
    pass


def test_attempts_begin_when_the_window_has_room_and_come_further_and_further_apart():
    policy, now_s, at_s = RestartPolicy(), 0.0, list[float]()
    for _ in range(50):  # of a process that ends at once
        now_s += policy.delay_s(now_s)
        policy.restarted(now_s)
        at_s.append(now_s)
    assert policy.delay_s(now_s) is None
    for _ in range(1000):
        now_s += policy.attempt_in_s(now_s)
        policy.restarted(now_s)
        at_s.append(now_s)
    assert at_s[50] == pytest.approx(at_s[0] + 60)
    assert [b - a for a, b in pairwise(at_s[50:])] == [20.0, 40.0] + [60.0] * 997
    assert all(later - earlier >= 60 for earlier, later in zip(at_s, at_s[50:], strict=False))
    policy.restarted(now_s + 100)  # who lasts for a whole period is as good as any other again
    assert policy.delay_s(now_s + 159) is None
    assert policy.delay_s(now_s + 160.1) == policy.attempts == 0


@pytest.mark.parametrize("name", ["DM2", "osmosis_control"])
@within(partial(running, SOON))
async def test_a_process_that_fails_at_its_start_is_given_up_and_tried_again(world, name):
    world.machine.sick.add(name)
    world.kill(name)
    await asyncio.sleep(0.02)
    world.respawn(name, 1)  # of RM3's node; once: the module may have been released since
    await eventually(lambda: world.row(name)[0] == "given up", 20)
    await asyncio.sleep(0.01)
    given_up_s, forks = world.clock.now(), len(world.machine.forks)
    assert forks == 8
    asked = len(world.events)
    world.respawn(name, 2)  # whoever asks meanwhile is answered, and gets no process
    await asyncio.sleep(0.05)
    assert (name, "given up", world.row(name)[1]) in world.events[asked:]
    next_s = next(row.next_attempt_s for row in world.supervisor.rows() if row.name == name)
    await asyncio.sleep(next_s - world.clock.now() - 0.01)
    assert len(world.machine.forks) == forks
    await asyncio.sleep(0.03)
    assert len(world.machine.forks) == forks + 1
    await asyncio.sleep(given_up_s + 60 - world.clock.now())
    attempts = len(world.machine.forks) - forks
    assert 13 <= attempts <= 17  # 5 s, 2 s, and then one in four seconds
    assert world.row(name)[0] == "given up"
    world.machine.sick.clear()
    await eventually(lambda: world.row(name)[0] == "running", 10)
    assert len(world.machine.of(name)) == 1
    await asyncio.sleep(10)
    world.kill(name)  # it is like any other again
    await asyncio.sleep(0.02)
    world.respawn(name, world.row(name)[1])
    await eventually(lambda: world.row(name)[0] == "running", 0.2)


SLOW = Supervision(intensity=3, period_s=60)
"""Three restarts within a minute are too many; a process is well after ten minutes."""


@pytest.mark.parametrize(("limits", "works", "present_s", "failing"), [
    (USUAL, [0.1] * 3, 0.0, True), (USUAL, [0.1] * 3, 1.1, False), (USUAL, [0.1] * 2, 0.0, False),
    (USUAL, [1.3] * 20, 1.3, True), (USUAL, [1.3] * 20, 10.1, False),
    (USUAL, [2.9] * 9, 0.1, False), (USUAL, [1.3] * 20 + [12.0] + [1.3] * 9, 0.0, False),
    (USUAL, [300.0] + [9.9] * 20, 0.0, True),
    (SLOW, [70.0] * 3, 0.0, True), (SLOW, [70.0] * 2, 0.0, False), (SLOW, [70.0] * 3, 599.0, True),
    (SLOW, [70.0] * 3, 600.0, False), (SLOW, [70.0, 70.0, 601.0, 70.0], 0.0, False),
    (SLOW, [900.0] * 40, 0.0, False)])  # killed four times an hour
def test_a_node_is_failing_whose_last_processes_worked_for_a_short_time_only(
        limits, works, present_s, failing):
    one, now_s = Lives(limits), 0.0
    for worked_s in works:
        one.forked()
        now_s += 9.0  # a cold start of nine seconds counts for nothing
        one.worked(now_s)
        now_s += worked_s
        assert one.ended(now_s)
        assert not one.ended(now_s)
    one.forked()
    one.worked(now_s)
    assert one.failing(now_s + present_s) == failing


def test_a_node_may_have_limits_of_its_own():
    general = Supervision(intensity=50, attempt_s=10.0, attempt_max_s=60.0)
    limits = RestartLimits(intensity=3, at_most_s=5.0).within(general)
    assert (limits.intensity, limits.period_s, limits.backoff_s) == (3, 60.0, 0.05)
    assert (limits.backoff_max_s, limits.attempt_s, limits.attempt_max_s) == (5.0, 5.0, 5.0)
    assert RestartLimits().within(general) == general


@within(partial(running, Supervision(intensity=3, period_s=20.0)))
async def test_an_unstable_node_is_reported_at_each_end_and_restarted_without_a_request(world):
    """No recovery module requests it any more: its own has failed, and a safer one acts."""
    for incarnation in range(1, 4):
        await asyncio.sleep(25.0)
        assert world.failing == set()
        world.kill("osmosis_control")  # of RM3
        await asyncio.sleep(0.02)
        world.respawn("osmosis_control", incarnation)
        await eventually(lambda: world.row("osmosis_control")[0] == "running", 1)
    await asyncio.sleep(25.0)
    assert world.failing == {"osmosis_control"}
    world.kill("osmosis_control")
    await asyncio.sleep(1.0)
    assert world.row("osmosis_control")[:2] == ("running", 5)
    told = [event for node, event, _ in world.events if node == "osmosis_control"]
    assert told.count("unstable") == 2
    await asyncio.sleep(199.0)
    assert world.failing == {"osmosis_control"}
    await asyncio.sleep(2.0)
    assert world.failing == set()
    assert [event for node, event, _ in world.events if node == "osmosis_control"][-1] == "stable"


@within(partial(running, SOON))
async def test_a_node_that_is_adapted_is_not_held_to_what_it_was_given_up_for(world):
    process = world.supervisor._processes["DM2"]
    for _ in range(20):
        process.policy.restarted(asyncio.get_running_loop().time())
    world.kill("DM2")
    await eventually(lambda: world.row("DM2")[0] == "given up")
    document, _ = adapt(load_document(PLAN), Change(
        Action.RETUNE, "DM2", {"timeout_s": 0.995}), PLAN.system_file)
    world.say(topics.ADAPTED_SYSTEM, m.AdaptedSystem(
        2, "retune DM2", "somebody", msgspec.json.encode(document).decode()))
    await eventually(lambda: world.row("DM2")[0] == "running", 0.3)


def test_the_robot_stands_until_what_was_given_up_is_back_and_then_goes_on(tmp_path):
    soon = "".join(f"{name} = {value}\n" for name, value in msgspec.structs.asdict(SOON).items())
    text = (ROOT / "systems" / "paper.toml").read_text(encoding="utf-8")
    file = tmp_path / "sick.toml"
    file.write_text(text.replace(
        f'"{SafetyPilot.__module__}:SafetyPilot"', f'"{__name__}:SickPilot"', 1)
        + f"\n[supervision]\n{soon}", encoding="utf-8")
    result = run_virtually(Job(
        row="x", system=str(file), patience_s=120,
        options={"mission": str(write_mission(tmp_path, "SHORT"))},
        faults=(parse_fault("kill:safety_pilot@15"),)))
    record = result.record
    assert (record.mission, record.safety, record.reasons) == ("success", "safe", ())
    given_up = [e.t_s for e in record.events if "safety_pilot given up" in e.text]
    assert len(given_up) >= 3
    assert {name for name, _ in result.failures} == {"safety_pilot"}
    stands_s = given_up[0] + 3.0  # silence is noticed after 0.99 s, and then it brakes
    assert [at for at in record.track if stands_s < at[0] < SICK_S[1]] == []


def process(state: State = State.CRASHED, **limits: float) -> SupervisedProcess:
    unit = Unit("a", (NodeSpec("a", Kind.CONTROL, "m:A"), NodeSpec("b", Kind.CONTROL, "m:B")))
    made = SupervisedProcess(unit, RestartPolicy(Supervision(**limits)), Patience(0.2), state)
    if state is not State.RESTARTING:
        made.shown = m.NodeState(state.value)
    return made


@pytest.mark.parametrize(("before", "shown"), [
    (State.STARTING, "crashed"), (State.RUNNING, "crashed"), (State.STOPPED, "stopped"),
    (State.WEDGED, "wedged"), (State.CRASHED, "crashed")])
def test_one_that_is_being_restarted_is_shown_as_what_it_was_and_never_as_well(before, shown):
    one = process(before)
    one.step(Event.RESTART)
    assert (one.state, one.shown.value, one.waits) == (State.RESTARTING, shown, True)
    assert one.is_dead == (shown == "crashed")


def silence(one: SupervisedProcess, now_s: float) -> str:
    return one.silence(now_s, 1.0, lambda: AT_LEISURE)


@pytest.mark.parametrize(("heard_s", "expected", "excused"), [
    ({"a": 8.0, "b": 10.0}, "no heartbeat from a", ""),
    ({"a": 8.0, "b": 8.0, STATUS: 8.0}, "no heartbeat from a, b", ""),
    ({"a": 10.0, "b": 10.0, STATUS: 8.0}, f"no {STATUS}", ""),
    ({"a": 7.0, "b": 10.0}, "no heartbeat from a", "no heartbeat from a"),
    ({"a": 9.5, "b": 10.0}, "", ""), ({}, "", "")])
def test_each_node_has_to_be_heard_and_the_manager_s_status_unless_it_could_not_be(
        heard_s, expected, excused):
    one = process(State.STARTING)
    one.take(7, 1)
    assert silence(one, START_TIMEOUT_S - 0.1) == ""
    assert silence(one, START_TIMEOUT_S + 0.1) == "no heartbeat after its start"
    one = process(State.RUNNING)
    one.take(7, 1)
    one.heard_s = heard_s
    assert silence(one, 10.0) == expected
    one.excuse(10.0, 1.5)  # the supervisor could not hear for so long
    assert silence(one, 10.0) == excused
    one.take(8, 3)
    assert silence(one, 10.0) == "", "another process"




def in_another_process(document):
    document["detection"][0]["process"] = "DM2"


def left_out(document):
    document["node"] = [row for row in document["node"] if row["name"] != "teleoperation"]


def on_another_host(document):
    next(row for row in document["detection"] if row["name"] == "DM13")["host"] = "robot"


def of_a_new_module(table: str) -> Callable[[dict], None]:
    return lambda document: document[table][0].update(actor="intruder:Node")


@pytest.mark.parametrize(("edit", "words"), [
    (in_another_process, "DM1: process = 'DM2'"), (left_out, "teleoperation"),
    (on_another_host, r"^DM13: host = 'robot'"), *(
        (of_a_new_module(table), "expected a class in a module that the running") for table in (
            "node", "detection", "recovery"))])
def test_a_change_to_processes_hosts_and_modules_that_do_not_run_is_refused(
        tmp_path, monkeypatch, edit, words):
    file = PLAN.system_file
    if edit is on_another_host:
        file = tmp_path / "two.toml"
        file.write_text(two_hosts({"robot": "10.0.0.1", "ground": "10.0.0.2"}))
    (tmp_path / "intruder.py").write_text("class Node: pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    plan = RunPlan(system_file=str(file))
    layout, document = Layout(plan, load_system(plan)), load_document(plan)

    def change() -> str:
        adapted = m.AdaptedSystem(1, "a change", "me", json.dumps(document))
        return adapted_system(layout, RunContext(), adapted)[0].spec.strategy

    document["strategy"] = "guarded-repair"
    assert change() == "guarded-repair"
    edit(document)
    with pytest.raises(ValueError, match=words):
        change()
    assert "intruder" not in sys.modules
