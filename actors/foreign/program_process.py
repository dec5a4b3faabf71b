"""The process of a command's program, as a child of its node's process.

The node's process is the parent of the program and the subreaper of everything that the program
forks, in any session. When the program ends, the node's process kills all of that before it reports
the end. If the node's process is killed, the kernel kills the program, and `descendants` deals with
the rest. When the root of the run ends, the node's process gets a SIGTERM instead of a SIGKILL:
afterwards nothing could find what the program has forked.

The program never waits for a reader of its output, which is read at once.

It starts by `setpriv` and, if it has limits, by `prlimit` (both util-linux): so PR_SET_PDEATHSIG
and limits hold from its first instruction on. Python's `preexec_fn` could do both. But it needs a
fork of this process with all its memory, 4 to 9 ms, and is not safe beside the threads of Zenoh.
"""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import errno
import math
import os
import resource
import shutil
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
"""Wall seconds that a program has to end after a SIGTERM."""

_READ_BYTES = 1 << 16
_READS_AT_ONCE = 64
_MEGABYTE = 1_000_000
_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36
_libc = ctypes.CDLL(None, use_errno=True)
_programs: dict[int, Callable[[int], None]] = {}
"""The living programs by pid; each call receives the exit status."""


class ProgramProcess:
    """A program, from its start to its end.

    Args:
        program: Path of the file.
        arguments: Of the program, without its name.
        folder: Its working directory.
        environment: All of its variables.
        limits: Of its resources.
        log: Receives its output.
        inherited: Descriptors that it inherits.
        ended: Called on the event loop with how it has ended, when nothing of it is left.

    Raises:
        OSError: It cannot be started.
        ValueError: A limit is above the hard limit of this process.
    """

    def __init__(self, program: str, arguments: Sequence[str], *, folder: Path,
                 environment: Mapping[str, str], limits: ChildLimits, log: OutputLog,
                 inherited: Sequence[int], ended: Callable[[str], None]) -> None:
        self._log = log
        self._ended = ended
        self.exit_code: int | None = None
        self._loop = asyncio.get_running_loop()
        self._loop.add_signal_handler(signal.SIGCHLD, _reap)
        for number in (signal.SIGINT, signal.SIGHUP, signal.SIGQUIT):
            signal.signal(number, lambda *_: None)  # a program would inherit SIG_IGN
        _libc.prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
        _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
        begin = [_util("setpriv"), "--pdeathsig", "KILL"]
        if most := _limits(limits):
            begin += [_util("prlimit"), *most]
        output, printed = os.pipe()
        try:
            process = subprocess.Popen(  # noqa: S603 the specification names the program
                [*begin, program, *arguments], cwd=folder,
                env=environment, stdin=subprocess.DEVNULL, stdout=printed, stderr=printed,
                pass_fds=inherited, start_new_session=True)
        except BaseException:
            os.close(output)
            raise
        finally:
            os.close(printed)
        self.pid = process.pid
        process.returncode = 0  # `_reap` waits for it
        _programs[self.pid] = self._end_seen
        os.set_blocking(output, False)
        self._output = output
        self._loop.add_reader(output, self._read, 1)

    @property
    def is_stopped(self) -> bool:
        """Whether it is stopped (SIGSTOP)."""
        return process_state(self.pid) in "Tt"

    def kill(self) -> None:
        """Kill it; `ended` is called when it is gone."""
        if self.pid in _programs:  # else another process may have the pid
            os.kill(self.pid, signal.SIGKILL)

    def end(self) -> None:
        """Send SIGTERM, and return when nothing of it is left, little more than `GRACE_S` later."""
        if _programs.pop(self.pid, None) is None:
            return
        until_s = time.monotonic() + GRACE_S
        for number in (signal.SIGTERM, signal.SIGCONT):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.pid, number)
        while process_state(self.pid) not in "ZX" and time.monotonic() < until_s:
            time.sleep(0.002)
            self._read()
        self._leave_nothing()

    def _end_seen(self, status: int) -> None:
        self._leave_nothing()
        self.exit_code = os.waitstatus_to_exitcode(status)
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
            if not data:  # no process is left that can print
                self._loop.remove_reader(self._output)
                return
            self._log.write(data)


def _reap() -> None:
    with contextlib.suppress(ChildProcessError):
        while (ended := os.waitpid(-1, os.WNOHANG))[0]:
            if end_seen := _programs.pop(ended[0], None):
                end_seen(ended[1])


def _kill_descendants() -> None:
    """Kill all descendants of this process; read /proc only if it has children."""

    def left() -> set[int]:
        try:
            while pid := os.waitpid(-1, os.WNOHANG)[0]:
                _programs.pop(pid, None)  # of another command in this process
        except ChildProcessError:
            return set()
        return descendants(os.getpid())

    kill_all(left)


def _limits(limits: ChildLimits) -> list[str]:
    """Return the options of prlimit(1)."""
    wanted = (("as", resource.RLIMIT_AS, limits.memory_mb, _MEGABYTE, "memory_mb"),
              ("cpu", resource.RLIMIT_CPU, limits.processor_s, 1, "processor_s"),
              ("nofile", resource.RLIMIT_NOFILE, limits.open_files, 1, "open_files"),
              ("fsize", resource.RLIMIT_FSIZE, limits.file_mb, _MEGABYTE, "file_mb"))
    options = []
    for option, kind, value, unit, field in wanted:
        if value is None:
            continue
        most, hard = math.ceil(value * unit), resource.getrlimit(kind)[1]
        if hard != resource.RLIM_INFINITY and most > hard:
            raise ValueError(f"limits.{field} = {value:g} is above the hard limit")
        options.append(f"--{option}={most}:{most}")
    return options


def _util(program: str) -> str:
    found = shutil.which(program)
    if found is None:
        raise FileNotFoundError(errno.ENOENT, f"no program {program} (util-linux) in PATH")
    return found


def in_words(status: int) -> str:
    """Return in words how a process ended; `status` is that of waitpid(2)."""
    code = os.waitstatus_to_exitcode(status)
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"signal {signal.Signals(-code).name}"
    except ValueError:
        return f"signal {-code}"
