"""Real processes, really killed: what root and supervisor promise whatever the nodes do."""

import asyncio
import contextlib
import ctypes
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import msgspec
import pytest
import pytest_asyncio

from benchmarks.own_root import OwnLauncher
from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.messages import Diagnostic
from rampart.actors.bus.run_folder import ROUTERS
from rampart.actors.bus.run_info import find_runs
from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import AdaptedSystem, NodeTable, ProcessEvent
from rampart.actors.runtime.actor import Actor, Context, Header, on
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.run_plan import load_document, load_system
from rampart.actors.supervision import node_process
from rampart.actors.supervision.launcher import Launcher, LaunchError
from rampart.actors.supervision.process_title import find_processes
from rampart.actors.system.layout import Layout
from rampart.cli.operate import kill_node
from rampart.cli.run_options import parse, plan_of
from rampart.testing import eventually
from tests.stub_actors import IdleDetection, IdlePose, launched, stub_plan, write_stub_system

pytestmark = [pytest.mark.processes, pytest.mark.asyncio(loop_scope="module")]


class Witness(Actor):
    """Hears what the supervisor says, and may ask it to respawn a node, as RM3 does."""

    outputs = (topics.RESPAWN, topics.ADAPTED_SYSTEM)

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self.events: list[ProcessEvent] = []
        self.errors: list[Diagnostic] = []
        self.table = NodeTable(())

    @on(topics.PROCESS_EVENT)
    def event(self, message: ProcessEvent, header: Header) -> None:
        self.events.append(message)

    @on(bus_topics.DIAGNOSTIC)
    def error(self, message: Diagnostic, header: Header) -> None:
        self.errors.append(message)

    @on(topics.NODES)
    def nodes(self, message: NodeTable, header: Header) -> None:
        self.table = message

    def state(self, node: str) -> tuple[str, int]:
        return next(((r.state.value, r.incarnation) for r in self.table.nodes if r.name == node),
                    ("unknown", 0))

    def runs_above(self, node: str, incarnation: int) -> bool:
        state, now = self.state(node)
        return state == "running" and now > incarnation

    def pid(self, node: str) -> int:
        return next(r.pid for r in self.table.nodes if r.name == node)

    @asynccontextmanager
    async def comes_back(self, *nodes: str, alone: bool = False) -> AsyncIterator[None]:
        """Wait until the next incarnations run of what the body of the context has hurt.

        If they come back alone, all others are the same processes as before.
        """
        next_ones = {node: ("running", self.state(node)[1] + 1) for node in nodes}
        before = self.pids()
        self.events.clear()
        yield
        await eventually(lambda: all(self.state(n) == one for n, one in next_ones.items()),
                         10.0, f"not back: {nodes}")
        if alone:
            await eventually(self.all_run)
            assert {n for n, pid in self.pids().items() if pid != before[n]} == set(nodes)

    def kill(self, *nodes: str) -> None:
        for node in nodes:
            os.kill(self.pid(node), signal.SIGKILL)

    def pids(self) -> dict[str, int]:
        return {row.name: row.pid for row in self.table.nodes}

    def all_run(self) -> bool:
        return len(self.table.nodes) == 24 and all(
            row.state.value == "running" for row in self.table.nodes)

    def saw(self, node: str, event: str) -> bool:
        return any(e.node == node and e.event == event for e in self.events)


@asynccontextmanager
async def running(tmp_path, *changes) -> AsyncIterator[tuple[Launcher, Witness]]:
    async with launched(stub_plan(write_stub_system(tmp_path, *changes))) as launcher:
        bus = launcher.observers_bus()
        clock = Clock(launcher.plan.origin_s)
        witness = Witness(Context("observer", 1, clock, bus))
        task = asyncio.create_task(witness.run())
        try:
            await eventually(witness.all_run, 20)
            yield launcher, witness
        finally:
            witness.stop()
            await task


def process(port: int, name: str) -> int | None:
    found = [p for p in find_processes(port) if name in p.names]
    return max(found, key=lambda p: p.incarnation).pid if found else None


def pilot_with_spare(word: str) -> tuple[str, str]:
    """Return the change of the stub system by which safety_pilot has such a spare."""
    return 'name = "safety_pilot"', f'name = "safety_pilot"\nspare = "{word}"'


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def run(tmp_path_factory):
    """One run, in which safety_pilot has no spare; the tests that follow hurt it in turn."""
    async with running(tmp_path_factory.mktemp("run"), pilot_with_spare("none")) as both:
        yield both


@pytest_asyncio.fixture(loop_scope="module")
async def witness(run):
    """Its witness, when all nodes run."""
    _, witness = run
    await eventually(witness.all_run, 20)
    witness.events.clear()
    return witness


@pytest.fixture
def port(run):
    return run[0].plan.base_port


