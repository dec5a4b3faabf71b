"""A system that runs out of something, or has a member that takes too much, or nothing."""

from __future__ import annotations

import asyncio
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

class OwnClock:
    """A time of day for a run alone, which may jump."""

    def __init__(self, folder: Path) -> None:
        compiler = shutil.which("cc")
        if compiler is None:
            pytest.skip("no C compiler: the time of day cannot be changed for one run alone")
        library, self._file = folder / "clock_shift.so", folder / "shift"
        subprocess.run([compiler, "-shared", "-fPIC", "-O2", "-o", str(library),
                        str(Path(__file__).with_name("clock_shift.c"))], check=True)
        self.before_command = ("env", f"LD_PRELOAD={library}", f"SHIFT_FILE={self._file}")
        self._file.write_bytes(bytes(8))

    def jump(self, shift_s: int) -> None:
        """Be so far off the true time from now on."""
        with self._file.open("r+b", buffering=0) as shift:
            shift.write(shift_s.to_bytes(8, sys.byteorder, signed=True))


@contextmanager
def small_disk(folder: Path, size_mb: int) -> Iterator[Path]:
    """Mount a file system that is soon full."""
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size_mb}m,mode=0700", "tmpfs", str(folder)],
        check=False, capture_output=True, text=True)
    if mounted.returncode:
        pytest.skip(f"no file system may be mounted here: {mounted.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def fill(folder: Path) -> Path:
    """Write a file until the disk is full."""
    file = folder / "filler"
    with file.open("wb", buffering=0) as filler:
        try:
            while True:
                filler.write(bytes(4096))
        except OSError:
            return file


def processes(run: RealRun) -> dict[str, psutil.Process]:
    """Return the processes of a run that are there now, the launcher among them."""
    found = {" ".join(p.names): psutil.Process(p.pid) for p in find_processes(run.port)}
    return found | {"launcher": psutil.Process(run.process.pid)}


@contextmanager
def no_descriptor_left(run: RealRun) -> Iterator[None]:
    """Let no process of a run open anything more."""
    held = processes(run)
    before = {pid: resource.prlimit(pid, resource.RLIMIT_NOFILE)
              for pid in (process.pid for process in held.values())}
    for pid, (_, hard) in before.items():
        resource.prlimit(pid, resource.RLIMIT_NOFILE, (3, hard))
    try:
        yield
    finally:
        for pid, limits in before.items():
            if psutil.pid_exists(pid):
                resource.prlimit(pid, resource.RLIMIT_NOFILE, limits)


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


def succeeds(run: RealRun) -> dict[str, object]:
    """Wait for the end, and see that it is a good one."""
    run.wait_until(lambda: run.process.poll() is not None, 150, "it goes on and on")
    code, result = run.result()
    assert (code, result["mission"], result["safety"]) == (0, "success", "safe"), run.story
    return result


def memory_mb(run: RealRun) -> dict[str, float]:
    """Return how much each process holds."""
    return {name: p.memory_info().rss / 1e6 for name, p in processes(run).items()}


def pids(run: RealRun) -> dict[str, int]:
    """Return the processes by name; spares come and go."""
    return {name: p.pid for name, p in processes(run).items() if "spare" not in name}


def test_a_full_disk_costs_what_cannot_be_written_and_nothing_else(tmp_path, monkeypatch):
    """Checkpoints, folder of the run, recording and report lie on it."""
    with small_disk(tmp_path / "disk", 16) as disk:
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(disk))
        with RealRun(tmp_path, "osmosis", "--mission", str(write_mission(tmp_path, "TAXI")),
                     "--report", str(disk / "report"), "--record", str(disk / "run.mcap")) as run:
            run.wait_for("goal 1/")
            time.sleep(3)
            full = fill(disk)
            time.sleep(3)
            run.kill("osmosis_control")
            run.kill("localization")
            run.wait_for("localization respawned")
            run.wait_for("osmosis_control respawned")
            time.sleep(3)
            full.unlink()
            result = succeeds(run)
        assert set(result["restarts"]) >= {"osmosis_control", "localization"}
        assert "No space left on device" in run.story


def test_without_a_descriptor_what_runs_goes_on_and_what_ends_comes_back_later(tmp_path):
    with RealRun(tmp_path, "osmosis", "--mission", str(write_mission(tmp_path, "TAXI"))) as run:
        run.wait_for("goal 1/")
        time.sleep(3)
        before = pids(run)
        with no_descriptor_left(run):
            time.sleep(3)
            assert pids(run) == before
            run.kill("localization")
            time.sleep(3)
        run.wait_for("localization respawned")
        succeeds(run)


def test_the_time_of_day_may_jump_in_mid_run(tmp_path, monkeypatch):
    clock, day_s = OwnClock(tmp_path), 86_400
    monkeypatch.setattr(RealRun, "command", (*clock.before_command, *RealRun.command))
    with RealRun(tmp_path, "osmosis", "--mission", str(write_mission(tmp_path, "TAXI"))) as run:
        run.wait_for("goal 1/")
        for jump_s in (400 * day_s, -3000 * day_s, 1, -1, 0):
            clock.jump(jump_s)
            time.sleep(2)
            if jump_s < -1:
                run.kill("localization")
                run.wait_for("localization respawned")
        result = succeeds(run)
    assert result["restarts"] == {"localization": 1}


def test_a_member_that_hears_all_and_reads_nothing_is_let_go_of(tmp_path):
    with RealRun(tmp_path, "osmosis", "--mission", str(write_mission(tmp_path, "TAXI"))) as run:
        run.wait_for("goal 1/")
        before, memory = pids(run), memory_mb(run)
        with member(run, HEARS_ALL) as slow:
            slow.send_signal(signal.SIGSTOP)
            time.sleep(15)
            after = memory_mb(run)
            assert pids(run) == before
        result = succeeds(run)
    assert {name: after[name] - memory[name] for name in memory.keys() & after.keys()
            if after[name] - memory[name] > MORE_MB} == {}
    assert set(ROUTERS) <= after.keys()
    assert result["restarts"] == {}


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
                grown = {n: mb - memory[n] for n, mb in memory_mb(run).items()
                         if n in memory and mb - memory[n] > MORE_MB}
                assert grown == {}, kind
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


@contextmanager
def second_system(folder: Path) -> Iterator[None]:
    """Drive another mission on the same machine."""
    folder.mkdir()
    with RealRun(folder, "osmosis", "--rate", "2"):
        yield


@pytest.mark.parametrize(("kind", "rate"), [("busy", 2), ("sessions", 1), ("second", 2)])
def test_the_mission_goes_on_after_an_overload(tmp_path, kind, rate):
    with RealRun(tmp_path, "osmosis", "--mission", str(write_mission(tmp_path, "TAXI")), "--rate",
                 str(rate), "--patience", "90") as run:
        run.wait_for("goal 1/")
        run.sleep_until(3.0)
        with (second_system(tmp_path / "second") if kind == "second"
              else busy_processes(in_sessions=kind == "sessions")):
            time.sleep(15.0)
        _, result = run.result(300)
    assert (result["mission"], result["safety"]) == ("success", "safe"), run.story
