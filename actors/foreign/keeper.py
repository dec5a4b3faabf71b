"""The keeper of a command: a process that starts it, keeps its output, and leaves nothing of it.

A script of its own that imports nothing of Rampart: `python -I -S keeper.py FD`. FD is its end of a
socket to the node's process. It reads one line of JSON there, the order, and tells in lines of JSON
what becomes of it: `{"started": PID}`, then `{"ended": STATUS}` as of waitpid(2), or `{"error":
"..."}`.

**Nothing is orphaned.** The keeper is the subreaper of all that the command forks, whatever session
or group that puts itself into (prctl(2)): it ends them all by SIGKILL when the command has ended,
before it says so, and when the socket closes because the node's process has ended, however that
was. A keeper that is stopped is continued by the kernel in that moment. If the keeper is killed,
the kernel kills the command. (What the command has forked is then found by its environment:
`rampart.actors.foreign.strays`.)

**Output** is read as fast as it comes, so that nobody who prints waits. Kept is as much as fits:
`LOG_BYTES` in a file and as many in the one before it, `LOG_BYTES_PER_S` in the long run. What is
beyond is counted, and the count is written.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import resource
import select
import signal
import socket
import sys
import time
from collections import namedtuple
from collections.abc import Callable

LOG_BYTES = 5_000_000
LOG_BYTES_PER_S = 1_000_000
BURST_BYTES = 2_000_000
"""So much at once, before `LOG_BYTES_PER_S` counts."""

END_S = 2.0
"""Wall seconds in which what was killed has to be gone; what is not waits for a disk."""

_READ_BYTES = 1 << 16
_SIGNALS_IGNORED = (signal.SIGINT, signal.SIGHUP, signal.SIGTERM, signal.SIGQUIT)
_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36


class Log:
    """A file of bounded size, with the one before it as `FILE.1`. No disk that fails ends anything.

    Args:
        path: Of the file.
        most: Bytes in it.
    """

    def __init__(self, path: str, most: int = LOG_BYTES) -> None:
        self._path = path
        self._most = most
        self._file = -1
        self._size = 0
        self._left_out = 0
        self._room = float(BURST_BYTES)
        self._at_s = time.monotonic()

    def write(self, data: bytes) -> None:
        """Keep output, or count it where it is too much."""
        now_s = time.monotonic()
        self._room = min(self._room + (now_s - self._at_s) * LOG_BYTES_PER_S, float(BURST_BYTES))
        self._at_s = now_s
        if len(data) > self._room:
            self._left_out += len(data)
            return
        self._room -= len(data)
        if self._left_out and self._put(f"\n--- {self._left_out} bytes are left out\n".encode()):
            self._left_out = 0
        if not self._put(data):
            self._left_out += len(data)

    def note(self, text: str) -> None:
        """Write a line of the keeper's own, whatever the rate."""
        self._room = max(self._room, 2000.0)
        when = time.strftime("%Y-%m-%d %H:%M:%S")
        self.write(f"--- {when} {text}\n".encode(errors="replace"))

    def _put(self, data: bytes) -> bool:
        try:
            if self._file < 0 or self._size + len(data) > self._most:
                self._open()
            self._size += os.write(self._file, data)
        except OSError:
            return False
        return True

    def _open(self) -> None:
        """Open the file, or the next one; whoever looks finds one of that name at any time."""
        kept, self._file = self._file, -1
        if kept >= 0:
            os.close(kept)
        flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC
        if kept < 0:
            file = os.open(self._path, flags, 0o600)
            self._size = os.fstat(file).st_size
            if self._size <= self._most // 2:  # else there is no full half for this process
                self._file = file
                return
            os.close(file)
        fresh, before = f"{self._path}~", f"{self._path}.1"
        self._file = os.open(fresh, flags | os.O_TRUNC, 0o600)
        self._size = 0
        with contextlib.suppress(FileNotFoundError):
            os.unlink(before)  # noqa: PTH108 nothing is imported for it
        with contextlib.suppress(FileNotFoundError):
            os.link(self._path, before)
        os.replace(fresh, self._path)  # noqa: PTH105


def descendants(of: int) -> list[int]:
    """Return the living processes below one, in no certain order."""
    children: dict[int, list[int]] = {}
    states: dict[int, bytes] = {}
    for name in os.listdir("/proc"):  # noqa: PTH208
        if not name.isdecimal():
            continue
        with contextlib.suppress(OSError, ValueError, IndexError), open(  # noqa: PTH123
                f"/proc/{name}/stat", "rb") as stat:
            state, parent = stat.read().rpartition(b")")[2].split()[:2]
            children.setdefault(int(parent), []).append(int(name))
            states[int(name)] = state
    found: list[int] = []
    left = [of]
    while left:
        below = children.get(left.pop(), [])
        left += below
        found += [pid for pid in below if states[pid] not in b"ZX"]
    return found


def kill_all(find: Callable[[], list[int]], within_s: float) -> bool:
    """Kill what is found until nothing is; False if something is left after so many seconds."""
    until_s = time.monotonic() + within_s
    while True:
        left = find()
        for pid in left:
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGKILL)
        if not left or time.monotonic() > until_s:
            return not left
        time.sleep(0.001)


Order = namedtuple("Order", "who command folder env limits fds log grace_s")
"""What is kept, as whom, where, with which environment, limits and descriptors, and until when."""


