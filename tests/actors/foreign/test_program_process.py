"""A program as the process of its node holds it: started, ended, and what it has forked."""

from __future__ import annotations

import asyncio
import functools
import os
import resource
import signal
import socket
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any

import pytest

from rampart.actors.foreign.descendants import descendants, is_below, kill_all
from rampart.actors.foreign.output_log import OutputLog
from rampart.actors.foreign.program_process import ProgramProcess
from rampart.actors.foreign.pulse import NotifySocket
from rampart.actors.machine.unix_peer import process_state
from rampart.manager.spec.nodes import ChildLimits
from rampart.testing import eventually
from tests import ROOT

FORKS = """
setsid sh -c 'trap "" TERM; while :; do sleep 600; done' &
env -i /usr/bin/setsid /bin/sleep 601 &
(sleep 602 & )
"""


class Started:
    """A program of `sh`, and how it has ended."""

    def __init__(self, folder: Path, script: str, program: str = "/bin/sh",
                 **limits: float) -> None:
        self.log = folder / "it.log"
        self.ends: list[str] = []
        self.process = ProgramProcess(
            program, ["-c", script], folder=folder, environment=dict(os.environ),
            limits=ChildLimits(**limits), log=OutputLog(self.log), inherited=[],
            ended=self.ends.append)

    async def end(self) -> str:
        """Wait for its end and return it."""
        until_s = time.monotonic() + 10
        while not self.ends and time.monotonic() < until_s:
            await asyncio.sleep(0.005)
        assert len(self.ends) == 1
        return self.ends[0]

    async def forked(self, number: int) -> set[int]:
        """Wait for so many processes, and return them."""
        until_s = time.monotonic() + 10
        while len(found := descendants(os.getpid())) < number and time.monotonic() < until_s:
            await asyncio.sleep(0.01)
        assert len(found) >= number
        return found


def proc(name: str) -> Iterator[Path]:
    """Return such a file of each process."""
    return (file for file in Path("/proc").glob(f"[0-9]*/{name}") if file.exists())


