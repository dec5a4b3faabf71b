"""Two supervisors in virtual time, on simulated machines and disks: which host runs a node."""

from __future__ import annotations

import asyncio
import errno
import os
import tempfile
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path

import pytest

from rampart.actors.bus import run_folder
from rampart.actors.bus.envelope import decode, pack
from rampart.actors.bus.messages import Heartbeat
from rampart.actors.bus.topics import DIAGNOSTIC, HEARTBEAT
from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import Checkpoints, KeptState, NodeInfo
from rampart.actors.runtime.checkpoint import Record
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.run_context import RunContext
from rampart.actors.runtime.run_plan import RunPlan, load_system
from rampart.actors.supervision import supervisor
from rampart.actors.supervision.node_process import make_actor
from rampart.actors.system.layout import Layout
from rampart.sim.virtual.virtual_bus import Hub, VirtualBus
from rampart.testing import VirtualSystem, eventually, run
from tests.actors.supervision.test_supervisor import Machine
from tests.two_hosts import two_hosts
from tests.virtual_time import within

EPOCH = run_folder.EPOCH
DELAY_S = 0.05


def record(incarnation: int, generation: int) -> Record:
    return Record(incarnation, generation, 1, 0, b"%d" % generation)


class Files:
    """The disk of one host, in memory; `StateFiles` to its supervisor."""

    def __init__(self, disk, _folder, _run, _nodes, kept, _problem) -> None:
        self.disk: dict[str, Record] = disk
        self.is_stuck = False
        self._kept = kept

    def start(self) -> None:
        for node, kept in self.disk.items():
            self._kept(node, kept, False)

    def keep(self, node: str, kept: Record) -> None:
        self.disk[node] = kept
        self._kept(node, kept, False)

    def take(self, node: str, sent: Record) -> None:
        if node not in self.disk or sent.age > self.disk[node].age:
            self.keep(node, sent)

    def settle(self, node: str) -> None:
        if not self.is_stuck:
            self._kept(node, self.disk.get(node), True)

    def close(self) -> None:
        pass


class Host(Machine):
    """A machine of the run: its processes, its disk, and its supervisor.

    Attributes:
        loaded: by node and incarnation, the state that its process has found.
    """

    def __init__(self, world: World, name: str, incarnation: int = 1) -> None:
        super().__init__()
        self.name = name
        self.folder = run_folder.make(20000, 1)
        self.disk: dict[str, Record] = {}
        self.loaded: dict[tuple[str, int], Record | None] = {}
        self.files: Files | None = None
        self._plan = RunPlan(
            "r", 20000, system_file=str(world.file), host=name, folder=self.folder,
            checkpoints=world.checkpoints, incarnations=incarnation - 1)
        self._world = world
        self.begin(incarnation)

    def begin(self, incarnation: int) -> None:
        """Begin a supervisor, the first one or its replacement."""
        world, plan = self._world, self._plan
        spec = load_system(plan)
        run_folder.issue(self.folder, [plan.supervisor], incarnation)
        system = VirtualSystem(RunContext(
            plan, spec, known_incarnations=run_folder.issued(self.folder)), Layout(plan, spec))
        system.hub, system.clock = world.hub, world.clock
        system.register = run_folder.register_of(self.folder)
        system.incarnations[plan.supervisor] = incarnation - 1
        self.supervisor = system.start_node(plan.supervisor, self, self.made)
        self.task = system.tasks[plan.supervisor]

    def made(self, *arguments):
        self.files = Files(self.disk, *arguments)
        return self.files

    def add(self, names, incarnation, *, bound=False):
        run_folder.issue(self.folder, names, incarnation, os.getpid())
        for name in names:
            self.loaded[name, incarnation] = self.disk.get(name)
        return super().add(names, incarnation, bound=bound)

    def runs(self, name: str) -> int:
        return max((p.incarnation for p in self.of(name)), default=0)


