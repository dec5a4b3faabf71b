"""The process of a command's program, as the process of its node holds it.

The node's process is parent and subreaper of all that the program forks, whatever session that puts
itself into: when the program has ended, all of it is killed before anything else follows. If the
node's process is killed, the kernel kills the program; see `descendants` for what that had forked.
When the root of the run ends, the node's process is asked to end (SIGTERM, others are killed), for
what its program has forked could not be found any more.

Output is read as fast as it comes, so the program never waits for that.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import math
import os
import resource
import signal
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from rampart.actors.foreign.descendants import descendants, kill_all
from rampart.actors.foreign.output_log import OutputLog
from rampart.actors.machine.unix_peer import process_state
from rampart.manager.spec.nodes import ChildLimits

GRACE_S = 0.3
"""Wall seconds that a program has to end in order, when it is asked to by SIGTERM."""

_READ_BYTES = 1 << 16
_READS_AT_ONCE = 64
_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36
_libc = ctypes.CDLL(None, use_errno=True)
_reported: dict[int, Callable[[int], None]] = {}
"""By program, what to call with its status when it has ended."""


class ProgramProcess:
    """A program, from its start to its end.

    Args:
        program: Path of the file.
        arguments: As the program gets them, its name first.
        folder: In which it runs.
        environment: All of it.
        limits: What it may use.
        log: Takes its output.
        inherited: Descriptors that it gets.
        ended: Called on the event loop, when nothing of it is left, with how it has ended.

    Raises:
        OSError: It cannot be started.
        ValueError: A limit is above what this process may set.
    """

    def __init__(self, program: str, arguments: Sequence[str], *, folder: Path,
                 environment: Mapping[str, str], limits: ChildLimits, log: OutputLog,
                 inherited: Sequence[int], ended: Callable[[str], None]) -> None:
        self._log = log
        self._ended = ended
        self._loop = asyncio.get_running_loop()
        self._loop.add_signal_handler(signal.SIGCHLD, _reap)
        _libc.prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
        _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
        output, printed = os.pipe()
        try:
            process = subprocess.Popen(  # noqa: S603 what the system names
                arguments, executable=program, cwd=folder, env=environment,
                stdin=subprocess.DEVNULL, stdout=printed, stderr=printed, pass_fds=inherited,
                start_new_session=True,
                preexec_fn=_preparation(limits))  # noqa: PLW1509 it takes no lock
        except BaseException:
            os.close(output)
            raise
        finally:
            os.close(printed)
        self.pid = process.pid
        process.returncode = 0  # it is waited for in `_reap`
        _reported[self.pid] = self._over
        os.set_blocking(output, False)
        self._output = output
        self._loop.add_reader(output, self._read, 1)

    @property
    def is_stopped(self) -> bool:
        """Whether it was stopped from outside (SIGSTOP)."""
        return process_state(self.pid) in "Tt"

    def kill(self) -> None:
        """End it at once; `ended` is called when it is gone."""
        if self.pid in _reported:  # else its number may be that of another process
            os.kill(self.pid, signal.SIGKILL)

    def end(self) -> None:
        """Ask it to end, and return when nothing of it is left; waits `GRACE_S` and little more."""
        if _reported.pop(self.pid, None) is None:
            return
        until_s = time.monotonic() + GRACE_S
        for number in (signal.SIGTERM, signal.SIGCONT):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.pid, number)
        while process_state(self.pid) not in "ZX" and time.monotonic() < until_s:
            time.sleep(0.002)
            self._read()
        self._leave_nothing()

    def _over(self, status: int) -> None:
        self._leave_nothing()
        self._ended(f"ended: {in_words(status)}")

    def _leave_nothing(self) -> None:
        _kill_descendants()
        self._read()
        self._loop.remove_reader(self._output)
        os.close(self._output)

    def _read(self, times: int = _READS_AT_ONCE) -> None:
        for _ in range(times):
            try:
                data = os.read(self._output, _READ_BYTES)
            except BlockingIOError:
                return
            if not data:  # no process is left that could print
                self._loop.remove_reader(self._output)
                return
            self._log.write(data)


def _reap() -> None:
    with contextlib.suppress(ChildProcessError):
        while (ended := os.waitpid(-1, os.WNOHANG))[0]:
            if over := _reported.pop(ended[0], None):
                over(ended[1])


def _kill_descendants() -> None:
    """Kill all that is below this process; a look into /proc only if there is anything."""

    def left() -> set[int]:
        try:
            while pid := os.waitpid(-1, os.WNOHANG)[0]:
                _reported.pop(pid, None)  # of another command in this process
        except ChildProcessError:
            return set()
        return descendants(os.getpid())

    kill_all(left)


def _preparation(limits: ChildLimits) -> Callable[[], None]:
    """Return what the child does before it becomes the program."""
    megabyte = 1_000_000
    wanted = ((resource.RLIMIT_AS, limits.memory_mb, megabyte, "memory_mb"),
              (resource.RLIMIT_CPU, limits.processor_s, 1, "processor_s"),
              (resource.RLIMIT_NOFILE, limits.open_files, 1, "open_files"),
              (resource.RLIMIT_FSIZE, limits.file_mb, megabyte, "file_mb"))
    most = {kind: math.ceil(value * unit) for kind, value, unit, _ in wanted if value is not None}
    for kind, value, _, field in wanted:
        hard = resource.getrlimit(kind)[1]
        if kind in most and hard != resource.RLIM_INFINITY and most[kind] > hard:
            raise ValueError(f"limits.{field} = {value:g} is above the hard limit")
    parent = os.getpid()

    def prepare() -> None:
        _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        if os.getppid() != parent:
            os._exit(127)
        for number in (signal.SIGINT, signal.SIGHUP, signal.SIGQUIT):
            signal.signal(number, signal.SIG_DFL)
        for kind, value in most.items():
            resource.setrlimit(kind, (value, value))

    return prepare


def in_words(status: int) -> str:
    """Return how a process ended, by its status as of waitpid(2)."""
    code = os.waitstatus_to_exitcode(status)
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"signal {signal.Signals(-code).name}"
    except ValueError:
        return f"signal {-code}"
