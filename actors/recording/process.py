"""The process of the recorder: `python -m rampart.actors.recording.process ORDER`.

ORDER is a JSON object (`Order`). The process prints "ready" on stdout when nodes can find it, or
"error: …" and ends. On stderr it prints the result.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import msgspec
import setproctitle

from rampart.actors.bus.run_info import RunInfo
from rampart.actors.bus.zenoh_session import Credentials, credentials_in
from rampart.actors.recording.bag_writer import BagError
from rampart.actors.recording.black_box import BlackBox
from rampart.actors.recording.recorder import Recorder
from rampart.actors.recording.run_listener import RUN_ENDED, RunListener
from rampart.actors.runtime.run_plan import OBSERVER
from rampart.files import streams, working_folder
from rampart.manager.spec.tables import BlackBox as Limits

_READY = "ready"
_PR_SET_PDEATHSIG = 1
_START_S, _END_S = 30.0, 10.0
_DIED = "the recorder has died"

_AGAIN_S = 10.0
"""Least real seconds between two starts of a black box."""

_NICE = 5
"""Niceness of a black box above that of the run: it may be late by some hundred messages."""


class Order(msgspec.Struct, frozen=True):
    """Order to record a run.

    Attributes:
        port: base port of the run.
        path: file; of a black box the folder of the system.
        launcher: pid of the launcher.
        overwrite: whether the file may exist.
        black_box: limits of a black box; None for a recording.
        again: whether a black box follows another one of this run, which has died.
    """

    port: int
    path: str
    launcher: int
    overwrite: bool = False
    black_box: Limits | None = None
    again: bool = False


class RecorderProcess:
    """The recorder of a launcher: `start` it, and `end` it when the run is over.

    Args:
        order: for the recorder.
    """

    def __init__(self, order: Order) -> None:
        self._order = order
        self._process: subprocess.Popen[str] | None = None
        self._problem = ""
        self._again_s = 0.0

    @property
    def path(self) -> str:
        """Path of the file."""
        return self._order.path

    def problem(self) -> str:
        """Return why the recorder has ended too early; "" if it has not."""
        if self._process is not None and not self._problem and self._process.poll() is not None:
            self._problem = self._answer() or _DIED
        return self._problem

    def _answer(self) -> str:
        """Return the next line of the recorder: that it is ready, or an error."""
        assert self._process is not None  # noqa: S101 for the type checker
        assert self._process.stdout is not None  # noqa: S101
        return self._process.stdout.readline().strip().removeprefix("error: ")

    def keep_alive(self) -> str:
        """Start a black box that has died again; return why it has ended otherwise, or ""."""
        if self.problem() != _DIED:
            return self._problem
        if time.monotonic() >= self._again_s:
            self._let_go()
            self._problem = ""
            self._order = msgspec.structs.replace(self._order, again=True)
            self.start()
        return ""

    def start(self) -> None:
        """Start it, and wait until nodes can find a recorder; a run does not wait for a black box.

        Raises:
            BagError: it cannot start.
            OSError: no process can be started.
        """
        self._again_s = time.monotonic() + _AGAIN_S
        self._process = subprocess.Popen(  # noqa: S603 our own interpreter and module
            [sys.executable, "-P", "-m", "rampart.actors.recording.process",
             msgspec.json.encode(self._order).decode()],
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True,
            env=working_folder.environment())
        if self._order.black_box is not None:
            os.setpriority(os.PRIO_PROCESS, self._process.pid, os.nice(0) + _NICE)
        assert self._process.stdout is not None  # noqa: S101 for the type checker
        if self._order.black_box is not None:
            return
        if not select.select([self._process.stdout], [], [], _START_S)[0]:
            self._process.kill()
            self._let_go()
            raise BagError(f"the recorder did not start within {_START_S:g} s")
        answer = self._answer()
        if answer != _READY:
            self._let_go()
            raise BagError(answer or "the recorder ended as it started")

    def end(self) -> None:
        """Make it write the end of the file and exit; does nothing if it has ended already."""
        process = self._process
        if process is None:
            return
        if not self.problem():
            for number in (signal.SIGCONT, RUN_ENDED):
                with contextlib.suppress(ProcessLookupError):
                    process.send_signal(number)
            try:
                process.wait(_END_S)
                self._problem = self._answer()
            except subprocess.TimeoutExpired:
                process.kill()
                self._problem = "the recorder did not end"
        self._let_go()

    def _let_go(self) -> None:
        process, self._process = self._process, None
        if process is None or process.stdout is None:
            return
        with contextlib.suppress(subprocess.TimeoutExpired):  # it may wait for its disk
            process.wait(_END_S)
        process.stdout.close()


def stop_pipe() -> int:
    """Return a file descriptor from which SIGTERM, SIGINT and SIGHUP can be read."""
    read_end, write_end = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    numbers = [signal.SIGTERM, signal.SIGINT]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # not under nohup
        numbers.append(signal.SIGHUP)
    for number in numbers:
        signal.signal(number, lambda *_: None)
    signal.set_wakeup_fd(write_end, warn_on_full_buffer=False)
    return read_end


def record(order: Order) -> int:
    """Record to the end of the run, and return the exit code."""
    # If this process is stopped when the launcher dies, it must continue to notice that and end.
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGCONT, 0, 0, 0)
    path = Path(order.path)
    name = "recorder" if order.black_box is None else "black-box"
    setproctitle.setproctitle(f"rampart-{name}[{order.port}/{order.launcher}] {path}")
    stop = stop_pipe()
    for number in (signal.SIGINT, signal.SIGHUP):  # the launcher handles them; we see its end
        signal.signal(number, signal.SIG_IGN)
    signal.signal(RUN_ENDED, lambda *_: None)
    recorder = _recorder(order, path)
    try:
        recorder.open()
    except BagError as error:
        _answer(f"error: {error}")
        return 1
    if order.black_box is None:
        _answer(_READY)
    try:
        recorder.run(stop)
    except (BagError, ValueError, OSError) as error:
        if order.black_box is None:  # else its launcher prints the answer
            streams.complain(str(error))
        _answer(f"error: {error}")
        return 1
    if isinstance(recorder, Recorder) and recorder.writer is not None:
        streams.complain(result_of(recorder))
    return 0


def _recorder(order: Order, path: Path) -> RunListener:
    if order.black_box is None:
        return Recorder(order.port, path, overwrite=order.overwrite, launcher=order.launcher,
                        credentials=_launchers)
    return BlackBox(order.port, path, order.black_box, launcher=order.launcher, again=order.again)


def _launchers(run: RunInfo) -> Credentials | None:
    """Return the credentials of the launcher of a run, which its recorder uses too."""
    return credentials_in(run.keys, OBSERVER, run.folder, run.ports)


def result_of(recorder: Recorder) -> str:
    """Return one line about the result of a recording."""
    if recorder.writer is None:
        return f"{recorder.path}: nothing was recorded"
    if not recorder.path.exists():
        return f"{recorder.path}: was removed while it was written: nothing is recorded"
    lost, found = sum(recorder.file.gaps.lost().values()), recorder.file.garbage
    garbage = f", {found} of them garbage" if found else ""
    return (f"recorded {recorder.messages} messages in {recorder.path}{garbage}, "
            f"{lost or 'none'} lost")


def _answer(text: str) -> None:
    """Write a line to the launcher, if it is still there; unbuffered, so nothing is retried."""
    with contextlib.suppress(OSError):
        os.write(sys.stdout.fileno(), f"{text}\n".encode())


if __name__ == "__main__":
    streams.secure()
    sys.exit(record(msgspec.json.decode(sys.argv[1], type=Order)))