class World:
    """The robot, the ground station, and the line between them."""

    def __init__(self, folder: Path, checkpoints: str) -> None:
        loop = asyncio.get_running_loop()
        self.clock = Clock(loop.time(), source=loop.time)
        self.is_cut = False
        self.delay_s = DELAY_S
        self.hub = Hub(self.link, several_hosts=True)
        self.checkpoints = checkpoints
        self.file = folder / "two.toml"
        self.file.write_text(two_hosts({"robot": "10.0.0.1", "ground": "10.0.0.2"},
                                       ("camera", "part_finder", "D_VISION_CRASH"), "cell", 0.1))
        self.diagnostics: list[tuple[str, str]] = []
        self.rows: dict[str, NodeInfo] = {}
        self.states = 0
        self.hub.taps.append(self.see)
        self.robot, self.ground = Host(self, ""), Host(self, "ground")
        self._buses = {host: VirtualBus(self.hub, f"nodes_{host}") for host in ("", "ground")}
        self._sequence = 0

    def link(self, source: str, reader: str):
        def way(now_s: float) -> tuple[float, ...]:
            return () if self.is_cut else (now_s + self.delay_s,)

        return None if source.endswith("ground") == reader.endswith("ground") else way

    def see(self, _now_s: float, _source: str, key: str, payload: bytes) -> None:
        if topics.CHECKPOINTS.member(key.removeprefix("rampart/")):
            self.states += 1
        if DIAGNOSTIC.member(key.removeprefix("rampart/")):
            found = decode(DIAGNOSTIC, payload)[1]
            self.diagnostics.append((found.context, found.reason))
        if topics.NODES.member(key.removeprefix("rampart/")) is not None:
            self.rows = {row.name: row for row in decode(topics.NODES, payload)[1].nodes}

    def publish(self, host: str, source: str, topic, body, member: str) -> None:
        """Publish as a node of a host; `source` is its name and its incarnation."""
        name, _, incarnation = source.partition("#")
        self._sequence += 1
        self._buses[host].publish(topic, topic.at(member), pack(
            (name, int(incarnation), self._sequence, self.clock.now(), body)))

    async def beats(self) -> None:
        for bus in self._buses.values():
            await bus.open()
        while True:
            for host in (self.robot, self.ground):
                for one in host.processes.values():
                    for name in one.names if one.bound and not one.killed else ():
                        self.publish(host.name, f"{name}#{one.incarnation}", HEARTBEAT,
                                 Heartbeat(one.pid, 0, 0.1, 0, 0), name)
            await asyncio.sleep(0.1)

    async def taken_over(self) -> None:
        """Have the camera keep two states at home, and be lost."""
        self.ground.files.keep("camera", record(1, 1))
        self.ground.files.keep("camera", record(1, 2))
        await asyncio.sleep(DELAY_S + 0.01)
        self.is_cut = True
        await eventually(lambda: self.robot.runs("camera") == EPOCH + 1)


@asynccontextmanager
async def world(checkpoints: str = "kept") -> AsyncIterator[World]:
    with tempfile.TemporaryDirectory() as folder:
        made = World(Path(folder), checkpoints)
        beats = asyncio.create_task(made.beats())
        try:
            await eventually(lambda: made.ground.runs("camera") == 1)
            await asyncio.sleep(1.0)
            yield made
        finally:
            tasks = (beats, made.robot.task, made.ground.task)
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            for host in (made.robot, made.ground):
                run_folder.remove(host.folder)


@within(world)
async def test_the_first_host_goes_on_from_it_and_its_home_from_what_was_kept_there(made):
    for name, host in (("gripper", ""), ("camera", "ground")):  # the table of all hosts knows both
        await eventually(lambda name=name: made.rows[name].heard_s > made.clock.now() - 1.0)
        assert made.rows[name].host == host
    await made.taken_over()
    assert made.robot.loaded["camera", EPOCH + 1] == record(1, 2)
    made.ground.files.keep("camera", record(1, 3))  # its supervisor does not know of the take-over
    made.robot.files.keep("camera", record(EPOCH + 1, 3))
    await asyncio.sleep(2.0)
    made.robot.files.keep("camera", record(EPOCH + 1, 4))
    made.is_cut = False
    await eventually(lambda: made.ground.runs("camera") == EPOCH + 2)
    assert made.ground.loaded["camera", EPOCH + 2] == record(EPOCH + 1, 4)
    assert made.robot.runs("camera") == 0
    assert not [one for one in made.diagnostics if one[0] == "checkpoint"]
    made.ground.files.keep("camera", record(EPOCH + 2, 5))
    await asyncio.sleep(DELAY_S + 0.001)
    assert made.robot.disk["camera"] == record(EPOCH + 2, 5)


