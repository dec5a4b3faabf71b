"""The root: it brings back the supervisor, keeps the pool, and leaves nothing when it ends."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import signal
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import msgspec
import pytest
import pytest_asyncio

from rampart.actors.bus.run_info import find_runs
from rampart.actors.ftm import topics
from rampart.actors.ftm.messages import AdaptedSystem
from rampart.actors.runtime.run_plan import load_document
from rampart.actors.supervision.process_title import find_processes
from rampart.actors.system.layout import Layout
from rampart.cli import systems
from rampart.cli.analyse.check_verbs import explain
from rampart.cli.run_options import parse, plan_of
from rampart.testing import eventually
from tests import ROOT
from tests.actors.supervision.test_supervision import process, running
from tests.stub_actors import IdleDetection, stub_plan, write_stub_system

pytestmark = pytest.mark.asyncio(loop_scope="module")

HURTS = (signal.SIGKILL, signal.SIGSTOP)


def pool(port: int) -> set[int]:
    return {p.pid for p in find_processes(port) if p.names == ("pool",)}


async def filled(port: int, other_than: set[int] = frozenset()) -> set[int]:
    """Return the pool when it is full, and has had time to be ready."""
    await eventually(lambda: len(pool(port)) == 2 and other_than.isdisjoint(pool(port)), 20)
    await asyncio.sleep(0.3)
    return pool(port)


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
    await eventually(run[1].all_run, 20)
    return run[1]


@pytest.fixture
def port(run):
    return run[0].plan.base_port


@pytest.mark.processes
@pytest.mark.alone
async def test_without_a_pool_the_next_supervisor_is_forked_and_no_node_is_started_twice(
        witness, port):
    there = await filled(port)
    nodes = {p.pid for p in find_processes(port)} - there - {process(port, "supervisor")}
    _, before = witness.state("supervisor")
    for pid in (*there, process(port, "supervisor")):
        os.kill(pid, signal.SIGKILL)

    def is_back():  # one that was dying may have taken the request
        state, incarnation = witness.state("supervisor")
        return state == "running" and incarnation > before

    await eventually(is_back)
    assert nodes <= {p.pid for p in find_processes(port)}


@pytest.mark.processes
@pytest.mark.alone
async def test_a_supervisor_that_dies_with_requests_under_way_leaves_one_process_of_each_node(
        witness, port):
    for life in range(2, 6):
        async with witness.comes_back("supervisor"):
            for name in ("DM1", "DM2", "DM3"):
                os.kill(witness.pid(name), signal.SIGKILL)
            await asyncio.sleep(0.002 * life)
            os.kill(process(port, "supervisor"), signal.SIGKILL)
        await eventually(witness.all_run)
        there = [name for p in find_processes(port) for name in p.names if name != "pool"]
        assert len(there) == len(set(there))


@pytest.mark.processes
@pytest.mark.alone
async def test_what_dies_is_made_of_the_pool_and_a_node_without_a_spare_is_forked(witness, port):
    there = await filled(port)
    async with witness.comes_back("safety_pilot"):
        os.kill(witness.pid("safety_pilot"), signal.SIGKILL)
    assert witness.pid("safety_pilot") not in there
    async with witness.comes_back("DM1", "DM2"):
        for name in ("DM1", "DM2"):  # together
            os.kill(witness.pid(name), signal.SIGKILL)
    assert {witness.pid("DM1"), witness.pid("DM2")} == there
    there = await filled(port)
    async with witness.comes_back("supervisor"):
        os.kill(process(port, "supervisor"), signal.SIGKILL)
    assert process(port, "supervisor") in there


@pytest.mark.processes
@pytest.mark.alone
async def test_a_process_of_the_pool_that_cannot_become_a_node_costs_only_itself(witness, port):
    there = await filled(port)
    for hurt in HURTS:
        there, life = await filled(port, {witness.pid("DM1")}), witness.state("DM1")[1]
        for pid in there:
            os.kill(pid, hurt)
        os.kill(witness.pid("DM1"), signal.SIGKILL)
        await eventually(lambda n=life: witness.state("DM1")[0] == "running"
                         and witness.state("DM1")[1] > n)
        assert witness.pid("DM1") not in there
    there = await filled(port, there)
    for hurt in HURTS:  # it is replaced though no node needs it
        for pid in there:
            os.kill(pid, hurt)
        there = await filled(port, there)


@pytest.mark.processes
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


@pytest.mark.processes
@pytest.mark.alone
async def test_what_starts_after_a_change_of_the_system_knows_it(tmp_path):
    async with running(tmp_path, (
            "tests.stub_actors:IdleDetection",
            "tests.actors.supervision.test_root:TellingDetection")) as (launcher, witness):
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


# -- start and end ---------------------------------------------------------------------------------


@asynccontextmanager
async def started(tmp_path: Path, after_s: float | None = None
                  ) -> AsyncIterator[tuple[subprocess.Popen[str], int]]:
    """Start a run of the stub system by its root; yield that and the base port.

    Args:
        tmp_path: Folder of its files.
        after_s: When to yield; by default when all its processes are there.
    """
    plan = stub_plan(write_stub_system(tmp_path))
    port = plan.base_port
    with subprocess.Popen(
            [sys.executable, "-P", str(ROOT / "launch.py"), "--system", plan.system_file,
             "--no-hmi", "--port", str(port), "--report", str(tmp_path / "report"), "--json"],
            env={**os.environ, "PYTHONPATH": str(ROOT)}, text=True, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, start_new_session=True) as root:
        try:
            if after_s is None:
                await eventually(lambda: len(find_processes(port)) >= 26, 20)
            else:
                await asyncio.sleep(after_s)
            yield root, port
        finally:
            root.kill()


@pytest.mark.processes
@pytest.mark.parametrize("stopped", [("supervisor", "DM1", "DM2", "RM1"), None])
async def test_a_killed_root_leaves_nothing_within_two_seconds(tmp_path, stopped):
    async with started(tmp_path) as (root, port):
        await asyncio.sleep(0.5)
        folder = next(run.folder for run in find_runs() if run.base_port == port)
        os.kill(process(port, "DM6"), signal.SIGUSR2)
        for one in find_processes(port):
            if stopped is None or set(one.names) & set(stopped):
                os.kill(one.pid, signal.SIGSTOP)
        root.kill()
        await eventually(lambda: find_processes(port) == [] and not Path(folder).exists(), 2.0)
    assert not [run for run in find_runs() if run.base_port == port]


@pytest.mark.processes
async def test_a_stopped_watching_process_is_continued_and_without_it_the_verdict_is_not_known(
        tmp_path):
    async with started(tmp_path) as (root, port):
        described = {p.name for p in explain(systems.check(str(tmp_path / "stub.toml"))).processes}
        assert {"+".join(p.names) for p in find_processes(port)} <= described
        pid = process(port, "run")
        os.kill(pid, signal.SIGSTOP)
        await eventually(lambda: Path(f"/proc/{pid}/stat").read_text().split()[2] != "T", 1.0)
        os.kill(pid, signal.SIGKILL)
        out, err = await asyncio.to_thread(root.communicate, timeout=10)
    assert root.returncode == 4
    result = msgspec.json.decode(out.splitlines()[-1])
    assert result["safety"] == "not known"
    assert any("was killed" in reason for reason in result["reasons"])
    assert "was killed by SIGKILL" in err
    assert find_processes(port) == []


@pytest.mark.processes
@pytest.mark.parametrize("at_s", [0.05, 0.8])
async def test_ctrl_c_at_any_moment_of_the_start_leaves_nothing(tmp_path, at_s):
    async with started(tmp_path, at_s) as (root, port):
        root.send_signal(signal.SIGINT)
        _, err = await asyncio.to_thread(root.communicate, timeout=20)
    assert root.returncode in {1, 4, -signal.SIGINT}  # the last before anything is loaded
    # Python's own words, before the first line of ours has let ctrl-C end the process at once.
    before = err.startswith("Fatal Python error") or not re.search(r"/(actors|cli|sim)/", err)
    assert before or "Traceback" not in err
    assert find_processes(port) == []