@pytest.mark.parametrize(("node", "number", "event"), [
    ("DM1", signal.SIGKILL, "crashed"), ("DM2", signal.SIGSEGV, "crashed"),
    ("RM1", signal.SIGTERM, "crashed"), ("DM3", signal.SIGSTOP, "stopped"),
    ("safety_pilot", signal.SIGUSR2, "wedged")])
async def test_a_process_that_dies_stops_or_wedges_is_told_apart_and_comes_back(
        witness, node, number, event):
    async with witness.comes_back(node):
        os.kill(witness.pid(node), number)
    assert witness.saw(node, event)


class HangingDetection(IdleDetection):
    """Hangs after its first start: DM1 spins, DM2 holds the lock of the interpreter."""

    def on_start(self) -> None:
        if self.context.incarnation == 1 and self.name in {"DM1", "DM2"}:
            self.call_later(3.0, self.hang)

    def hang(self) -> None:
        if self.name == "DM2":
            ctypes.PyDLL(None).sleep(1000)
        while True:
            pass


async def test_a_loop_that_spins_or_holds_the_lock_is_found_and_replaced(tmp_path):
    async with running(tmp_path, (
            "tests.stub_actors:IdleDetection",
            "tests.actors.supervision.test_supervision:HangingDetection")) as (_, witness):
        await eventually(lambda: witness.saw("DM1", "wedged") and witness.saw("DM2", "wedged"), 20)
        await eventually(lambda: {witness.state(name) for name in ("DM1", "DM2")}
                         == {("running", 2)}, 20)


async def test_a_node_is_back_while_who_hears_it_is_stopped(witness, port):
    names = ("DM1", "DM2", "DM3", "DM4", "RM2")
    stopped = [process(port, name) for name in names]
    supervisor = process(port, "supervisor")
    async with witness.comes_back("ftm_manager", *names):
        os.kill(supervisor, signal.SIGSTOP)  # it would have them replaced
        for pid in stopped:
            os.kill(pid, signal.SIGSTOP)
        os.kill(process(port, "ftm_manager"), signal.SIGKILL)
        await eventually(lambda: process(port, "ftm_manager") is None)
        os.kill(supervisor, signal.SIGCONT)


async def test_the_world_and_nobody_else_goes_before_others_where_that_is_permitted(witness):
    lower = f"import os; os.setpriority(os.PRIO_PROCESS, 0, {node_process.WORLD_NICE})"
    permitted = subprocess.run([sys.executable, "-c", lower], check=False,
                               stderr=subprocess.DEVNULL).returncode == 0
    own = os.getpriority(os.PRIO_PROCESS, 0)
    nice = {name: {os.getpriority(os.PRIO_PROCESS, int(thread.name))
                   for thread in Path(f"/proc/{pid}/task").iterdir()}
            for name, pid in witness.pids().items()}
    assert nice.pop("simulator") == {node_process.WORLD_NICE if permitted else own}
    assert set().union(*nice.values()) == {own}


@pytest.mark.parametrize(("guard", "number"), [
    ("supervisor", signal.SIGKILL), ("supervisor", signal.SIGSTOP), ("supervisor", signal.SIGTERM),
    ("router_a", signal.SIGSTOP)])
async def test_a_supervisor_or_router_comes_back_and_costs_no_other_its_process(
        witness, port, guard, number):
    async with witness.comes_back(guard, alone=True):
        os.kill(process(port, guard), number)


async def test_a_supervisor_that_stood_still_for_a_while_blames_nobody_for_it(witness, port):
    supervisor = process(port, "supervisor")
    async with witness.comes_back("DM3", alone=True):
        os.kill(supervisor, signal.SIGSTOP)
        await asyncio.sleep(0.9)  # longer than a heartbeat may be missing, but not for the launcher
        os.kill(supervisor, signal.SIGCONT)
        os.kill(witness.pid("DM3"), signal.SIGSTOP)  # and it still sees who does stand still
    assert {e.node for e in witness.events if e.event in {"stopped", "wedged"}} == {"DM3"}


async def test_with_the_supervisor_and_both_routers_gone_all_three_come_back(witness, port):
    victims = ("supervisor", *ROUTERS)
    old = {name: process(port, name) for name in victims}
    for pid in old.values():
        os.kill(pid, signal.SIGKILL)
    await eventually(lambda: all(
        witness.state(name)[0] == "running" and witness.pid(name) != old[name]
        for name in victims), 15)
    await eventually(witness.all_run, 15)


async def test_kill_node_signals_one_node_and_names_what_it_does_not_know(witness, port, capsys):
    async with witness.comes_back("DM1"):
        assert await asyncio.to_thread(kill_node.main, ["DM1", "--port", str(port)]) == 0
    for arguments, words in (
            (["DM99", "--port", str(port)], "unknown node 'DM99'"),
            (["DM1", "--signal", "HUG", "--port", str(port)], "unknown signal"),
            (["DM1", "--port", "1"], "no run found on port 1")):
        assert await asyncio.to_thread(kill_node.main, arguments) == 2
        error = capsys.readouterr().err
        assert words in error
        assert error.count("\n") == 1