def isolated(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    """Run a test in a process of its own: all that is below it is killed."""

    @functools.wraps(test)
    def fork(*given: object, **named: object) -> None:
        told, tell = os.pipe()
        pid = os.fork()
        if pid == 0:
            code = 1
            try:
                asyncio.run(test(*given, **named))
                code = 0
            except BaseException:
                os.write(tell, traceback.format_exc().encode())
            finally:
                os._exit(code)
        os.close(tell)
        with os.fdopen(told) as text:
            assert os.waitpid(pid, 0)[1] == 0, text.read()

    return fork


def are_gone(pids) -> bool:
    return all(process_state(pid) in "XZ" for pid in pids)


@isolated
async def test_its_end_is_told_once_with_all_that_it_has_printed(tmp_path):
    started = Started(tmp_path, "echo first; echo last >&2; exit 3")
    assert await started.end() == "ended: exit code 3"
    assert started.log.read_text() == "first\nlast\n"
    started.process.kill()  # harmless
    started.process.end()


@pytest.mark.parametrize("how", ["ends", "is killed", "is asked to end"])
@isolated
async def test_all_that_it_has_forked_ends_with_it(tmp_path, how):
    rest = "read _ < go" if how == "ends" else "trap '' TERM; while :; do sleep 603; done"
    os.mkfifo(tmp_path / "go")
    started = Started(tmp_path, FORKS + rest)
    pids = await started.forked(5)
    if how == "ends":
        (tmp_path / "go").write_text("\n")
        assert await started.end() == "ended: exit code 0"
    elif how == "is killed":
        os.kill(started.process.pid, signal.SIGKILL)
        assert await started.end() == "ended: signal SIGKILL"
    else:
        started.process.end()
        assert started.ends == []
    assert are_gone(pids)
    assert descendants(os.getpid()) == set()


@isolated
async def test_it_may_end_in_order_when_it_is_asked_to_also_if_it_is_stopped(tmp_path):
    started = Started(tmp_path, "trap 'head -c 300000 /dev/zero; echo bye; exit' TERM; echo up; "
                                "while :; do sleep 0.01; done")
    while "up" not in (started.log.read_text() if started.log.exists() else ""):
        await asyncio.sleep(0.01)
    os.kill(started.process.pid, signal.SIGSTOP)
    while not started.process.is_stopped:
        await asyncio.sleep(0.01)
    started.process.end()
    assert started.log.read_bytes().endswith(b"bye\n")


@isolated
async def test_daemons_that_end_before_it_leave_no_zombies(tmp_path):
    os.mkfifo(tmp_path / "go")
    started = Started(tmp_path, "for i in 1 2 3; do (setsid sh -c 'echo >> ends' & ); done; "
                                "read _ < go; exit 4")
    ends = tmp_path / "ends"
    await eventually(lambda: ends.exists() and len(ends.read_text()) == 3)
    await eventually(lambda: ["Z", str(os.getpid())] not in [
        file.read_text().rpartition(")")[2].split()[:2] for file in proc("stat")])
    (tmp_path / "go").write_text("\n")
    assert await started.end() == "ended: exit code 4"


@pytest.mark.parametrize(("file", "code", "reason"), [
    ("none", 127, "No such file"), ("no_interpreter", 127, "No such file"),
    ("odd", 127, "not found"), ("not_executable", 126, "Permission denied")])
@isolated
async def test_a_file_that_is_not_a_program_ends_at_once_and_says_why(tmp_path, file, code, reason):
    (tmp_path / "no_interpreter").write_text("#!/nowhere/sh\n")
    (tmp_path / "odd").write_bytes(b"\x7fNONSENSE")  # setpriv has a shell run it
    (tmp_path / "not_executable").write_text("#!/bin/sh\n")
    for name in ("no_interpreter", "odd"):
        (tmp_path / name).chmod(0o755)
    started = Started(tmp_path, "", program=str(tmp_path / file))
    assert await started.end() == f"ended: exit code {code}"
    assert reason in started.log.read_text()


@isolated
async def test_without_setpriv_or_a_folder_nothing_starts_or_is_left(tmp_path, monkeypatch):
    before = len(list(Path("/proc/self/fd").iterdir()))
    with pytest.raises(FileNotFoundError):
        Started(tmp_path / "none", "")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(FileNotFoundError, match="setpriv"):
        Started(tmp_path, "")
    assert len(list(Path("/proc/self/fd").iterdir())) <= before + 3  # of the loop's signals, once
    assert descendants(os.getpid()) == set()


@isolated
async def test_limits_and_signals_are_those_of_the_program_and_not_of_this_process(tmp_path):
    mine = resource.getrlimit(resource.RLIMIT_NOFILE)
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    started = Started(tmp_path, "ulimit -n; ulimit -v; ulimit -t; grep SigIgn /proc/$$/status",
                      memory_mb=512, processor_s=7, open_files=32, file_mb=1)
    await started.end()
    *limits, _, ignored = started.log.read_text().split()
    assert limits == ["32", "500000", "7"]
    assert resource.getrlimit(resource.RLIMIT_NOFILE) == mine
    # signal(7): 32 and 33 are the C library's own, and cannot be reset through it
    assert not [one for one in signal.valid_signals() if int(ignored, 16) >> (one - 1) & 1]
    with pytest.raises(ValueError, match=r"limits\.open_files = .* is above the hard limit"):
        Started(tmp_path, "", open_files=mine[1] + 1)


PARENT = """
import asyncio, os, sys
from pathlib import Path
from rampart.actors.foreign.output_log import OutputLog
from rampart.actors.foreign.program_process import ProgramProcess
from rampart.manager.spec.nodes import ChildLimits

async def main():
    ProgramProcess("/bin/sh", ["-c", sys.argv[2]], folder=Path(sys.argv[1]),
                   environment=dict(os.environ), limits=ChildLimits(),
                   log=OutputLog(Path(sys.argv[1], "it.log")), inherited=[], ended=print)
    await asyncio.sleep(600)

asyncio.run(main())
"""


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSEGV])
def test_the_program_ends_with_the_process_of_its_node(tmp_path, number):
    parent = subprocess.Popen([sys.executable, "-c", PARENT, str(tmp_path), "sleep 600; true"],
                              cwd=ROOT)
    try:
        until_s = time.monotonic() + 20
        while len(pids := descendants(parent.pid)) < 2 and time.monotonic() < until_s:
            time.sleep(0.01)
        program = next(pid for pid in pids if is_below(pid, parent.pid)
                       and Path(f"/proc/{pid}/stat").read_text().split()[3] == str(parent.pid))
        os.kill(parent.pid, number)
        parent.wait()
        while process_state(program) not in "XZ" and time.monotonic() < until_s:
            time.sleep(0.001)
        assert process_state(program) in "XZ"
    finally:
        kill_all(lambda: [pid for pid in pids if process_state(pid) not in "XZ"])


SEND = """
import os, socket, sys
with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
    notify.sendto(sys.argv[1].encode(), "\\0" + os.environ["NOTIFY_SOCKET"][1:])
print("sent", flush=True)
sys.stdin.read()
"""
SEND_BELOW = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {SEND!r}, 'below'])"


NODE = """
from rampart.actors.foreign.pulse import NotifySocket
refused = []
notify = NotifySocket("wheels", lambda *why: refused.append(why))
print(notify.name, flush=True)
input()
print(notify.take(), len(refused))
"""


def test_a_datagram_of_a_living_descendant_counts_and_no_other():
    refused: list[tuple[str, str]] = []
    notify = NotifySocket("wheels", lambda *why: refused.append(why))
    environment = {**os.environ, "NOTIFY_SOCKET": notify.name}
    with subprocess.Popen([sys.executable, "-c", SEND_BELOW], env=environment,
                          stdin=subprocess.PIPE, stdout=subprocess.PIPE) as below:
        assert below.stdout.readline() == b"sent\n"
        assert notify.take() == ["below"]
        below.stdin.close()
    assert refused == []
    subprocess.run([sys.executable, "-c", SEND, "ended"], env=environment, check=True,
                   stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    assert notify.take() == []
    assert len(refused) == 1
    notify.close()
    with subprocess.Popen([sys.executable, "-c", NODE], cwd=ROOT, text=True,
                          stdin=subprocess.PIPE, stdout=subprocess.PIPE) as node:
        name = node.stdout.readline().strip()
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as stranger:  # above, alive
            stranger.sendto(b"WATCHDOG=1", f"\0{name[1:]}")
        assert node.communicate("\n")[0] == "[] 1\n"
