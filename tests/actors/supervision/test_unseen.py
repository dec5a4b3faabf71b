"""What a run tells and lets go: failures on event loops, its end and why, watchdogs that starve."""

import asyncio
import contextlib
import io
import os
import re
import resource
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from benchmarks.own_root import new_root
from rampart.actors.bus.run_info import find_runs
from rampart.actors.osmosis.application import Osmosis
from rampart.actors.runtime.run_context import RunContext
from rampart.actors.runtime.run_plan import load_system
from rampart.actors.supervision.process_title import find_processes, process_state
from rampart.actors.supervision.root import needed_of
from rampart.actors.supervision.unseen import report_callbacks, watch
from rampart.cli.main import main
from rampart.sim.osmosis.trial.mission_trial import MissionTrial
from rampart.sim.runs.process_run import ProcessRun
from rampart.testing import RealRun, free_base_port, turns, wait_until
from tests import ROOT
from tests.stub_actors import Idler, launched, stub_plan, write_stub_system


class Stumbler(Idler):
    """Raises where no mailbox is: in a callback and in a task that nobody waits for."""

    def on_start(self) -> None:
        async def forgotten() -> None:
            raise RuntimeError("forgotten")

        loop = asyncio.get_running_loop()
        loop.call_soon(fail, "stumbled")
        self.task = loop.create_task(forgotten())
        self.task.add_done_callback(lambda _: delattr(self, "task"))


def fail(why: str) -> None:
    raise RuntimeError(why)


async def test_the_end_of_a_task_is_told_unless_it_was_cancelled():
    told: list[str] = []

    async def failing() -> None:
        fail("two\nlines")

    async def ending() -> None:
        pass

    for make, what in ((failing, "one"), (ending, "another"), (asyncio.Event().wait, "a third")):
        watch(asyncio.create_task(make()), what, told.append)
    await turns()
    assert told == ["one failed: RuntimeError: two lines", "another ended by itself"]
    for task in asyncio.all_tasks() - {asyncio.current_task()}:
        task.cancel()
    await turns()
    assert len(told) == 2


async def test_what_a_callback_raises_is_told_once_and_a_flood_of_it_is_bounded():
    told: list[str] = []
    loop = asyncio.get_running_loop()
    report_callbacks(loop, told.append)
    for _ in range(3):
        loop.call_soon(fail, "again")
    await turns()
    assert len(told) == 1
    assert told[0].startswith("Exception in callback fail('again')")
    assert told[0].endswith(": RuntimeError: again")
    for number in range(500):
        loop.call_soon(fail, str(number))
    await turns()
    assert len(told) == 100


@pytest.mark.processes
async def test_what_a_nodes_callbacks_and_forgotten_tasks_raise_is_told_and_it_goes_on(
        tmp_path, capfd):
    system = write_stub_system(tmp_path, (
        "tests.stub_actors:IdlePose", "tests.actors.supervision.test_unseen:Stumbler"))
    async with launched(stub_plan(system)) as launcher:
        said = ""
        async with asyncio.timeout(20):
            while not ("RuntimeError: stumbled" in said and "RuntimeError: forgotten" in said):
                await asyncio.sleep(0.05)
                said += capfd.readouterr().err
        assert [p.incarnation for p in find_processes(launcher.plan.base_port)
                if "localization" in p.names] == [1]
    lines = [line for line in said.splitlines() if "RuntimeError" in line]
    assert len(lines) == 2
    assert all(line.startswith("rampart: localization #1: ") for line in lines)


def broken_sink(_topic: object, message: object, _header: object) -> None:
    if type(message).__name__ == "NodeTable":
        fail("no room for tables")


WHY = "the launcher's observer failed: RuntimeError: no room for tables"


@pytest.mark.processes
async def test_a_run_whose_observer_fails_ends_in_order_and_says_why(tmp_path, monkeypatch):
    plan = stub_plan(write_stub_system(tmp_path))
    stream = io.StringIO()
    known = Osmosis(Osmosis.Options(airport="vallombre", mission="AB"))
    mission = MissionTrial(RunContext(plan, load_system(plan), application=known), 60.0, stream)
    usual = mission.sinks
    monkeypatch.setattr(mission, "sinks", lambda clock: [*usual(clock), broken_sink])
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    async with asyncio.timeout(30):
        root, link = new_root()
        record = await ProcessRun(mission, link).run()
        await asyncio.to_thread(root.wait)
    assert (record.mission, record.safety) == ("fail", "not known")
    assert f"ended: {WHY}" in record.reasons
    assert WHY in stream.getvalue()
    assert find_processes(plan.base_port) == []


@pytest.mark.processes
async def test_a_run_may_open_as_many_files_as_the_hard_limit_allows(tmp_path):
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (256, before[1]))
    try:
        async with launched(stub_plan(write_stub_system(tmp_path))) as launcher:
            for process in find_processes(launcher.plan.base_port):
                assert resource.prlimit(process.pid, resource.RLIMIT_NOFILE)[0] == before[1]
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