async def test_what_fails_before_the_actors_of_a_process_start_is_told(
        tmp_path, monkeypatch, capfd):
    def broken(*_: object) -> None:
        raise RuntimeError("no title today")

    monkeypatch.setattr(node_process, "set_title", broken)
    plan = stub_plan(write_stub_system(tmp_path))
    layout = Layout(plan, load_system(plan))
    role = node_process.Role(("supervisor",), 3)
    assert await node_process.live(layout, role, {}) == node_process.EXIT_FAILED
    assert "supervisor #3 failed: RuntimeError: no title today" in capfd.readouterr().err


def _catches(pid: int, number: signal.Signals) -> bool:
    status = Path(f"/proc/{pid}/status").read_text()
    caught = next(row.split()[1] for row in status.splitlines() if row.startswith("SigCgt:"))
    return bool(int(caught, 16) >> number - 1 & 1)


class Farewell(IdlePose):
    """Writes a file when it is asked to end."""

    def on_stop(self) -> None:
        Path(self.context.run.plan.system_file).with_name("farewell").touch()


async def test_an_orderly_end_stops_nodes_and_then_routers_also_with_a_hung_supervisor(tmp_path):
    """And routers close no session, which makes Zenoh panic."""
    order: list[str] = []
    farewell = ("tests.stub_actors:IdlePose", "tests.actors.supervision.test_supervision:Farewell")
    async with running(tmp_path, farewell) as (launcher, witness):
        os.kill(witness.pid("DM6"), signal.SIGSTOP)
        assert await asyncio.to_thread(find_runs)
        port, names = launcher.plan.base_port, ("DM1", "DM5", "RM1", *ROUTERS)
        assert [_catches(process(port, name), signal.SIGTERM) for name in names] == [
            True, True, True, False, False]
        held = {os.pidfd_open(process(port, name)): name for name in names}

        def look() -> None:
            while held:
                for one in select.select(list(held), [], [], 10)[0]:
                    order.append(held.pop(one))
                    os.close(one)

        looking = asyncio.create_task(asyncio.to_thread(look))
        os.kill(process(port, "supervisor"), signal.SIGSTOP)
    assert (tmp_path / "farewell").exists()
    await asyncio.wait_for(looking, 12)
    assert set(order[-2:]) == set(ROUTERS)
    assert find_processes(port) == []


def router_incarnations(port: int, within_s: float) -> set[int]:
    found, until_s = set(), time.monotonic() + within_s
    while time.monotonic() < until_s:
        found |= {p.incarnation for p in find_processes(port) if set(p.names) & set(ROUTERS)}
    return found


async def test_an_end_while_the_supervisor_starts_starts_no_router_again(tmp_path):
    async with running(tmp_path) as (launcher, _):
        port, root = launcher.plan.base_port, launcher.plan.launcher_pid
        children = Path(f"/proc/{root}/task/{root}/children")
        before = children.read_text().split()
        os.kill(process(port, "supervisor"), signal.SIGKILL)
        while not (new := set(children.read_text().split()).difference(before)):
            pass
        os.kill(int(new.pop()), signal.SIGSTOP)  # before it sends anything
        looking = asyncio.create_task(asyncio.to_thread(router_incarnations, port, 2.5))
        await asyncio.sleep(0.1)
    assert await looking == {1}


async def test_an_unsound_spec_is_one_line(tmp_path):
    system = write_stub_system(tmp_path, ('detect = "DM3"', 'detect = "DM9"'))
    launcher = OwnLauncher(stub_plan(system), "test")
    with pytest.raises(LaunchError, match=r"stub\.toml.*DM9") as caught:
        await launcher.load()
    assert "\n" not in str(caught.value)
    await launcher.end()


HURTS = (signal.SIGKILL, signal.SIGSTOP)


def pool(port: int) -> set[int]:
    return {p.pid for p in find_processes(port) if p.names == ("pool",)}


async def filled(port: int, other_than: set[int] = frozenset()) -> set[int]:
    """Return the pool when it is full, and has had time to be ready."""
    await eventually(lambda: len(pool(port)) == 2 and other_than.isdisjoint(pool(port)), 20)
    await asyncio.sleep(0.3)
    return pool(port)


@pytest.mark.alone
async def test_without_a_pool_the_next_supervisor_is_forked_and_no_node_is_started_twice(
        witness, port):
    there = await filled(port)
    nodes = {p.pid for p in find_processes(port)} - there - {process(port, "supervisor")}
    _, before = witness.state("supervisor")
    for pid in (*there, process(port, "supervisor")):
        os.kill(pid, signal.SIGKILL)
    await eventually(lambda: witness.runs_above("supervisor", before))
    assert nodes <= {p.pid for p in find_processes(port)}, "one that was dying took the request"