class Keeper:
    """Keeps one command from its start to its end."""

    def __init__(self, control: socket.socket, order: Order) -> None:
        self._control = control
        self._order = order
        self._log = Log(order.log)
        self._libc = ctypes.CDLL(None, use_errno=True)
        self._output = -1
        self._stop_by_s: float | None = None

    def run(self) -> None:
        """Start the command, and stay until it or the node's process has ended."""
        self._libc.prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
        self._libc.prctl(_PR_SET_PDEATHSIG, signal.SIGCONT, 0, 0, 0)
        wake, woken = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        signal.set_wakeup_fd(woken, warn_on_full_buffer=False)
        pid, error = self._start()
        if error:
            self._log.note(f"{self._order.who}: {error}")
            self._tell({"error": error})
            return
        self._log.note(f"{self._order.who} is process {pid}")
        self._tell({"started": pid})
        status = self._keep(pid, wake)
        kill_all(lambda: descendants(os.getpid()), END_S)
        self._read_output()
        if status is not None:
            self._log.note(f"{self._order.who} ended: {in_words(status)}")
            self._tell({"ended": status})

    def _keep(self, pid: int, wake: int) -> int | None:
        """Return the status with which the command ended; None if it did not end by itself."""
        poll = select.poll()
        for fd in (wake, self._output, self._control.fileno()):
            poll.register(fd, select.POLLIN)
        while True:
            left_s = None if self._stop_by_s is None else self._stop_by_s - time.monotonic()
            if left_s is not None and left_s <= 0:
                return None
            for fd, _ in poll.poll(None if left_s is None else left_s * 1000):
                if fd == wake:
                    with contextlib.suppress(BlockingIOError):
                        os.read(wake, 4096)
                    status = self._reap(pid)
                    if status is not None:
                        return status
                elif fd == self._output:
                    if not self._read_output(times=1):
                        poll.unregister(fd)  # nobody has it open any more
                elif not self._obey(pid):
                    return None

    def _obey(self, pid: int) -> bool:
        """Ask the command to end if that is said; False if the node's process has ended."""
        try:
            said = self._control.recv(4096)
        except OSError:
            said = b""
        if not said:
            return False
        with contextlib.suppress(OSError):
            os.killpg(pid, signal.SIGTERM)
            os.killpg(pid, signal.SIGCONT)
        self._stop_by_s = time.monotonic() + self._order.grace_s
        return True

    def _reap(self, wanted: int) -> int | None:
        found = None
        with contextlib.suppress(ChildProcessError):
            while (ended := os.waitpid(-1, os.WNOHANG))[0]:
                if ended[0] == wanted:
                    found = ended[1]
        return found

    def _read_output(self, times: int = 64) -> bool:
        """Take what was printed; False if nobody is left who could print."""
        for _ in range(times):
            try:
                data = os.read(self._output, _READ_BYTES)
            except BlockingIOError:
                return True
            if not data:
                return False
            self._log.write(data)
        return True

    def _tell(self, what: dict[str, object]) -> None:
        with contextlib.suppress(OSError):
            self._control.sendall(json.dumps(what).encode() + b"\n")

    def _start(self) -> tuple[int, str]:
        """Fork the command and return its process, or why that is not possible."""
        self._output, printed = os.pipe2(os.O_CLOEXEC)
        os.set_blocking(self._output, False)
        failure, failed = os.pipe2(os.O_CLOEXEC)
        keeper = os.getpid()
        try:
            pid = os.fork()
        except OSError as error:
            return 0, f"cannot be started: {error.strerror}"
        if pid == 0:
            try:
                self._become(keeper, printed)
            except Exception as error:  # whatever it is, the node's process is to tell it
                why = getattr(error, "strerror", None) or str(error)
                os.write(failed, f"cannot be started: {why}".encode()[:4000])
            os._exit(127)
        for fd in (printed, failed, *self._order.fds):
            os.close(fd)
        with os.fdopen(failure, "rb") as end:
            return pid, end.read().decode(errors="replace")

    def _become(self, keeper: int, printed: int) -> None:
        os.setsid()
        self._libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
        if os.getppid() != keeper:
            os._exit(127)
        nothing = os.open(os.devnull, os.O_RDONLY)
        for fd, place in ((nothing, 0), (printed, 1), (printed, 2)):
            os.dup2(fd, place)
        for fd in self._order.fds:
            os.set_inheritable(fd, True)
        os.chdir(self._order.folder)
        signal.set_wakeup_fd(-1)
        for number in (*_SIGNALS_IGNORED, signal.SIGCHLD, signal.SIGPIPE, signal.SIGXFSZ):
            signal.signal(number, signal.SIG_DFL)
        for name, most in self._order.limits.items():
            try:
                resource.setrlimit(getattr(resource, name), (most, most))
            except ValueError:
                raise ValueError(f"{name} {most} is above the hard limit") from None
        try:
            command = self._order.command
            os.execve(command[0], command, self._order.env)  # noqa: S606 what the system names
        except FileNotFoundError:  # it was there a moment ago
            raise FileNotFoundError("there is no interpreter as its first line names it") from None


def in_words(status: int) -> str:
    """Return how a process ended, by its status as of waitpid(2)."""
    code = os.waitstatus_to_exitcode(status)
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"signal {signal.Signals(-code).name}"
    except ValueError:
        return f"signal {-code}"


def main() -> None:
    """Keep the command that is ordered on the socket."""
    control = socket.socket(fileno=int(sys.argv[1]))
    control.set_inheritable(False)
    for number in _SIGNALS_IGNORED:
        signal.signal(number, signal.SIG_IGN)
    with control.makefile("rb", buffering=0) as lines:
        text = b""
        while b"\n" not in text:
            part = lines.read(1 << 16)
            if not part:
                return
            text += part
    order, _, more = text.partition(b"\n")
    if not more:  # else its end was asked for before its start
        Keeper(control, Order(**json.loads(order))).run()


if __name__ == "__main__":
    main()