LACKING_CAPABILITIES = ["--inh-caps=-all,+dac_override", "--ambient-caps=-all,+dac_override"]
NO_PROCESSES = [pytest.param(
    ["setpriv", "--reuid=47112", "--regid=47112", "--clear-groups", *LACKING_CAPABILITIES,
     "prlimit", f"--nproc={processes}"], "", id=f"{processes} processes",
    marks=pytest.mark.skipif(os.getuid() != 0 or not shutil.which("setpriv"),
                             reason="only root can be a user who may start no process"))
    for processes in (1, 3, 60)]
NO_FILES = pytest.param(
    ["sh", "-c", 'ulimit -n 64; exec "$@"', "sh"],
    f"the hard limit is 64, and 23 processes need {needed_of(resource.RLIMIT_NOFILE, 23)}",
    id="64 files")


@pytest.mark.processes
@pytest.mark.parametrize(("limited", "words"), [*NO_PROCESSES, NO_FILES])
def test_a_run_that_may_have_too_few_processes_or_files_is_refused_in_one_line(
        tmp_path, limited, words):
    result = subprocess.run(
        [*limited, sys.executable, str(ROOT / "launch.py"), "--system", "paper", "--no-hmi",
         "--port", str(free_base_port()), "--report", str(tmp_path / "report")],
        check=False, capture_output=True, text=True, timeout=60)
    assert (result.returncode, result.stderr.count("\n")) == (2, 1), result.stderr
    assert words in result.stderr
    assert not (tmp_path / "report").exists()


KEPT_MB = """
import ctypes
import psutil
from rampart.actors.supervision.router import LARGE_BYTES, Router
from rampart.testing.virtual import VirtualSystem, run

async def one():
    async with VirtualSystem() as system:
        system.start("router_a", Router)

if {as_router}:
    run(one)
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
before, large, small = psutil.Process().memory_info().rss, [], []
for _ in range(400):
    large.append(libc.malloc(2 * LARGE_BYTES))
    ctypes.memset(large[-1], 1, 2 * LARGE_BYTES)
    small.append(libc.malloc(LARGE_BYTES // 2))
for block in large:
    libc.free(block)
print((psutil.Process().memory_info().rss - before) / 1e6)
"""
"""What a process has more, when all that was large, 26 MB, has been freed."""


@pytest.mark.parametrize(("as_router", "least", "most"), [(True, -1, 10), (False, 20, 40)])
def test_a_router_keeps_nothing_of_what_was_large(as_router, least, most):
    done = subprocess.run([sys.executable, "-c", KEPT_MB.format(as_router=as_router)],
                          capture_output=True, text=True, check=True, timeout=60)
    assert least < float(done.stdout) < most


# -- start and end ---------------------------------------------------------------------------------


@pytest.fixture
def stub(tmp_path, monkeypatch):
    """A run of the stub system, not yet begun."""
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setattr(RealRun, "command", (sys.executable, "-P", str(ROOT / "launch.py")))
    return RealRun(tmp_path, write_stub_system(tmp_path))


def all_are_there(run: RealRun) -> bool:
    return len(find_processes(run.port)) >= 26


@pytest.mark.processes
@pytest.mark.parametrize("stopped", [("supervisor", "DM1", "DM2", "RM1"), None])
def test_a_killed_root_leaves_nothing_within_two_seconds(stub, stopped):
    with stub as run:
        run.wait_until(lambda: all_are_there(run), 20, "no processes")
        folder = Path(run.info.folder)
        run.kill("DM6", signal.SIGUSR2)
        for one in find_processes(run.port):
            if one.pid != run.process.pid and (stopped is None or set(one.names) & set(stopped)):
                os.kill(one.pid, signal.SIGSTOP)
        run.process.kill()
        run.process.wait()
        run.wait_until(
            lambda: find_processes(run.port) == [] and not folder.exists()
            and f"rampart.{run.port}." not in Path("/proc/net/unix").read_text()
            and not list(Path("/dev/shm").glob(f"rampart-{run.port}-*"))
            and not list(Path("/tmp").glob(f"*rampart*{run.port}*")), 2.0, "something is left")
    assert not [one for one in find_runs() if one.base_port == run.port]


@pytest.mark.processes
def test_a_stopped_watching_process_is_continued_and_without_it_the_verdict_is_not_known(stub):
    with stub as run:
        run.wait_until(lambda: all_are_there(run), 20, "no processes")
        pid = run.kill("run", signal.SIGSTOP)
        run.wait_until(lambda: process_state(pid) != "T", 1.0, "it is not continued")
        os.kill(pid, signal.SIGKILL)
        code, result = run.result(10)
    assert (code, result["safety"]) == (4, "not known")
    assert any("was killed" in reason for reason in result["reasons"])
    assert "was killed by SIGKILL" in run.story


@pytest.mark.processes
@pytest.mark.parametrize("at_s", [0.05, 0.8])
def test_ctrl_c_at_any_moment_of_the_start_leaves_nothing(stub, at_s):
    with stub as run:
        time.sleep(at_s)
        run.process.send_signal(signal.SIGINT)
        run.process.wait(20)
    assert run.process.returncode in {1, 4, -signal.SIGINT}  # the last before anything is loaded
    # Python's own words, before the first line of ours has let ctrl-C end the process at once.
    before = run.story.startswith("Fatal Python error") or not re.search(
        r"/(actors|cli|sim)/", run.story)
    assert before or "Traceback" not in run.story