@pytest.mark.alone
async def test_a_supervisor_that_dies_with_requests_under_way_leaves_one_process_of_each_node(
        witness, port):
    for life in range(2, 6):
        async with witness.comes_back("supervisor"):
            witness.kill("DM1", "DM2", "DM3")
            await asyncio.sleep(0.002 * life)
            os.kill(process(port, "supervisor"), signal.SIGKILL)
        await eventually(witness.all_run)
        there = [name for p in find_processes(port) for name in p.names if name != "pool"]
        assert len(there) == len(set(there))


@pytest.mark.alone
async def test_what_dies_is_made_of_the_pool_and_a_node_without_a_spare_is_forked(witness, port):
    there = await filled(port)
    async with witness.comes_back("safety_pilot"):
        witness.kill("safety_pilot")
    assert witness.pid("safety_pilot") not in there
    async with witness.comes_back("DM1", "DM2"):
        witness.kill("DM1", "DM2")  # together
    assert {witness.pid("DM1"), witness.pid("DM2")} == there
    there = await filled(port)
    async with witness.comes_back("supervisor"):
        os.kill(process(port, "supervisor"), signal.SIGKILL)
    assert process(port, "supervisor") in there


@pytest.mark.alone
async def test_a_process_of_the_pool_that_cannot_become_a_node_costs_only_itself(witness, port):
    there = await filled(port)
    for hurt in HURTS:
        there, life = await filled(port, {witness.pid("DM1")}), witness.state("DM1")[1]
        for pid in there:
            os.kill(pid, hurt)
        witness.kill("DM1")
        await eventually(lambda n=life: witness.runs_above("DM1", n))
        assert witness.pid("DM1") not in there
    there = await filled(port, there)
    for hurt in HURTS:  # it is replaced though no node needs it
        for pid in there:
            os.kill(pid, hurt)
        there = await filled(port, there)


async def test_a_supervisor_that_ends_whenever_it_starts_is_not_started_without_end(tmp_path):
    limits = "\n[supervision]\nintensity = 6\nperiod_s = 6.0\nbackoff_s = 0.05\n\n[timing]\n"
    async with running(tmp_path, ("\n[timing]\n", limits)) as (launcher, witness):
        told, lives = [], set()
        launcher.report = told.append
        while not told:
            pid = process(launcher.plan.base_port, "supervisor")
            if pid is not None:
                lives.add(pid)
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            await asyncio.sleep(0.002)
        assert len(lives) == 7  # the first and six more
        await eventually(lambda: witness.state("supervisor") == ("running", 8), 20)
        assert len(told) == 1


@pytest.mark.parametrize("word", ["warm", "own", "hot"])
async def test_a_spare_of_version_0_7_means_the_pool_and_is_reported(tmp_path, word):
    file = write_stub_system(tmp_path, pilot_with_spare(word))
    notes: list[str] = []
    options, kind = parse(["--system", str(file), "--no-hmi"], "launch.py")
    plan, spec = plan_of(options, kind, notes.append)
    assert Layout(plan, spec).spare_of(["safety_pilot"]) == "pool"
    assert len(notes) == 1
    assert f"safety_pilot: spare = '{word}'" in notes[0]


class TellingDetection(IdleDetection):
    """Tells what it was started with."""

    def on_start(self) -> None:
        self.report_diagnostic("started with", str(self.context.run.document["title"]), "")


@pytest.mark.alone
async def test_what_starts_after_a_change_of_the_system_knows_it(tmp_path):
    async with running(tmp_path, (
            "tests.stub_actors:IdleDetection",
            "tests.actors.supervision.test_supervision:TellingDetection")) as (launcher, witness):
        port = launcher.plan.base_port
        there, start = await filled(port), len(witness.errors)
        document = load_document(launcher.plan)
        document["title"] = "changed"
        document["node"][0].setdefault("parameters", {})["text"] = "x" * 400_000
        row = next(row for row in document["detection"] if row["name"] == "DM1")
        row.setdefault("parameters", {})["margin_m"] = 0.7
        async with witness.comes_back("DM1"):
            witness.publish(topics.ADAPTED_SYSTEM, AdaptedSystem(
                1, "retune DM1", "me", msgspec.json.encode(document).decode()))
        there = await filled(port, there)
        for victim in ("DM2", "supervisor", "DM3"):
            async with witness.comes_back(victim):
                os.kill(process(port, victim), signal.SIGKILL)
            assert victim != "DM2" or witness.pid("DM2") in there
        titles = [e.reason for e in witness.errors[start:] if e.context == "started with"]
        assert titles == 3 * ["changed"]
