"""Real processes, really killed: what supervision promises whatever the nodes do."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import resource
import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from rampart.actors.bus import run_info
from rampart.actors.bus import topics as bus_topics
from rampart.actors.bus.messages import Diagnostic
from rampart.actors.bus.run_folder import ROUTERS
from rampart.actors.bus.run_info import find_runs
from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import NodeTable, ProcessEvent, RespawnRequest
from rampart.actors.runtime.actor import Actor, Context, Header, on
from rampart.actors.runtime.clock import Clock
from rampart.actors.runtime.run_plan import load_system
from rampart.actors.supervision import guard as guard_module
from rampart.actors.supervision import launcher as launcher_module
from rampart.actors.supervision import node_process
from rampart.actors.supervision.kill_node import main as kill_node
from rampart.actors.supervision.launcher import Launcher, LaunchError
from rampart.actors.supervision.process_title import TITLE_BYTES, find_processes
from rampart.actors.supervision.spawner import address
from rampart.actors.supervision.spawner_client import SpawnerClient, SpawnerUnavailableError
from rampart.actors.supervision.supervised_process import RestartPolicy
from rampart.actors.system.layout import Layout
from rampart.manager.spec.tables import Supervision
from rampart.testing import eventually
from tests import ROOT
from tests.stub_actors import launched, stub_plan, write_stub_system

pytestmark = pytest.mark.processes


class Witness(Actor):
    """Hears what the supervisor says, and may ask it to respawn a node, as RM3 does."""

    outputs = (topics.RESPAWN, topics.ADAPTED_SYSTEM)

    def __init__(self, context: Context, launcher: Launcher) -> None:
        super().__init__(context)
        self.launcher = launcher
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
        self.launcher.supervisor_heard(message)

    def state(self, node: str) -> tuple[str, int]:
        return next(((r.state.value, r.incarnation) for r in self.table.nodes if r.name == node),
                    ("unknown", 0))

    def pid(self, node: str) -> int:
        return next(r.pid for r in self.table.nodes if r.name == node)

    def saw(self, node: str, event: str) -> bool:
        return any(e.node == node and e.event == event for e in self.events)


@asynccontextmanager
async def running(tmp_path, **changes) -> AsyncIterator[tuple[Launcher, Witness]]:
    async with launched(stub_plan(write_stub_system(tmp_path), **changes)) as launcher:
        bus = launcher.observers_bus()
        clock = Clock(launcher.plan.origin_s)
        witness = Witness(Context("observer", 1, clock, bus), launcher)
        task = asyncio.create_task(witness.run())
        try:
            await eventually(lambda: len(witness.table.nodes) == 24 and all(
                r.state.value == "running" for r in witness.table.nodes), 20)
            yield launcher, witness
        finally:
            witness.stop()
            await task


def process(port: int, name: str) -> int | None:
    found = [p for p in find_processes(port) if name in p.names]
    return max(found, key=lambda p: p.incarnation).pid if found else None


async def test_a_process_that_dies_stops_or_wedges_is_told_apart_and_comes_back(tmp_path):
    async with running(tmp_path) as (_, witness):
        for node, number, event in (("DM1", signal.SIGKILL, "crashed"),
                                    ("DM2", signal.SIGSEGV, "crashed"),
                                    ("RM1", signal.SIGTERM, "crashed"),
                                    ("DM3", signal.SIGSTOP, "stopped"),
                                    ("safety_pilot", signal.SIGUSR2, "wedged")):
            os.kill(witness.pid(node), number)
            await eventually(lambda n=node: witness.state(n) == ("running", 2))
            assert witness.saw(node, event)


async def test_a_stopped_process_and_a_dead_supervisor_do_not_end_repair(tmp_path):
    async with running(tmp_path) as (launcher, witness):
        port = launcher.plan.base_port
        os.kill(witness.pid("DM5"), signal.SIGSTOP)
        os.kill(process(port, "supervisor"), signal.SIGKILL)
        await eventually(lambda: witness.state("supervisor") == ("running", 2))
        os.kill(witness.pid("RM1"), signal.SIGKILL)
        await eventually(lambda: witness.state("RM1") == ("running", 2))
        await eventually(lambda: witness.state("DM5") == ("running", 2))
        assert launcher.guard.supervisor_incarnation == 2


async def test_a_node_is_back_while_who_hears_it_is_stopped(tmp_path):
    async with running(tmp_path) as (launcher, witness):
        port = launcher.plan.base_port
        stopped = [process(port, name) for name in ("DM1", "DM2", "DM3", "DM4", "RM2")]
        supervisor = process(port, "supervisor")
        os.kill(supervisor, signal.SIGSTOP)  # it would have them replaced
        for pid in stopped:
            os.kill(pid, signal.SIGSTOP)
        os.kill(process(port, "ftm_manager"), signal.SIGKILL)
        await eventually(lambda: process(port, "ftm_manager") is None)
        os.kill(supervisor, signal.SIGCONT)
        await eventually(lambda: witness.state("ftm_manager")[0] == "running"
                         and witness.state("ftm_manager")[1] > 1)
        assert witness.state("ftm_manager")[1] == 2


async def test_a_node_of_a_recovery_module_waits_for_its_request(tmp_path):
    async with running(tmp_path) as (_, witness):
        os.kill(witness.pid("osmosis_control"), signal.SIGKILL)
        await eventually(lambda: witness.state("osmosis_control") == ("crashed", 1))
        await asyncio.sleep(0.3)
        assert witness.state("osmosis_control") == ("crashed", 1)
        request = RespawnRequest(1, "osmosis_control", 1, "RM3")
        for _ in range(3):  # the same request again changes nothing
            witness.publish(topics.RESPAWN, request)
        await eventually(lambda: witness.state("osmosis_control") == ("running", 2))
        witness.publish(topics.RESPAWN, request)
        await asyncio.sleep(0.2)
        assert witness.state("osmosis_control") == ("running", 2)


async def test_a_request_for_an_unknown_node_is_refused(tmp_path):
    async with running(tmp_path) as (_, witness):
        witness.publish(topics.RESPAWN, RespawnRequest(1, "nobody", 1, "RM3"))
        await eventually(lambda: witness.saw("nobody", "refused"))


async def test_an_observer_hears_the_error_reports_of_all_nodes(tmp_path):
    async with running(tmp_path) as (_, witness):
        names = {r.name for r in witness.table.nodes}
        for _ in range(4):  # all answer at once, once a second, and each answer arrives
            witness.errors.clear()
            await asyncio.sleep(1.0)
            witness.context.bus.publish(bus_topics.INJECT, bus_topics.INJECT.at(), b"garbage")
            await eventually(lambda: names <= {e.node for e in witness.errors})
            assert {e.offender for e in witness.errors} == {bus_topics.INJECT.at()}


async def test_the_world_and_nobody_else_goes_before_others_where_that_is_permitted(tmp_path):
    lower = f"import os; os.setpriority(os.PRIO_PROCESS, 0, {node_process.WORLD_NICE})"
    permitted = subprocess.run([sys.executable, "-c", lower], check=False,
                               stderr=subprocess.DEVNULL).returncode == 0
    own = os.getpriority(os.PRIO_PROCESS, 0)
    async with running(tmp_path) as (_launcher, witness):
        nice = {row.name: {os.getpriority(os.PRIO_PROCESS, int(thread.name))
                           for thread in Path(f"/proc/{row.pid}/task").iterdir()}
                for row in witness.table.nodes}
    assert nice.pop("simulator") == {node_process.WORLD_NICE if permitted else own}
    assert set().union(*nice.values()) == {own}


async def test_the_supervisor_comes_back_and_adopts_the_living(tmp_path):
    async with running(tmp_path) as (launcher, witness):
        before = {r.name: r.pid for r in witness.table.nodes if r.name != "supervisor"}
        for number in (signal.SIGKILL, signal.SIGSTOP):
            generation = launcher.guard.supervisor_incarnation
            os.kill(process(launcher.plan.base_port, "supervisor"), number)
            await eventually(lambda g=generation: witness.state("supervisor")[1] == g + 1)
            await eventually(lambda: all(r.state.value == "running" for r in witness.table.nodes))
        after = {r.name: r.pid for r in witness.table.nodes if r.name != "supervisor"}
        assert after == before


async def test_a_supervisor_that_stood_still_for_a_while_blames_nobody_for_it(tmp_path):
    async with running(tmp_path) as (launcher, witness):
        before = {r.name: r.pid for r in witness.table.nodes}
        supervisor = process(launcher.plan.base_port, "supervisor")
        os.kill(supervisor, signal.SIGSTOP)
        await asyncio.sleep(0.9)  # longer than a heartbeat may be missing, but not for the launcher
        os.kill(supervisor, signal.SIGCONT)
        os.kill(witness.pid("DM3"), signal.SIGSTOP)  # and it still sees who does stand still
        await eventually(lambda: witness.state("DM3") == ("running", 2))
        after = {r.name: r.pid for r in witness.table.nodes}
        assert {n for n, pid in after.items() if pid != before[n]} == {"DM3"}
        assert {e.node for e in witness.events if e.event in {"stopped", "wedged"}} == {"DM3"}


async def test_a_node_that_dies_together_with_the_supervisor_gets_a_new_incarnation(tmp_path):
    async with running(tmp_path) as (launcher, witness):
        os.kill(process(launcher.plan.base_port, "supervisor"), signal.SIGKILL)
        os.kill(witness.pid("DM4"), signal.SIGKILL)
        await eventually(lambda: witness.state("DM4") == ("running", 2))


async def test_nodes_come_back_whatever_happens_to_the_spawners(tmp_path):
    async with running(tmp_path) as (launcher, witness):
        port = launcher.plan.base_port
        for victims, number in ((["spawner_a"], signal.SIGKILL), (["spawner_b"], signal.SIGKILL),
                                (["spawner_a"], signal.SIGSTOP),
                                (["spawner_a", "spawner_b"], signal.SIGKILL)):
            incarnation = witness.state("DM1")[1]
            old = {v: process(port, v) for v in victims}
            for pid in old.values():
                os.kill(pid, number)
            os.kill(witness.pid("DM1"), signal.SIGKILL)
            await eventually(lambda i=incarnation: witness.state("DM1") == ("running", i + 1), 20)
            await eventually(lambda o=old: all(
                process(port, v) not in {None, p} for v, p in o.items()), 20)


async def test_spawners_that_stand_still_for_a_moment_are_not_taken_for_hung(tmp_path):
    async with running(tmp_path) as (launcher, witness):
        port = launcher.plan.base_port
        spawners = {name: process(port, name) for name in ("spawner_a", "spawner_b")}
        for stopped in (["spawner_a"], ["spawner_b"], list(spawners)):
            incarnation = witness.state("DM1")[1]
            for name in stopped:
                os.kill(spawners[name], signal.SIGSTOP)
            os.kill(witness.pid("DM1"), signal.SIGKILL)
            if len(stopped) == 1:  # the other one forks
                await eventually(
                    lambda i=incarnation: witness.state("DM1") == ("running", i + 1))
            else:
                await asyncio.sleep(0.5)
                assert witness.state("DM1")[1] == incarnation
            for name in stopped:
                os.kill(spawners[name], signal.SIGCONT)
            await eventually(lambda i=incarnation: witness.state("DM1") == ("running", i + 1))
        client = SpawnerClient(launcher.plan.folder, port, os.getpid())
        await eventually(lambda: client.turns("a") and client.turns("b"))  # nothing is under way
        client.close()
        assert {name: process(port, name) for name in spawners} == spawners
        assert [p.pid for p in find_processes(port) if "DM1" in p.names] == [witness.pid("DM1")]
        assert witness.state("DM1") == ("running", 4)


async def test_of_two_spawners_that_hang_one_is_replaced_first_and_then_the_other(tmp_path):
    async with running(tmp_path) as (launcher, witness):
        port = launcher.plan.base_port
        old = {name: process(port, name) for name in ("spawner_a", "spawner_b")}
        for pid, number in zip(old.values(), (signal.SIGSTOP, signal.SIGUSR2), strict=True):
            os.kill(pid, number)
        os.kill(witness.pid("DM1"), signal.SIGKILL)
        client = SpawnerClient(launcher.plan.folder, port, os.getpid())
        seen = set()
        while not all(process(port, name) not in {None, pid} for name, pid in old.items()):
            there = {name: process(port, name) for name in old}
            replaced = [name for name, pid in old.items() if there[name] != pid]
            seen.add(len(replaced))
            if len(replaced) == 2:  # the second was killed when the first was back
                assert any(there[name] is not None for name in replaced)
            await asyncio.sleep(0.005)
        client.close()
        assert 1 in seen
        await eventually(lambda: witness.state("DM1") == ("running", 2))


async def test_a_request_that_was_withdrawn_makes_no_process_however_late_it_is_read(tmp_path):
    async with running(tmp_path) as (launcher, witness):
        port = launcher.plan.base_port
        spawners = [process(port, name) for name in ("spawner_a", "spawner_b")]
        for pid in spawners:
            os.kill(pid, signal.SIGSTOP)
        client = SpawnerClient(launcher.plan.folder, port, os.getpid())
        with pytest.raises(SpawnerUnavailableError):
            client.fork(("DM1",), 7)
        client.close()
        for pid in spawners:
            os.kill(pid, signal.SIGCONT)
        client = SpawnerClient(launcher.plan.folder, port, os.getpid())
        await eventually(lambda: client.turns("a") and client.turns("b"))  # it has been read
        client.close()
        await asyncio.sleep(0.2)
        assert [p.incarnation for p in find_processes(port) if "DM1" in p.names] == [1]
        assert witness.state("DM1") == ("running", 1)


@pytest.mark.parametrize("answer", [b"nonsense", b'{"error": 7}', b"{}", b""])
async def test_what_answers_under_a_spawners_name_does_not_end_the_guard(tmp_path, answer):
    async with running(tmp_path) as (launcher, witness):
        port, told, answered = launcher.plan.base_port, [], 0
        launcher.guard.report = told.append
        where = Path(address(launcher.plan.folder, "a"))
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with contextlib.closing(listener):
            where.unlink()
            listener.bind(str(where))
            listener.listen()
            listener.setblocking(False)

            def reply() -> None:
                nonlocal answered
                with contextlib.suppress(OSError):
                    connection, _ = listener.accept()
                    with connection:
                        connection.send(answer)
                    answered += 1

            loop = asyncio.get_running_loop()
            loop.add_reader(listener, reply)
            for name in ("supervisor", "DM1", "spawner_b"):
                before = process(port, name)
                os.kill(before, signal.SIGKILL)
                await eventually(lambda n=name, p=before: process(port, n) not in {None, p}, 20)
            loop.remove_reader(listener)
        await eventually(lambda: process(port, "spawner_a") is not None, 20)
        await eventually(lambda: all(r.state.value == "running" for r in witness.table.nodes), 20)
        assert answered
        assert not launcher.failure


@pytest.mark.parametrize("where", ["_reap", "info", "look_after", "on_restart", "report"])
async def test_whatever_fails_in_the_launcher_is_told_and_ends_no_guard(
        tmp_path, monkeypatch, where):
    failures, told = [], []

    def failing(*_: object) -> None:
        failures.append(where)
        raise RuntimeError("never thought of")

    if where == "_reap":
        monkeypatch.setattr(Launcher, where, failing)
    async with running(tmp_path) as (launcher, witness):
        guard = launcher.guard
        guard.report = told.append
        if where == "look_after":
            usual, guard.look_after = guard.look_after, failing
            await eventually(lambda: len(failures) > 1)
            guard.look_after = usual
        elif where == "on_restart":
            guard.on_restart = failing
        elif where == "report":
            guard.report = failing
            guard._tell("trouble")
        elif where == "info":
            launcher.info = failing
            assert launcher.plan.base_port not in {
                run.base_port for run in await asyncio.to_thread(find_runs)}
        os.kill(process(launcher.plan.base_port, "spawner_a"), signal.SIGKILL)
        os.kill(process(launcher.plan.base_port, "supervisor"), signal.SIGKILL)
        await eventually(lambda: witness.state("supervisor") == ("running", 2), 20)
        await eventually(lambda: process(launcher.plan.base_port, "spawner_a") is not None, 20)
        assert failures
        assert where == "report" or any("RuntimeError: never thought of" in t for t in told)
        assert not launcher.failure
        monkeypatch.undo()


async def test_a_supervisor_without_descriptors_harms_nobody_and_goes_on_when_it_has_some(tmp_path):
    async with running(tmp_path) as (_, witness):
        before = {r.name: r.pid for r in witness.table.nodes}
        limits = resource.prlimit(before["supervisor"], resource.RLIMIT_NOFILE)
        resource.prlimit(before["supervisor"], resource.RLIMIT_NOFILE, (3, limits[1]))
        os.kill(before["DM3"], signal.SIGKILL)
        await eventually(lambda: any(
            e.node == "supervisor" and e.context == "fork" and "open files" in e.reason
            for e in witness.errors))
        resource.prlimit(before["supervisor"], resource.RLIMIT_NOFILE, limits)
        await eventually(lambda: witness.state("DM3")[0] == "running"
                         and witness.state("DM3")[1] > 1)
        os.kill(witness.pid("DM3"), signal.SIGKILL)
        incarnation = witness.state("DM3")[1]
        await eventually(lambda: witness.state("DM3") == ("running", incarnation + 1))
        after = {r.name: r.pid for r in witness.table.nodes}
        assert {n for n, pid in after.items() if pid != before[n]} == {"DM3"}


async def test_a_process_that_nobody_holds_neither_keeps_its_node_down_nor_stays(tmp_path):
    async with running(tmp_path) as (launcher, witness):
        port = launcher.plan.base_port
        os.kill(witness.pid("DM1"), signal.SIGKILL)
        await eventually(lambda: witness.state("DM1") == ("running", 2))
        victim, supervisor = witness.pid("DM1"), process(port, "supervisor")
        os.kill(supervisor, signal.SIGSTOP)
        os.kill(victim, signal.SIGKILL)
        await eventually(lambda: process(port, "DM1") is None)
        client = SpawnerClient(launcher.plan.folder, port, os.getpid())
        orphan = await forked(client, "DM1", 1)  # it is too old to be heard
        client.close()
        os.kill(supervisor, signal.SIGCONT)
        await eventually(lambda: witness.state("DM1")[0] == "running"
                         and witness.pid("DM1") not in {victim, orphan})
        await eventually(lambda: [p.pid for p in find_processes(port) if "DM1" in p.names]
                         == [witness.pid("DM1")])
        assert sum(e.node == "DM1" and e.event == "respawned" for e in witness.events) < 5


async def test_with_the_supervisor_and_both_routers_gone_all_three_come_back(tmp_path):
    async with running(tmp_path) as (launcher, witness):
        victims = ("supervisor", *ROUTERS)
        old = {name: process(launcher.plan.base_port, name) for name in victims}
        for pid in old.values():
            os.kill(pid, signal.SIGKILL)
        await eventually(lambda: all(
            witness.state(name)[0] == "running" and witness.pid(name) != old[name]
            for name in victims), 15)
        await eventually(lambda: all(r.state.value == "running" for r in witness.table.nodes), 15)


async def test_a_stopped_router_is_replaced_and_costs_no_node_its_process(tmp_path):
    async with running(tmp_path) as (_, witness):
        others = {r.name: r.pid for r in witness.table.nodes if r.name != "router_a"}
        os.kill(witness.pid("router_a"), signal.SIGSTOP)
        await eventually(lambda: witness.state("router_a") == ("running", 2))
        assert {r.name: r.pid for r in witness.table.nodes if r.name != "router_a"} == others


async def forked(client: SpawnerClient, name: str, incarnation: int) -> int:
    while True:
        try:
            return client.fork((name,), incarnation)
        except SpawnerUnavailableError:
            await asyncio.sleep(0.01)


async def test_the_launcher_turns_while_supervisor_and_both_spawners_are_dead(tmp_path):
    async with running(tmp_path) as (launcher, witness):
        victims = ("supervisor", "spawner_a", "spawner_b")
        old = {v: process(launcher.plan.base_port, v) for v in victims}
        nodes = {r.name: r.pid for r in witness.table.nodes if r.name not in victims}
        for pid in old.values():
            os.kill(pid, signal.SIGKILL)
        turns = rounds = 0
        look_after = launcher.guard.look_after

        async def counted() -> bool:
            nonlocal rounds
            rounds += 1
            return await look_after()

        launcher.guard.look_after = counted
        while any(process(launcher.plan.base_port, v) in {None, p} for v, p in old.items()):
            await asyncio.sleep(0.01)
            turns += 1
        assert turns > rounds  # it does nothing but look when nothing can be done
        await eventually(lambda: witness.state("supervisor") == ("running", 2), 20)
        assert {r.name: r.pid for r in witness.table.nodes if r.name not in victims} == nodes


async def test_a_supervisor_that_ends_whenever_it_starts_is_not_started_without_end(tmp_path):
    async with running(tmp_path) as (launcher, witness):
        told, lives = [], set()
        launcher.guard.report = told.append
        launcher.guard.policy = RestartPolicy(Supervision(intensity=6, period_s=6.0))
        while not told:
            pid = process(launcher.plan.base_port, "supervisor")
            if pid is not None:
                lives.add(pid)
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            await asyncio.sleep(0.002)
        assert len(lives) == 7  # the first and six more
        assert told == ["the supervisor ended 6 times within 6 s: it is started less often from "
                        "now on"]
        await eventually(lambda: witness.state("supervisor") == (
            "running", launcher.guard.supervisor_incarnation), 20)
        assert launcher.guard.supervisor_incarnation == 8
        assert len(told) == 1


async def test_spawners_are_looked_after_while_a_supervisor_that_keeps_ending_has_to_wait(tmp_path):
    async with running(tmp_path) as (launcher, witness):
        port = launcher.plan.base_port
        launcher.guard.policy = RestartPolicy(
            Supervision(intensity=4, backoff_s=4.0, backoff_max_s=4.0))
        for life in (1, 2, 3):
            await eventually(lambda life=life: (process(port, "supervisor") is not None
                                                and launcher.guard.supervisor_incarnation == life))
            os.kill(process(port, "supervisor"), signal.SIGKILL)
        spawner = process(port, "spawner_b")
        os.kill(spawner, signal.SIGKILL)
        await eventually(lambda: process(port, "spawner_b") not in {None, spawner})
        assert process(port, "supervisor") is None  # it still waits
        await eventually(lambda: witness.state("supervisor") == ("running", 4), 20)


def test_what_fails_before_the_actors_of_a_process_start_is_told(tmp_path, monkeypatch, capfd):
    def broken(*_: object) -> None:
        raise RuntimeError("no title today")

    monkeypatch.setattr(node_process, "set_title", broken)
    plan = stub_plan(write_stub_system(tmp_path))
    layout = Layout(plan, load_system(plan))
    role = node_process.Role(("supervisor",), 3)
    assert node_process.node_main(layout, role, {}, -1) == node_process.EXIT_FAILED
    assert "supervisor #3 failed: RuntimeError: no title today" in capfd.readouterr().err


async def test_a_launcher_that_cannot_look_says_so_once_and_goes_on(tmp_path):
    async with running(tmp_path) as (launcher, witness):
        told, failures = [], 0
        launcher.guard.report = told.append
        look_after = launcher.guard.look_after

        async def without_descriptors() -> bool:
            nonlocal failures
            if failures == 2:
                return await look_after()
            failures += 1
            raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

        launcher.guard.look_after = without_descriptors
        await eventually(lambda: failures == 2)
        os.kill(process(launcher.plan.base_port, "supervisor"), signal.SIGKILL)
        await eventually(lambda: witness.state("supervisor")[1] == 2, 20)
        assert told == ["cannot look after supervisor and spawners: Too many open files"]


async def test_an_orderly_end_leaves_no_process(tmp_path):
    async with running(tmp_path) as (launcher, witness):
        port = launcher.plan.base_port
        os.kill(witness.pid("DM5"), signal.SIGSTOP)
        assert await asyncio.to_thread(find_runs)
    assert find_processes(port) == []


def _catches(pid: int, number: signal.Signals) -> bool:
    status = Path(f"/proc/{pid}/status").read_text()
    caught = next(row.split()[1] for row in status.splitlines() if row.startswith("SigCgt:"))
    return bool(int(caught, 16) >> number - 1 & 1)


async def test_routers_end_last_and_close_no_session_which_makes_zenoh_panic(tmp_path):
    order: list[str] = []
    async with running(tmp_path) as (launcher, _):
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
    await asyncio.wait_for(looking, 12)
    assert set(order[-2:]) == set(ROUTERS)


GUARDS = ("supervisor", "spawner_a", "spawner_b")


@pytest.mark.parametrize("stopped", [
    ("DM5",), (*GUARDS, "DM1", "DM2", "RM1"), None], ids=["one", "the guards too", "all"])
async def test_a_killed_launcher_leaves_nothing_within_two_seconds(tmp_path, stopped):
    system = write_stub_system(tmp_path)
    plan = stub_plan(system)
    script = (
        "import asyncio, sys; from tests.stub_actors import *\n"
        "async def main():\n"
        f"    async with launched(stub_plan({str(system)!r}, base_port={plan.base_port})):\n"
        "        await asyncio.sleep(60)\n"
        "asyncio.run(main())\n")
    child = subprocess.Popen(
        [sys.executable, "-c", script],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        start_new_session=True)  # as a terminal's; this process adopts what is left of others
    try:
        await eventually(lambda: len(find_processes(plan.base_port)) >= 26, 20)
        await asyncio.sleep(0.5)
        os.kill(process(plan.base_port, "DM6"), signal.SIGUSR2)
        for one in find_processes(plan.base_port):  # who is stopped cannot read its lifeline
            if stopped is None or set(one.names) & set(stopped):
                os.kill(one.pid, signal.SIGSTOP)
    finally:
        child.kill()
        child.wait()
    await eventually(lambda: find_processes(plan.base_port) == [], 2.0)
    assert not [r for r in find_runs() if r.base_port == plan.base_port]


@pytest.mark.parametrize(("threads", "variables", "expected"), [
    (1, {**os.environ, "HOME": "." * TITLE_BYTES}, "fork"), (2, os.environ, "program"),
    (1, {}, "program")])  # with so few there is no room for titles in a fork
async def test_a_launcher_that_has_one_thread_forks_its_first_spawner(
        tmp_path, threads, variables, expected):
    plan = stub_plan(write_stub_system(tmp_path))
    file = tmp_path / "x.py"
    file.write_text(
        "import asyncio, threading, time; from tests.stub_actors import *\n"
        f"for _ in range({threads} - 1):\n"
        "    threading.Thread(target=time.sleep, args=(60,), daemon=True).start()\n"
        f"plan = stub_plan({plan.system_file!r}, base_port={plan.base_port})\n"
        "launcher = Launcher(plan, 'test')\n"
        "launcher.begin(forks=True)\n"
        "async def main():\n"
        "    await launcher.load()\n"
        "    await launcher.start()\n"
        "    print('program' if launcher._first else 'fork', flush=True)\n"
        "    await asyncio.sleep(60)\n"
        "asyncio.run(main())\n")
    child = await asyncio.create_subprocess_exec(
        sys.executable, file, stdout=subprocess.PIPE, start_new_session=True,
        env={**variables, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"})
    try:
        kind = await asyncio.wait_for(child.stdout.readline(), 20)
        await eventually(lambda: len(find_processes(plan.base_port)) >= 26, 20)
    finally:
        child.kill()
        await child.wait()

    assert kind.decode().strip() == expected
    await eventually(lambda: find_processes(plan.base_port) == [], 2.0)


async def test_the_guard_reads_all_of_proc_only_when_somebody_is_missing(tmp_path, monkeypatch):
    searches = []

    def searched(*which):
        searches.append(which)
        return find_processes(*which)

    monkeypatch.setattr(guard_module, "find_processes", searched)
    async with running(tmp_path) as (launcher, _):
        assert await launcher.guard.look_after()
        searches.clear()
        assert await launcher.guard.look_after()
        assert not searches

        os.kill(process(launcher.plan.base_port, "spawner_b"), signal.SIGKILL)
        await eventually(lambda: searches)
        await eventually(lambda: len(
            [p for p in find_processes(launcher.plan.base_port) if p.names == ("spawner_b",)]) == 1)


def test_the_number_of_another_run_is_refused_before_anything_starts(tmp_path):
    plan = stub_plan(write_stub_system(tmp_path))
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as other:
        other.bind(run_info.address(plan.base_port))
        with pytest.raises(LaunchError, match=f"--port {plan.base_port}: in use by another run"):
            Launcher(plan, "test").begin()
    assert find_processes(plan.base_port) == []


async def test_an_unsound_spec_is_one_line(tmp_path):
    system = write_stub_system(tmp_path)
    system.write_text(system.read_text().replace('detect = "DM3"', 'detect = "DM9"'))
    launcher = Launcher(stub_plan(system), "test")
    launcher.begin()
    with pytest.raises(LaunchError, match=r"stub\.toml.*DM9") as caught:
        await launcher.load()
    assert "\n" not in str(caught.value)
    await launcher.end()


async def test_a_spawner_that_hangs_while_it_loads_is_ended(tmp_path, monkeypatch):
    """Its output is still read, in a thread that waits for a line."""
    monkeypatch.setattr(launcher_module, "LOAD_TIMEOUT_S", 0.2)
    monkeypatch.setattr(Launcher, "_load", lambda *_: subprocess.Popen(
        ["sleep", "60"], stdin=subprocess.PIPE, stdout=subprocess.PIPE))
    launcher = Launcher(stub_plan(write_stub_system(tmp_path)), "test")
    launcher.begin()
    with pytest.raises(LaunchError, match="did not load within"):
        await launcher.load()
    ending = threading.Thread(target=launcher.abort)
    ending.start()
    await asyncio.to_thread(ending.join, 30)
    assert not ending.is_alive()
    await launcher.end()


async def test_kill_node_signals_one_node_and_names_what_it_does_not_know(tmp_path, capsys):
    async with running(tmp_path) as (launcher, witness):
        port = str(launcher.plan.base_port)
        assert kill_node(["DM1", "--port", port]) == 0
        await eventually(lambda: witness.state("DM1") == ("running", 2))
        for arguments, words in (
                (["DM99", "--port", port], "unknown node 'DM99'"),
                (["DM1", "--signal", "HUG", "--port", port], "unknown signal"),
                (["DM1", "--port", "1"], "no run found on port 1"),
                (["--port", port], "no node given")):
            assert kill_node(arguments) == 2
            error = capsys.readouterr().err
            assert words in error
            assert error.count("\n") == 1


def test_restarts_are_free_at_first_then_slower_then_given_up():
    policy = RestartPolicy(
        Supervision(intensity=6, period_s=10.0, backoff_s=0.1, backoff_max_s=0.25))
    delays = []
    for _ in range(6):
        delays.append(policy.delay_s(0.0))
        policy.restarted(0.0)
    assert delays == [0.0, 0.0, 0.0, 0.1, 0.2, 0.25]
    assert policy.delay_s(0.0) is None
    assert policy.delay_s(10.1) == 0.0
