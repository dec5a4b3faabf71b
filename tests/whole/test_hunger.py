"""A system that runs out of something, or has a member that takes too much, or nothing."""

import asyncio
import contextlib
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from benchmarks.bus_flood import FLOOD, JOIN, KINDS, PER_S, Watch
from rampart.actors.bus.zenoh_session import ROUTERS
from rampart.actors.supervision.process_title import find_processes
from rampart.cli.session import connect
from rampart.manager.spec.specification import check_document, read_document
from rampart.testing import RealRun
from tests import ROOT
from tests.actors.access.keyed import layout_of, make_keys
from tests.whole.missions import write_mission

pytestmark = [pytest.mark.slow, pytest.mark.processes, pytest.mark.alone, pytest.mark.timeout(500)]

MORE_MB = 60.0
"""By how much a process may grow meanwhile: mailboxes, queues of the bus, allocators."""

HEARS_ALL = JOIN + """
from rampart.actors.bus.topic import ROOT
with join() as session:
    session.declare_subscriber(ROOT + "/**", lambda sample: None)
    time.sleep(1)
    print("here", flush=True)
    time.sleep(1000)
"""



def full_disk(run: RealRun) -> None:
    """Fill the disk with checkpoints, folder of the run, recording and report; kill; make room."""
    filler = run.directory / "disk" / "filler"
    with contextlib.suppress(OSError), filler.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    time.sleep(3)
    respawn(run, "osmosis_control", "localization")
    time.sleep(3)
    assert "No space left on device" in run.story
    filler.unlink()


def no_descriptor(run: RealRun) -> None:
    """Let no process of the run open anything more: what runs goes on, what ends comes later."""
    held = [process.pid for process in processes(run).values()]
    before = {pid: resource.prlimit(pid, resource.RLIMIT_NOFILE) for pid in held}
    there = pids(run)
    for pid, (_, hard) in before.items():
        resource.prlimit(pid, resource.RLIMIT_NOFILE, (3, hard))
    time.sleep(3)
    assert pids(run) == there
    run.kill("localization")
    time.sleep(3)
    for pid, limits in before.items():
        if psutil.pid_exists(pid):
            resource.prlimit(pid, resource.RLIMIT_NOFILE, limits)
    run.wait_for("localization respawned")


def jumping_clock(run: RealRun) -> None:
    """Have the time of day of the run jump."""
    day_s = 86_400
    with (run.directory / "shift").open("r+b", buffering=0) as shift:
        for jump_s in (400 * day_s, -3000 * day_s, 1, -1, 0):
            shift.seek(0)
            shift.write(jump_s.to_bytes(8, sys.byteorder, signed=True))
            time.sleep(2)
            if jump_s < -1:
                respawn(run, "localization")


def deaf_member(run: RealRun) -> None:
    """Have a member subscribe to everything, and read nothing."""
    before, memory = pids(run), memory_mb(run)
    with member(run, HEARS_ALL) as slow:
        slow.send_signal(signal.SIGSTOP)
        time.sleep(15)
        assert grown(run, memory) == {}
        assert set(ROUTERS) <= memory_mb(run).keys()
        assert pids(run) == before


def respawn(run: RealRun, *nodes: str) -> None:
    """Kill nodes, and wait until they are back."""
    for node in nodes:
        run.kill(node)
    for node in nodes:
        run.wait_for(f"{node} respawned")


def processes(run: RealRun) -> dict[str, psutil.Process]:
    """Return the processes of a run that are there now, the launcher among them."""
    found = {" ".join(p.names): psutil.Process(p.pid) for p in find_processes(run.port)}
    return found | {"launcher": psutil.Process(run.process.pid)}


@contextmanager
def member(run: RealRun, script: str, *arguments: str, key: str | Path = ""
           ) -> Iterator[subprocess.Popen[str]]:
    """Run a script that is told the port of a run to join; wait until it says it is there.

    Args:
        key: with which it joins a run with keys.
    """
    with subprocess.Popen([sys.executable, "-c", script, *arguments, str(run.port)],
                          env={**os.environ, "RAMPART_KEY": str(key)},
                          stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "here\n"
            yield process
        finally:
            process.kill()


def memory_mb(run: RealRun) -> dict[str, float]:
    """Return how much each process holds."""
    return {name: p.memory_info().rss / 1e6 for name, p in processes(run).items()}


def grown(run: RealRun, before: dict[str, float]) -> dict[str, float]:
    """Return which processes hold much more than before."""
    return {name: mb for name, mb in memory_mb(run).items() if mb > before.get(name, mb) + MORE_MB}


def pids(run: RealRun) -> dict[str, int]:
    """Return the processes by name; those of the pool come and go."""
    return {name: p.pid for name, p in processes(run).items() if name != "pool"}


@pytest.fixture
def own_disk_and_clock(tmp_path, monkeypatch):
    """Give runs a small disk for all that they write, and a time of day that may jump."""
    disk, compiler = tmp_path / "disk", shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler: the time of day cannot be changed for one run alone")
    library, shift = tmp_path / "clock_shift.so", tmp_path / "shift"
    subprocess.run([compiler, "-shared", "-fPIC", "-O2", "-o", str(library),
                    str(Path(__file__).with_name("clock_shift.c"))], check=True)
    shift.write_bytes(bytes(8))
    monkeypatch.setattr(RealRun, "command", (
        "env", f"LD_PRELOAD={library}", f"SHIFT_FILE={shift}", *RealRun.command))
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64m,mode=0700", "tmpfs", str(disk)],
        check=False, capture_output=True, text=True)
    if mounted.returncode:
        pytest.skip(f"no file system may be mounted here: {mounted.stderr.strip()}")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(disk))
    yield
    subprocess.run(["umount", "--lazy", str(disk)], check=True)


