"""A program as the process of its node holds it: started, ended, and what it has forked."""

from __future__ import annotations

import asyncio
import functools
import os
import resource
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import psutil
import pytest

from rampart.actors.foreign.descendants import descendants, is_below, kill_all
from rampart.actors.foreign.output_log import OutputLog
from rampart.actors.foreign.program_process import ProgramProcess
from rampart.actors.foreign.pulse import NotifySocket
from rampart.actors.machine.unix_peer import process_state
from rampart.manager.spec.nodes import ChildLimits
from rampart.testing import eventually, wait_until

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
        await eventually(lambda: self.ends)
        (end,) = self.ends
        return end



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
    await eventually(lambda: len(descendants(os.getpid())) >= 5)
    pids = descendants(os.getpid())
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
    await eventually(lambda: started.log.exists() and "up" in started.log.read_text())
    os.kill(started.process.pid, signal.SIGSTOP)
    await eventually(lambda: started.process.is_stopped)
    started.process.end()
    assert started.log.read_bytes().endswith(b"bye\n")


@isolated
async def test_daemons_that_end_before_it_leave_no_zombies(tmp_path):
    os.mkfifo(tmp_path / "go")
    started = Started(tmp_path, "for i in 1 2 3; do (setsid sh -c 'echo >> ends' & ); done; "
                                "read _ < go; exit 4")
    ends = tmp_path / "ends"
    await eventually(lambda: ends.exists() and len(ends.read_text()) == 3)
    await eventually(lambda: not any(
        one.status() == psutil.STATUS_ZOMBIE for one in psutil.Process().children()))
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


def test_all_below_a_process_are_found_and_killed():
    with subprocess.Popen(["sh", "-c", "sh -c 'sleep 600; true' & sleep 601; true"]) as parent:
        try:
            wait_until(lambda: len(descendants(parent.pid)) == 3)
            pids = descendants(parent.pid)
            assert all(is_below(pid, parent.pid) for pid in pids)
            assert not is_below(parent.pid, min(pids))
            kill_all(lambda: [pid for pid in pids if process_state(pid) not in "XZ"])
            assert are_gone(pids)
        finally:
            parent.kill()


SEND = """
import os, socket, sys
with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
    notify.sendto(sys.argv[1].encode(), "\\0" + os.environ["NOTIFY_SOCKET"][1:])
print("sent", flush=True)
sys.stdin.read()
"""
SEND_BELOW = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {SEND!r}, 'below'])"


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
    with subprocess.Popen(["sh", "-c", '"$@" <&0 &', "sh", sys.executable, "-c", SEND, "orphan"],
                          env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as gone:
        gone.wait()
        assert gone.stdout.readline() == b"sent\n"  # by a process that lives, and not below
        assert notify.take() == []
        gone.stdin.close()
    assert len(refused) == 2
    notify.close()