STARVED_S = 2.0


class Device:
    """A pipe in the place of a watchdog device."""

    def __init__(self, path: Path) -> None:
        os.mkfifo(path)
        self.path = path
        self.fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        self.fed = b""

    def read(self) -> bytes:
        """Return what was written since the last call."""
        new = b""
        with contextlib.suppress(BlockingIOError):
            while data := os.read(self.fd, 4096):
                new += data
        self.fed += new
        return new

    def starves(self, within_s: float) -> bool:
        """Whether nothing is written for STARVED_S, soon."""
        until_s = time.monotonic() + within_s
        last_s = time.monotonic()
        while time.monotonic() < until_s:
            now_s = time.monotonic()
            last_s = now_s if self.read() else last_s
            if now_s - last_s > STARVED_S:
                return True
            time.sleep(0.05)
        return False

    def is_fed(self) -> None:
        """Wait until it is fed five times more."""
        count = len(self.fed) + 5
        wait_until(lambda: self.read() is not None and len(self.fed) >= count, 30,
                   lambda: "the device is not fed")


@pytest.fixture
def device(tmp_path):
    made = Device(tmp_path / "watchdog")
    yield made
    os.close(made.fd)


@pytest.fixture
def notified(tmp_path, monkeypatch):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(tmp_path / "notify"))
        systemd.settimeout(30)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        yield systemd


def waiting(notified: socket.socket) -> list[bytes]:
    """Return the messages that wait in the queue."""
    texts = []
    notified.setblocking(False)
    with contextlib.suppress(BlockingIOError):
        while True:
            texts.append(notified.recv(100))
    return texts


def test_a_run_feeds_both_unless_root_and_supervisor_stand_and_disarms_the_device_at_its_end(
        tmp_path, device, notified):
    with RealRun(tmp_path, "paper", "--watchdog", str(device.path)) as run:
        assert notified.recv(100) == b"READY=1\nWATCHDOG=1"
        run.wait_for("running")
        device.is_fed()
        assert notified.recv(100) == b"WATCHDOG=1"
        run.kill("ftm_manager")
        device.is_fed()
        run.kill("supervisor", signal.SIGSTOP)
        run.process.send_signal(signal.SIGSTOP)
        assert device.starves(20)
        run.process.send_signal(signal.SIGCONT)
        device.is_fed()
        waiting(notified)  # a full queue takes no more, and this test reads it only now
        run.process.send_signal(signal.SIGTERM)
        run.process.wait(20)
    device.read()
    assert device.fed.strip(b".") == b"V"
    texts = waiting(notified)
    assert texts[-1] == b"STOPPING=1"
    assert texts.count(b"STOPPING=1") == 1


def test_a_manager_that_hangs_at_each_start_starves_them_and_a_killed_root_leaves_it_armed(
        tmp_path, device):
    with RealRun(tmp_path, "paper", "--watchdog", str(device.path), "--fault",
                 "hang:ftm_manager@2") as run:
        run.wait_for("running")
        device.is_fed()
        assert device.starves(30)
        assert run.process.poll() is None
        run.process.kill()
        run.process.wait()
        wait_until(lambda: os.read(device.fd, 4096) == b"", 10, lambda: "the device is still open")
        assert b"V" not in device.fed


def test_a_device_that_cannot_be_opened_and_one_in_virtual_time_are_one_line(tmp_path, refused):
    assert "not with --virtual" in refused("run", "--virtual", "--watchdog", "/dev/null")
    done = subprocess.run(
        [sys.executable, "-m", "rampart.cli.run", "--no-hmi", "--watchdog", "/dev/nothing",
         "--report", str(tmp_path)], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 2
    assert done.stderr == "launch.py: --watchdog /dev/nothing: No such file or directory\n"


def test_the_unit_of_a_system_names_its_options(capsys):
    assert main(["service", "paper", "--user", "anna", "--watchdog-s", "5",
                 "--options=--no-hmi --mission 'A b%$'"]) == 0
    unit = capsys.readouterr().out
    assert "\nType=notify\nUser=anna\n" in unit
    assert "\nWatchdogSec=5\n" in unit
    command = next(line for line in unit.splitlines() if line.startswith("ExecStart="))
    assert command.endswith('/paper.toml --no-hmi --mission "A b%%$$"')


@pytest.mark.parametrize(("arguments", "words"), [
    (["nothing.toml"], "nothing.toml: no such file"),
    (["paper", "--watchdog-s", "0.5"], "--watchdog-s 0.5: expected 1 to 3600"),
    (["paper", "--options='"], "No closing quotation"),
    (["paper", "--options=--nonsense"], "--nonsense: not an option")])
def test_a_unit_that_could_not_start_is_refused(refused, arguments, words):
    assert words in refused("service", *arguments)
