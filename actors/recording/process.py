"""The recorder as a process of its own: `python -m rampart.actors.recording.process ORDER`.

ORDER is a JSON object (`Order`). It says "ready" on stdout when nodes find it, or "error: …" and
ends; on stderr it says what came of it.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import select
import signal
import subprocess
import sys
from pathlib import Path

import msgspec
import setproctitle

from rampart.actors.bus.run_info import RunInfo
from rampart.actors.bus.zenoh_session import Credentials, credentials_in
from rampart.actors.recording.bag_writer import BagError
from rampart.actors.recording.other_hosts import OtherHosts
from rampart.actors.recording.recorder import RUN_ENDED, Recorder
from rampart.actors.runtime.run_plan import OBSERVER
from rampart.files import streams, working_folder

_READY = "ready"
_PR_SET_PDEATHSIG = 1
_START_S, _END_S = 30.0, 10.0


class Order(msgspec.Struct, frozen=True):
    """What to record where; `launcher` is the pid of the run's launcher, `others` other hosts."""

    port: int
    path: str
    launcher: int
    overwrite: bool = False
    others: OtherHosts | None = None


class RecorderProcess:
    """A launcher's hold on its recorder. Use: `start`, and `end` when the run is over.

    Args:
        order: what it is told.
    """

    def __init__(self, order: Order) -> None:
        self._order = order
        self._process: subprocess.Popen[str] | None = None
        self._problem = ""

    @property
    def path(self) -> str:
        """Of the file."""
        return self._order.path

    def problem(self) -> str:
        """Return why nothing is recorded any more before it was told to end; "" if all is well."""
        if self._process is not None and not self._problem and self._process.poll() is not None:
            self._problem = self._last_words() or "the recorder has died"
        return self._problem

    def _last_words(self) -> str:
        """Return what the recorder says when it starts, or why it could not go on."""
        assert self._process is not None  # noqa: S101 for the type checker
        assert self._process.stdout is not None  # noqa: S101
        return self._process.stdout.readline().strip().removeprefix("error: ")

    def start(self) -> None:
        """Start it and wait until nodes can find it.

        Raises:
            BagError: it cannot begin.
        """
        self._process = subprocess.Popen(  # noqa: S603 our own interpreter and module
            [sys.executable, "-P", "-m", "rampart.actors.recording.process",
             msgspec.json.encode(self._order).decode()],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True,
            env=working_folder.environment())
        assert self._process.stdout is not None  # noqa: S101 for the type checker
        if not select.select([self._process.stdout], [], [], _START_S)[0]:
            self._process.kill()
            self._let_go()
            raise BagError(f"the recorder did not start within {_START_S:g} s")
        answer = self._last_words()
        if answer != _READY:
            self._let_go()
            raise BagError(answer or "the recorder ended as it started")

    def end(self) -> None:
        """Have it write the end of the file. Harmless when it has ended already."""
        process = self._process
        if process is None:
            return
        if not self.problem():
            for number in (signal.SIGCONT, RUN_ENDED):
                with contextlib.suppress(ProcessLookupError):
                    process.send_signal(number)
            try:
                process.wait(_END_S)
                self._problem = self._last_words()
            except subprocess.TimeoutExpired:
                process.kill()
                self._problem = "the recorder did not end"
        self._let_go()

    def _let_go(self) -> None:
        process, self._process = self._process, None
        if process is None or process.stdout is None:
            return
        with contextlib.suppress(subprocess.TimeoutExpired):  # as one that waits for its disk
            process.wait(_END_S)
        process.stdout.close()


def stop_pipe() -> int:
    """Have SIGTERM, SIGINT and SIGHUP readable from a file descriptor, and return it."""
    read_end, write_end = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    numbers = [signal.SIGTERM, signal.SIGINT]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # as it is under nohup
        numbers.append(signal.SIGHUP)
    for number in numbers:
        signal.signal(number, lambda *_: None)
    signal.set_wakeup_fd(write_end, warn_on_full_buffer=False)
    return read_end


def record(order: Order) -> int:
    """Record to the end of the run, and return the exit code."""
    # Should it be stopped when the launcher dies, it must go on to see that and end.
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGCONT, 0, 0, 0)
    path = Path(order.path)
    setproctitle.setproctitle(f"rampart-recorder[{order.port}/{order.launcher}] {path}")
    stop = stop_pipe()
    for number in (signal.SIGINT, signal.SIGHUP):  # the launcher's to handle; we see its end
        signal.signal(number, signal.SIG_IGN)
    signal.signal(RUN_ENDED, lambda *_: None)
    recorder = Recorder(order.port, path, overwrite=order.overwrite, launcher=order.launcher,
                        others=order.others, shown=_launchers)
    try:
        recorder.open()
    except BagError as error:
        _answer(f"error: {error}")
        return 1
    _answer(_READY)
    try:
        recorder.run(stop)
    except (BagError, ValueError, OSError) as error:
        streams.complain(str(error))
        _answer(f"error: {error}")
        return 1
    if recorder.writer is not None:
        streams.complain(told(recorder))
    return 0


def _launchers(run: RunInfo) -> Credentials | None:
    """Return by what the launcher of a run shows who it is, and so does its recorder."""
    return credentials_in(run.keys, OBSERVER, run.folder, run.ports)


def told(recorder: Recorder) -> str:
    """Return one line on what came of a recording."""
    if recorder.writer is None:
        return f"{recorder.path}: nothing was recorded"
    if not recorder.path.exists():
        return f"{recorder.path}: was taken away while it was written: nothing is recorded"
    files = recorder.files
    lost = sum(sum(file.gaps.lost().values()) for file in files)
    found = sum(file.garbage for file in files)
    garbage = f", {found} of them garbage" if found else ""
    silent = "".join(f"; {host} could not be heard all the time, see `rampart bag info`"
                     for host, spans in recorder.writer.unheard.items() if spans != "[]")
    more = f" and {len(files) - 1} more files" if len(files) > 1 else ""
    return (f"recorded {sum(file.messages for file in files)} messages in {recorder.path}{more}"
            f"{garbage}, "
            f"{lost or 'none'} lost{silent}")


def _answer(text: str) -> None:
    """Tell the launcher, if it is still there; past the buffer, which would be tried once more."""
    with contextlib.suppress(OSError):
        os.write(sys.stdout.fileno(), f"{text}\n".encode())


if __name__ == "__main__":
    streams.secure()
    sys.exit(record(msgspec.json.decode(sys.argv[1], type=Order)))
