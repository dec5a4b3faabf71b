"""The supervisor's decisions, on a machine that is played: what happens when is exact here."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager

import msgspec
import pytest

from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.envelope import decode
from rampart.actors.bus.messages import Heartbeat
from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import AdaptedSystem, ManagerStatus, NodeState, RespawnRequest
from rampart.actors.machine.patience import Usage
from rampart.actors.runtime.run_context import RunContext
from rampart.actors.runtime.run_plan import SUPERVISOR, RunPlan, load_document, load_system
from rampart.actors.supervision.processes import Answer, ProcessHandle, RunProcess
from rampart.actors.supervision.supervised_process import MOST_EXCUSED_S
from rampart.actors.system.layout import Layout
from rampart.manager.spec.nodes import Kind, NodeSpec
from rampart.manager.spec.tables import Supervision
from rampart.testing import VirtualSystem, eventually, turns
from tests import ROOT
from tests.virtual_time import within

PLAN = RunPlan("r", 20000, system_file=str(ROOT / "systems" / "paper.toml"))
USUAL = Supervision()
EXIT_S = 0.005
"""From a SIGKILL to the moment when the last thread has let go of the port."""


class Process:
    """One process; without its port it never says anything and soon ends."""

    def __init__(self, names: tuple[str, ...], incarnation: int, pid: int, bound: bool) -> None:
        self.names, self.incarnation, self.pid, self.bound = names, incarnation, pid, bound
        self.killed = self.gone = False
        self.holders: list[Callable[[], None]] = []


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
        self.starving: set[str] = set()
        self.starves_from_s = 0.0
        self.turning = False
        self.questions = 0

    def usage(self, process: Process) -> Usage:
        ran_s = 1.0 + (asyncio.get_running_loop().time() / 100 if self.turning else 0.0)
        return Usage("S", ran_s, max(0.0, asyncio.get_running_loop().time() - self.starves_from_s)
                     if process.names[0] in self.starving else 0.0)

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
            asyncio.get_running_loop().call_later(EXIT_S, self._exited, process)

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

    def adapt(self, adapted: AdaptedSystem) -> None:
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
        return all(p.shown is NodeState.RUNNING for p in self.supervisor._processes.values())

    def kill(self, name: str) -> Process:
        (process,) = self.machine.of(name)
        self.machine.kill(process)
        return process

    def respawn(self, name: str, failed: int) -> None:
        self.say(topics.RESPAWN, RespawnRequest(1, name, failed, "RM7"))


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
    assert len(after) == len(before)
    assert len(before - after) == 1


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
    world.machine.starving = {"DM1"}
    world.machine.starves_from_s = asyncio.get_running_loop().time()
    world.silent |= {starved.pid, wedged.pid}
    await eventually(lambda: wedged.killed, 0.8)
    await asyncio.sleep(3.0)
    assert not starved.killed
    assert world.row("DM1") == ("running", 1, starved.pid)
    world.machine.starving.clear()  # it has a processor, and says nothing all the same
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
    world.say(topics.MANAGER_STATUS, ManagerStatus((), (), (), (), "safety-first", 0),
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
    world.say(topics.ADAPTED_SYSTEM, AdaptedSystem(
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