@pytest.mark.parametrize(("hardship", "restarted"), [
    (full_disk, {"osmosis_control", "localization"}), (no_descriptor, {"localization"}),
    (jumping_clock, {"localization"}), (deaf_member, set())])
@pytest.mark.usefixtures("own_disk_and_clock")
def test_a_mission_succeeds_whatever_runs_out_or_is_wrong_for_a_while(
        tmp_path, hardship, restarted):
    with RealRun(tmp_path, "osmosis", "--mission", str(write_mission(tmp_path, "TAXI")), "--report",
                 "disk/report", "--record", "disk/run.mcap") as run:
        run.wait_for("goal 1/")
        time.sleep(3)
        hardship(run)
        run.wait_until(lambda: run.process.poll() is not None, 150, "it goes on and on")
        code, result = run.result()
    assert (code, result["mission"], result["safety"]) == (0, "success", "safe"), run.story
    assert set(result["restarts"]) >= restarted
    assert hardship is full_disk or set(result["restarts"]) == restarted


@pytest.mark.parametrize("thief", ["", "DM5", "ada"])
def test_a_member_that_floods_delays_no_emergency_stop_and_harms_nobody(tmp_path, thief):
    """The budget of the arbitration is kept by most stops.

    In a run with keys the member has the stolen key of another detection module, and floods what
    that may publish, or an operator's.
    """
    file = ROOT / "systems" / "paper.toml"
    spec = check_document(read_document(file.read_text(encoding="utf-8"), file.name), file.name)
    keys = make_keys(tmp_path / "keys", layout_of("paper")) if thief else None
    with RealRun(tmp_path, "paper", "--patience", "100000",
                 *(("--keys", str(keys)) if keys else ())) as run:
        run.wait_for("goal 1/")
        before, memory = pids(run), memory_mb(run)
        for kind in KINDS:
            with member(run, FLOOD, kind, str(PER_S), "100000", thief if thief != "ada" else "",
                        key=keys / f"{thief}.pem" if keys else ""):
                time.sleep(2)
                took_s = sorted(asyncio.run(_stops(run.port, 7)))
                died = {name for name, pid in pids(run).items() if before[name] != pid}
                assert died <= {thief}, kind  # what is said in its name counts as its own
                assert grown(run, memory) == {}, kind
            assert took_s[len(took_s) // 2] < spec.timing.arbitration_s, (kind, took_s)


async def _stops(port: int, count: int) -> list[float]:
    """Have DM1 see the robot on the grass again and again; seconds from its report to the brake."""
    async with connect(port) as session:
        watch = Watch(session)
        took_s = []
        for number in range(count):
            found = await watch.once(number)
            assert found is not None, "no brake"
            took_s.append(found)
            await asyncio.wait_for(watch.release(), 30.0)
        return took_s


@contextmanager
def busy_processes(*, in_sessions: bool) -> Iterator[None]:
    """Keep many processes busy.

    Args:
        in_sessions: each in a session of its own, as those of other users are. Where the kernel
            shares the processors between sessions (`sched_autogroup_enabled`, sched(7)), many of
            them leave hardly anything; in one session with the system its processes compete with
            each one by itself, and those that sleep a lot run soon when they wake.
    """
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"],
                             start_new_session=in_sessions) for _ in range(64)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
        for process in busy:
            process.wait()


@pytest.mark.parametrize(("kind", "rate"), [("busy", 2), ("sessions", 1), ("second", 2)])
def test_the_mission_goes_on_after_an_overload(tmp_path, kind, rate):
    with RealRun(tmp_path, "osmosis", "--mission", str(write_mission(tmp_path, "TAXI")), "--rate",
                 str(rate), "--patience", "90") as run:
        run.wait_for("goal 1/")
        run.sleep_until(3.0)
        (tmp_path / "second").mkdir()
        with (RealRun(tmp_path / "second", "osmosis", "--rate", "2") if kind == "second"
              else busy_processes(in_sessions=kind == "sessions")):
            time.sleep(15.0)
        _, result = run.result(300)
    assert (result["mission"], result["safety"]) == ("success", "safe"), run.story