@within(world)
async def test_a_process_that_ends_while_it_is_given_back_is_not_restarted(made, monkeypatch):
    """The news of its end waits in the mailbox."""
    await made.taken_over()
    ended, hand_over = [], made.robot.supervisor.hand_over

    def end_and_hand_over(unit):
        for one in made.robot.of(unit):
            ended.append(one.names)
            one.killed = True
            made.robot._exited(one)
        return hand_over(unit)

    monkeypatch.setattr(made.robot.supervisor, "hand_over", end_and_hand_over)
    made.is_cut = False
    await eventually(lambda: made.ground.runs("D_VISION_CRASH") == EPOCH + 2)
    await asyncio.sleep(2.0)
    assert ("D_VISION_CRASH",) in ended
    for name in ("camera", "part_finder", "D_VISION_CRASH"):
        assert (made.robot.runs(name), made.ground.runs(name)) == (0, EPOCH + 2)


@within(world)
async def test_one_that_is_being_forked_when_its_home_is_back_gives_way(made, monkeypatch):
    """The root may be slow; its fork must not have the incarnation of the home's process."""
    fork, asked = made.robot.fork, []

    def slow(names, incarnation, answer):
        if "camera" in names and not asked:
            asked.append((names, incarnation, answer))
        else:
            fork(names, incarnation, answer)

    monkeypatch.setattr(made.robot, "fork", slow)
    made.is_cut = True
    await eventually(lambda: asked)
    made.is_cut = False
    await eventually(lambda: made.ground.runs("camera") > 1)
    assert made.ground.runs("camera") > asked[0][1]
    ended: list[int] = []
    monkeypatch.setattr(supervisor, "kill", ended.append)
    asked[0][2](77, "")
    assert ended == [77]


@within(world)
async def test_one_that_could_not_be_held_is_ended_as_soon_as_it_can_be(made, monkeypatch):
    hold, is_full = made.robot.hold, [True]

    def hold_if_there_is_room(pid, ended):
        if is_full[0] and ("camera",) in (
                p.names for p in made.robot.living() if p.pid == pid):
            raise OSError(errno.EMFILE, "Too many open files")
        return hold(pid, ended)

    monkeypatch.setattr(made.robot, "hold", hold_if_there_is_room)
    await made.taken_over()
    made.is_cut = False
    await eventually(lambda: made.robot.supervisor.highest_of("camera") == 0)
    is_full[0] = False
    await eventually(lambda: not made.robot.of("camera"))
    await eventually(lambda: made.ground.runs("camera") == EPOCH + 2)


@within(world)
async def test_what_was_given_back_and_kept_in_its_last_moment_comes_home_to_a_new_supervisor(made):
    await made.taken_over()
    made.robot.files.keep("camera", record(EPOCH + 1, 3))
    (process,) = made.robot.of("camera")
    made.robot.ends_after_s = 0.4
    await asyncio.sleep(1.0)
    made.is_cut = False
    await eventually(lambda: process.killed)
    await asyncio.sleep(0.3)
    made.robot.disk["camera"] = record(EPOCH + 1, 9)  # and it is not gone yet
    await eventually(lambda: not made.ground.of("camera"))
    made.ground.supervisor.abandon()
    made.ground.task.cancel()
    await asyncio.gather(made.ground.task, return_exceptions=True)
    made.ground.begin(2)
    for name in ("camera", "part_finder", "D_VISION_CRASH"):
        await eventually(lambda name=name: made.ground.runs(name) == EPOCH + 2)
        assert made.robot.runs(name) == 0
    assert made.ground.loaded["camera", EPOCH + 2] == record(EPOCH + 1, 9)


@within(world)
async def test_a_supervisor_that_stood_still_takes_nothing_over(made):
    """Messages of that time are still unread when the timers are due."""
    for _ in range(10):
        made.is_cut = True
        await asyncio.sleep(DELAY_S + 0.01)  # what was under way has been read
        asyncio.get_running_loop().jump(0.9)  # no callback runs meanwhile
        made.is_cut = False
        await asyncio.sleep(0.53)
    assert not [names for names, _ in made.robot.forks if "camera" in names]


@within(world)
async def test_a_last_state_that_never_comes_is_waited_for_two_seconds_and_reported(made):
    await made.taken_over()
    made.robot.files.is_stuck = True
    made.is_cut = False
    await eventually(lambda: not made.robot.of("camera"))
    given_back_s = made.clock.now()
    await eventually(lambda: made.ground.runs("camera") == EPOCH + 2)
    assert 2.0 < made.clock.now() - given_back_s < 2.5
    assert any("has not sent the last state" in why for _, why in made.diagnostics)


@within(world)
async def test_a_host_that_starts_again_with_an_empty_disk_goes_on_from_the_first_s_copy(made):
    await made.taken_over()
    made.robot.files.keep("camera", record(EPOCH + 1, 3))
    made.ground.task.cancel()
    await asyncio.gather(made.ground.task, return_exceptions=True)
    await made.ground.supervisor.context.bus.close()
    run_folder.remove(made.ground.folder)
    made.ground = Host(made, "ground", EPOCH + 1)
    for name in ("camera", "part_finder", "D_VISION_CRASH"):
        run_folder.issue(made.ground.folder, [name], EPOCH + 1)
    await asyncio.sleep(0.26)  # out of step with the repetitions
    made.is_cut = False
    await asyncio.sleep(0.1 + 4 * DELAY_S + 0.01)  # a heartbeat, and what the first holds
    assert made.ground.disk == {"camera": record(EPOCH + 1, 3)}
    await eventually(lambda: made.ground.runs("camera") == EPOCH + 2)
    assert made.ground.loaded["camera", EPOCH + 2] == record(EPOCH + 1, 3)


@within(partial(world, checkpoints=""))
async def test_without_checkpoints_no_states_are_published(made):
    await asyncio.sleep(5.0)
    made.is_cut = True
    await eventually(lambda: made.robot.runs("camera") == EPOCH + 1)
    made.is_cut = False
    await eventually(lambda: made.ground.runs("camera") == EPOCH + 2)
    assert made.states == 0


@within(world)
async def test_states_are_published_twice_a_second_and_forged_ones_change_nothing(made):
    def forge(source: str) -> None:
        state = KeptState("camera", *record(1, 99), issued=9, final=True)
        made.publish("ground", source, topics.CHECKPOINTS, Checkpoints("r", (state,)),
                 "supervisor_ground")

    before = made.states
    await asyncio.sleep(10.0)
    assert made.states - before == pytest.approx(2 * 20, abs=2)
    for garbage in (b"", b"\xc1", pack(("supervisor_ground", 1, 900, 0.0, (1,)))):
        made._buses["ground"].publish(
            topics.CHECKPOINTS, topics.CHECKPOINTS.at("supervisor_ground"), garbage)
    for source in ("stranger#1", "camera#1", "supervisor_ground#0"):
        forge(source)
    await asyncio.sleep(1.0)
    assert made.robot.disk == {}
    assert any(why.startswith("not a Checkpoints") for _, why in made.diagnostics), made.diagnostics


def test_a_module_takes_no_number_of_another_machine_for_a_process_of_its_own(tmp_path, sockets):
    file = tmp_path / "two.toml"
    file.write_text(two_hosts({"robot": "10.0.0.1", "ground": "10.0.0.2"}))

    async def scenario() -> None:
        plan = RunPlan(system_file=str(file), folder=sockets)
        spec = load_system(plan)
        watchdog = make_actor(Layout(plan, spec), "DM5", 1, RunContext(plan, spec),
                              asyncio.get_running_loop())
        run_folder.issue(sockets, ["hmi"], 1)
        run_folder.issue(sockets, ["DM4"], 1, os.getpid())
        assert watchdog.context.local_pid("hmi", 4711) == -1
        assert watchdog.context.local_pid("DM4", 4711) == 4711

    run(scenario)
